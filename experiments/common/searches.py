"""The ways to search with one trained energy, for plans that are executed whole."""

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from leapjax.configuration import AnyConfig, change, make_domain
from leapjax.planners import GibbsConfig
from leapjax.planners.judges import JUDGES
from leapjax.presets.puzzles import TURNED


class Search(NamedTuple):
    """A way to search.

    Attributes:
        name: title in tables.
        passes: passes of the model, at most, in units of the horizon T; 0 for a single pass.
        options: fields of `GibbsConfig`, without the number of iterations.
    """

    name: str
    passes: int
    options: Mapping[str, Any]

    @property
    def cost(self) -> str:
        """All passes of the model: "1", "T", "2 T", with restarts and their judge "16 (T + 6)".

        A mark "≤" says that plans may take fewer.
        """
        cost = {0: "1", 1: "T"}.get(self.passes, f"{self.passes} T")
        if "restarts" in self.options:
            judge = self.options.get("judge", "energy")
            # Only rules are judged by their energy here, which takes one pass.
            judged = 1 if judge == "energy" else JUDGES[judge].count_passes(0)
            cost = f"{self.options['restarts']} ({cost} + {judged})"
        return "≤ " * bool({"certainty", "entropy_bound"} & {*self.options}) + cost

    def of(self, horizon: int) -> dict[str, Any]:
        """Returns the fields of `GibbsConfig` for plans of `horizon` actions."""
        iterations = max(1, self.passes * horizon)
        return dataclasses.asdict(GibbsConfig(horizon, iterations, **self.options))


SEARCHES = (
    Search("all at once", 0, {}),
    Search("left to right", 1, {"fill": "sequential"}),
    Search("in random order", 1, {"fill": "random"}),
    *(Search("Gibbs sampling, random order", n, {}) for n in (1, 2)),
    Search("most certain first", 1, {"fill": "confident"}),
    Search("most certain first, by margin", 1, {"fill": "margin"}),
    Search("all that are certain", 1, {"fill": "confident", "certainty": 0.999}),
    Search("as many as are independent", 1, {"fill": "confident", "entropy_bound": 0.01}),
    Search("restarts on turned puzzles", 1, TURNED),
)
# Only for rules, which score a plan in one pass. A learned energy needs T passes more.
BEST_OF_MANY = Search(
    "most certain first, best of 16", 1,
    {"fill": "confident", "temperature": 0.2, "restarts": 16},
)  # fmt: skip


def list_searches(config: AnyConfig) -> list[AnyConfig]:
    """Returns a configuration for each search that a method can make, without its own.

    The list is empty for methods that plan one action.
    """
    if not isinstance(config.planner, GibbsConfig) or config.planner.horizon == 1:
        return []
    every = (*SEARCHES, BEST_OF_MANY) if config.method == "rules" else SEARCHES
    if config.method != "leap" or make_domain(config).turn is None:  # no symmetries
        every = tuple(search for search in every if search.options != TURNED)
    if config.method == "classifier":  # scores only complete plans
        every = tuple(search for search in every if "fill" not in search.options)
    return change_planner(config, [search.of(config.planner.horizon) for search in every])


def change_planner(config: AnyConfig, planners: Iterable[Mapping[str, Any]]) -> list[AnyConfig]:
    """Returns a configuration for each change of the planner's fields, without the given one."""
    found = [change(config, planner=planner) for planner in planners]
    return [each for each in found if each.planner != config.planner]
