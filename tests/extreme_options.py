"""Every option of every program that takes a number, and the numbers that one might give it."""

import dataclasses
import typing
from collections.abc import Iterator
from typing import Any

from experiments import (
    ablation,
    accuracy,
    atari,
    atari_energy,
    failures,
    landscape,
    properties,
    qualitative,
    stochastic,
    suboptimal,
)
from experiments.common import cases
from leapjax.configuration import blank
from leapjax.methods import METHODS
from leapjax.presets import find_presets

LEVELS = {
    "babyai": "GoToLocalS7N5", "stars": "Star3x5", "sudoku": "Sudoku4x6",
    "gymnasium": "FrozenLake-v1", "atari": "Breakout",
}  # fmt: skip
# By name: the program, the options that it has, and what else it is given; RUN: the folder of one.
PROGRAMS = {
    "ablation": (ablation.main, cases.Options, ["--only", "masked-model"]),
    "properties": (properties.main, cases.Options, ["--only", "generalization-easy"]),
    "stochastic": (stochastic.main, cases.Options, ["--only", "GoToObjMazeS4"]),
    "suboptimal": (suboptimal.main, cases.Options, ["--only", "GoToSeqS5R2"]),
    "accuracy": (accuracy.main, accuracy.Options, ["RUN"]),
    "failures": (failures.main, failures.Options, ["RUN"]),
    "landscape": (landscape.main, landscape.Options, []),
    "qualitative": (qualitative.main, qualitative.Options, []),
    "atari_energy": (atari_energy.main, atari_energy.Options, ["--checkpoint", "RUN"]),
    "atari collect": (atari.main, atari.Collect, ["collect", "--game", "Breakout"]),
}
COUNTS = ("-1", "0", "2", "100000", "2147483647", "2147483648", "9223372036854775808", "9" * 5000)
NUMBERS = ("-1", "0", "0.5", "nan", "inf", "-inf", "1e39", "1e308", "9" * 5000)


def numeric(settings: Any) -> Iterator[tuple[str, list[str]]]:
    """(field, option and value) of each that takes a number, with every number."""
    hints = typing.get_type_hints(settings)
    for field in dataclasses.fields(settings):
        kind = hints[field.name]
        parts = typing.get_args(kind) or (kind,)
        values = COUNTS if int in parts else NUMBERS if float in parts else ()
        pair = typing.get_origin(kind) is tuple and ... not in parts
        for value in values:
            option = f"--{field.name.replace('_', '-')}"
            yield field.name, [option, *[value] * (len(parts) if pair else 1)]


def command_lines(domain: str) -> Iterator[list[str]]:
    """Command lines of an experiment in a domain.

    In BabyAI, of every method; options that all have, of LEAP alone.
    """
    base = ["--level", LEVELS[domain]]
    if domain == "gymnasium":  # nobody demonstrates it
        base += ["--demos", "0", "--steps", "0"]
    for method in METHODS if domain == "babyai" else ("leap", "iql"):
        chosen = blank(domain, LEVELS[domain], method)
        parts = [chosen.method_settings, chosen.planner]
        if method == "leap":
            parts += [chosen, chosen.model, chosen.training, chosen.cluster, chosen.domain_settings]
        for name in find_presets(domain):
            for part in parts:
                for _, given in numeric(type(part)):
                    yield [*base, "--method", method, "--preset", name, *given]
