"""Forbids a planner that comes with the library to turn left, without training."""

import sys

import jax.numpy as jnp

import leapjax as leap
from leapjax.domains.babyai.adapter import ACTIONS, END, BabyAIAdapter
from leapjax.domains.babyai.levels import find_level

LEVEL, EPISODES = "GoToLocalS7N5", int(sys.argv[1]) if len(sys.argv) > 1 else 100
LEFT = ACTIONS.index("left")


def left_turns(context, actions):  # a penalty: 0 if a plan is allowed
    executed = jnp.cumsum(actions == END) == 0  # the actions before the end
    return 20.0 * jnp.sum((actions == LEFT) & executed)


class Counting(BabyAIAdapter):
    """Counts the planner's left turns."""

    lefts = 0

    def step(self, action):
        """Takes one action."""
        Counting.lefts += action == LEFT
        return super().step(action)


planner = leap.load(LEVEL)
energies = {
    "as it is": planner.energy,
    "without left turns": leap.constrain(planner.energy, left_turns, partial=True),
}
for name, energy in energies.items():
    Counting.lefts = 0
    plan = leap.compile_planner(energy, planner.specification.planner)
    played = leap.evaluate(
        lambda: Counting(find_level(LEVEL)), range(EPISODES), plan, planner.params, context=0
    )
    print(f"{name}: success {played.successes.mean():.0%}, {Counting.lefts} left turns")
