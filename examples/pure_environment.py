"""A thousand mazes of Jumanji in one call: environment, energy and planner in one program.

Needs `pip install jumanji`.
"""

import sys
import time

import jax
import jax.numpy as jnp
import jumanji

import leapjax as leap
from leapjax.environments import Transition

EPISODES = int(sys.argv[1]) if len(sys.argv) > 1 else 1000
MOVES = jnp.array([[-1, 0], [0, 1], [1, 0], [0, -1], [0, 0]])  # up, right, down, left; end
maze = jumanji.make("Maze-v0")


def seen(timestep):
    looks = timestep.observation
    agent, target = ((p.row, p.col) for p in (looks.agent_position, looks.target_position))
    return {"walls": looks.walls, "agent": jnp.array(agent), "target": jnp.array(target)}


def reset(key):
    state, timestep = maze.reset(key)
    return state, seen(timestep)


def step(state, action):
    state, timestep = maze.step(state, action)
    found = timestep.reward > 0
    return state, Transition(
        seen(timestep), timestep.reward, found, timestep.last() & ~found, found
    )


def encode(params, context):
    """Computes the distance of every cell from the target, once per plan."""
    walls, target = context.observation["walls"], context.observation["target"]

    def spread(_, far):
        around = jnp.pad(far, 1, constant_values=jnp.inf)
        near = [around[2:, 1:-1], around[:-2, 1:-1], around[1:-1, 2:], around[1:-1, :-2]]
        return jnp.where(walls, jnp.inf, jnp.minimum(far, 1 + jnp.min(jnp.stack(near), axis=0)))

    begun = jnp.full(walls.shape, jnp.inf).at[tuple(target)].set(0.0)
    far = jax.lax.fori_loop(0, walls.size, spread, begun)
    return far, walls, context.observation["agent"]


def total(params, memory, actions):
    """Returns the distance from the target at the end of a plan."""
    far, walls, agent = memory

    def move(place, action):
        there = place + MOVES[action]
        inside = ((there >= 0) & (there < jnp.array(walls.shape))).all()
        return jnp.where(inside & ~walls[tuple(there)], there, place), None

    place, _ = jax.lax.scan(move, agent, actions)
    return jnp.where(actions[0] == 4, jnp.inf, far[tuple(place)])  # forbids to give up


energy = leap.from_total(encode, total, num_actions=5)
config = leap.GibbsConfig(horizon=6, iterations=36, temperature=0.2, restarts=4)
rollout = leap.compile_rollout(
    leap.PureEnvironment(reset, step, 5), energy, config, context=0, max_steps=100
)
rollout((), range(EPISODES))  # compiles
begun = time.perf_counter()
played = rollout((), range(EPISODES), 1)
seconds = time.perf_counter() - begun
print(
    f"{EPISODES} mazes: success {played.successes.mean():.0%}, {played.lengths.mean():.1f} steps, "
    f"{played.plans} plans in {seconds:.1f} s"
)
