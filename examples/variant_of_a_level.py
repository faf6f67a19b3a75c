"""A planner that comes with the library plays a variant of its level, with more objects."""

import dataclasses
import sys

import leapjax as leap
from leapjax.domains.babyai.adapter import BabyAIAdapter
from leapjax.domains.babyai.levels import find_level

LEVEL, EPISODES = "GoToLocalS7N5", int(sys.argv[1]) if len(sys.argv) > 1 else 100

planner = leap.load(LEVEL)
trained = find_level(LEVEL)
for level in (trained, dataclasses.replace(trained, distractors=10)):
    played = leap.evaluate(
        lambda level=level: BabyAIAdapter(level), range(EPISODES), planner.plan, planner.params,
        context=planner.specification.context,
    )  # fmt: skip
    print(f"{level.distractors} objects: success {played.successes.mean():.0%}")
