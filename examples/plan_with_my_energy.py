"""A hand-written energy without a network, a constraint, and hundreds of plans in one call."""

import jax
import jax.numpy as jnp

import leapjax as leap

MOVES = jnp.array([[0, 1], [1, 0], [0, -1], [-1, 0], [0, 0]])  # up, right, down, left, stay


def encode(params, context):  # once per plan
    return context


def total(params, context, actions):  # [T] -> []: lower is better
    away = context["from"] + MOVES[actions].sum(axis=0) - context["to"]
    return params["miss"] * jnp.abs(away).sum() + (actions != 4).sum()


def crossing(context, actions):  # a constraint: how often a plan steps onto the column x = 2
    places = context["from"] + jnp.cumsum(MOVES[actions], axis=0)
    return 10.0 * ((places[:, 0] == 2) & (places[:, 1] < 3)).sum()


energy = leap.constrain(leap.from_total(encode, total, num_actions=5), crossing)
config = leap.GibbsConfig(horizon=12, iterations=60, temperature=0.5, restarts=16, score=True)
plan = leap.compile_planner(energy, config)

starts = jnp.stack([jnp.zeros(256, jnp.int32), jnp.arange(256) % 3], axis=1)
contexts = {"from": starts, "to": jnp.full((256, 2), jnp.array([4, 1]))}
plans = plan({"miss": 4.0}, jax.random.split(jax.random.key(0), 256), contexts)
print(f"{float(plans.satisfied.mean()):.0%} of {len(plans.actions)} plans keep to the constraint")
print("one of them:", plans.actions[0])
