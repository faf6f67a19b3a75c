"""Loads the planner of an earlier run, and adds the rules of its domain."""

import dataclasses
from typing import Any

from leapjax import pretrained
from leapjax.agents.measured import MEASURED
from leapjax.batching import compile_planner
from leapjax.data import seeds
from leapjax.energy import compose
from leapjax.errors import UserError
from leapjax.pretrained import Pretrained, Specification
from leapjax.running.data import find_demonstrated
from leapjax.running.programs import choose_chunk_sizes
from leapjax.running.run import Run


def load_trained(run: Run) -> Pretrained:
    """Loads the planner of the checkpoint that a configuration names.

    Raises:
        UserError: the configuration does not fit the trained planner, or the row of an unfinished
            run would be recorded.
    """
    checkpoint = run.config.checkpoint
    assert checkpoint is not None
    # On another level the same seeds give other episodes.
    if run.config.play in (None, run.config.level):
        seeds.check_disjoint(find_demonstrated(checkpoint), run.played)
    trained = pretrained.read_specification(checkpoint)
    wanted, found = (_select_training_settings(s) for s in (run.specification, trained))
    for name in wanted:
        if wanted[name] != found.get(name):
            label = name.rsplit(".", 1)[-1]
            raise UserError(
                f"the checkpoint {checkpoint} does not fit: {label} is {found.get(name)}, "
                f"not {wanted[name]}"
            )
    target, known = (
        getattr(s.method_settings, "target_return", None) for s in (run.specification, trained)
    )
    return pretrained.load(
        checkpoint, run.config.planner, choose_chunk_sizes(run.config), run.config.play,
        None if target == known else target, finished=run.config.record,
    )  # fmt: skip


def _select_training_settings(specification: Specification) -> dict[str, Any]:
    """Returns the settings that a trained planner fixes: all but its search and `MEASURED`."""

    def flat(values: dict[str, Any], prefix: str) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for name, value in values.items():
            nested = isinstance(value, dict)
            found |= flat(value, f"{prefix}{name}.") if nested else {f"{prefix}{name}": value}
        return found

    settings = flat(dataclasses.asdict(specification), "")
    asked = {"statistics", *(f"method_settings.{name}" for name in MEASURED)} | {
        name for name in settings if name.startswith(("planner.", "signature."))
    }
    return {
        name: value
        for name, value in settings.items()
        if name not in asked or name == "planner.horizon"
    }


def add_rules(run: Run, planner: Pretrained) -> Pretrained:
    """Returns a planner that also minimises the domain's rules, if `--rules` has a weight."""
    weight, rules = run.config.rules, run.domain.rules
    if not weight or rules is None:
        return planner
    energy = compose([planner.energy, rules], [1.0, weight])
    plan = compile_planner(energy, run.config.planner, choose_chunk_sizes(run.config))
    return dataclasses.replace(planner, energy=energy, params=(planner.params, ()), plan=plan)
