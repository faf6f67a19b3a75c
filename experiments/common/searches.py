"""Every way to search with one trained energy over plans that are executed whole."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from leapjax.configuration import AnyConfig, change
from leapjax.planners import GibbsConfig


class Search(NamedTuple):
    """A way to plan."""

    name: str
    passes: int  # of the model, in units of the horizon T; 0: a single one
    options: Mapping[str, Any]  # of `GibbsConfig`, but for the number of iterations

    @property
    def cost(self) -> str:
        """Passes in all, in words."""
        passes = self.passes * self.options.get("restarts", 1)
        return {0: "1", 1: "T"}.get(passes, f"{passes} T")

    def of(self, horizon: int) -> dict[str, Any]:
        """Options for plans of T actions."""
        plain = {"fill": "together", "order": "random"}
        return {**plain, **self.options, "iterations": max(1, self.passes * horizon)}


SEARCHES = (
    Search("all at once", 0, {}),
    Search("left to right", 1, {"fill": "sequential"}),
    Search("in random order", 1, {"fill": "random"}),
    *(Search("Gibbs sampling, random order", n, {}) for n in (1, 2, 4)),
    *(Search("Gibbs sampling, left to right", n, {"order": "sequential"}) for n in (1, 2, 4)),
    *(Search("Gibbs sampling, least certain first", n, {"order": "uncertain"}) for n in (1, 2, 4)),
    Search("most certain first", 1, {"fill": "confident"}),
    Search("most certain first, by margin", 1, {"fill": "margin"}),
    Search("most certain first, then Gibbs", 2, {"fill": "confident", "order": "uncertain"}),
)
# To score a learned energy takes T more passes: only for rules, whose total is one.
BEST_OF_MANY = Search(
    "most certain first, best of 16", 1,
    {"fill": "confident", "temperature": 0.2, "restarts": 16},
)  # fmt: skip


def list_searches(config: AnyConfig) -> list[AnyConfig]:
    """Every way to plan that a method can; those of one action at a time have none."""
    if not isinstance(config.planner, GibbsConfig) or config.planner.horizon == 1:
        return []
    every = (*SEARCHES, BEST_OF_MANY) if config.method == "rules" else SEARCHES
    if config.method == "classifier":  # judges no plan in which actions are open
        every = tuple(search for search in every if "fill" not in search.options)
    return [change(config, planner=search.of(config.planner.horizon)) for search in every]
