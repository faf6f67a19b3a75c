"""Plan, act, replan entirely inside `jit`, for environments that are pure functions.

The same episodes as `leapjax.rollouts.evaluate`, thousands of them in one call of one program.
"""

import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from leapjax.batching import plan_key
from leapjax.environments import Transition
from leapjax.planners import PlannerConfig, bind
from leapjax.rollouts import Episodes, check_actions, check_limits
from leapjax.types import Array, Context, Energy, Params, PyTree, pad_token


class PureEnvironment(NamedTuple):
    """An environment as two pure functions of one episode."""

    reset: Callable[[jax.Array], tuple[PyTree, PyTree]]
    # (key) -> state, observation
    step: Callable[[PyTree, jax.Array], tuple[PyTree, Transition]]
    # (state, action [] int32) -> state, what the step gave, as arrays
    num_actions: int  # A, the end action included: the environment has A - 1


class _Episode(NamedTuple):
    """An episode under way."""

    state: PyTree
    context: Context
    score: jax.Array  # [] float32: its return as reported
    over: jax.Array  # [] bool
    success: jax.Array  # [] bool
    plans: jax.Array  # [] int32
    valid: jax.Array  # [] bool: no energy met was NaN


def compile_rollout(
    environment: PureEnvironment,
    energy: Energy,
    config: PlannerConfig,
    *,
    context: int,
    max_steps: int,
    executed: int | None = None,
) -> Callable[[Params, Sequence[int], int], Episodes]:
    """Builds, once, a function that plays any number of episodes.

    Args:
        environment: to play in.
        energy: to minimise; of as many actions.
        config: of the planner.
        context: K.
        max_steps: cuts an episode off.
        executed: actions to execute before replanning; None for all T.

    Returns:
        `(params, level seeds [E], seed of the planner's randomness) -> Episodes`. The episode of a
        level seed begins with `jax.random.key(level seed)`; plans are those of `evaluate`. The
        time of planning cannot be told from the rest of the program: it is all of it.

    Raises:
        ValueError: nothing to execute, other actions than the energy's, or, of the function
            returned, an energy that was NaN.
    """
    check_limits(executed, max_steps)
    check_actions("energy", energy.num_actions, environment.num_actions)
    plan = bind(energy, config)
    end = energy.num_actions - 1

    def begin(level_seed: jax.Array) -> _Episode:
        state, observation = environment.reset(jax.random.key(level_seed))
        past = jax.tree.map(lambda x: jnp.zeros((context, *x.shape), x.dtype), observation)
        blank = Context(
            observation, past, jnp.full(context, pad_token(end + 1), jnp.int32),
            jnp.zeros(context), jnp.int32(0), jnp.float32(0),
        )  # fmt: skip
        no, yes = jnp.bool_(False), jnp.bool_(True)
        return _Episode(state, blank, jnp.float32(0), no, no, jnp.int32(0), yes)

    def act(carry: tuple[_Episode, jax.Array], action: jax.Array) -> tuple[PyTree, None]:
        """One action of a plan, unless the plan or the episode is over."""
        episode, ended = carry
        ended |= action >= end  # or MASK
        state, found = environment.step(episode.state, jnp.minimum(action, end - 1))
        now = _advanced(episode.context, action, found)
        over = jnp.asarray(found.terminated | found.truncated) | (now.step >= max_steps)
        acted = episode._replace(
            state=state, context=now, score=episode.score + found.counted, over=over,
            success=found.success & over,
        )  # fmt: skip
        idle = ended | episode.over
        kept = jax.tree.map(lambda a, b: jnp.where(idle, a, b), episode, acted)
        return (kept, ended), None

    def play(params: Params, level_seed: jax.Array, key: jax.Array) -> _Episode:
        def replanned(episode: _Episode) -> _Episode:
            found = plan(params, plan_key(key, level_seed, episode.plans), episode.context)
            actions = found.actions[:executed]
            episode = episode._replace(plans=episode.plans + 1, valid=episode.valid & found.valid)
            (acted, _), _ = jax.lax.scan(act, (episode, jnp.bool_(False)), actions)
            return acted._replace(over=acted.over | (actions[0] >= end))  # it has given up

        return jax.lax.while_loop(lambda e: ~e.over, replanned, begin(level_seed))

    many = jax.jit(jax.vmap(play, in_axes=(None, 0, None)))

    def rollout(params: Params, seeds: Sequence[int], seed: int = 0) -> Episodes:
        begun = time.perf_counter()
        level_seeds = np.asarray(seeds)
        if not level_seeds.size:
            raise ValueError("no seeds: there is no episode to play")
        played = jax.device_get(many(params, level_seeds.astype(np.uint32), jax.random.key(seed)))
        if not played.valid.all():
            raise ValueError(
                f"the energy is NaN or -inf in {np.sum(~played.valid)} of {len(level_seeds)} "
                "episodes"
            )
        seconds = time.perf_counter() - begun
        return Episodes(
            level_seeds, played.success, played.context.step, played.score,
            int(played.plans.sum()), seconds, seconds,
        )  # fmt: skip

    return rollout


def _advanced(context: Context, action: jax.Array, found: Transition) -> Context:
    """The context after a step."""

    def shifted(past: jax.Array, latest: Array) -> jax.Array:
        return jnp.concatenate([past, jnp.asarray(latest, past.dtype)[None]])[1:]

    return Context(
        found.observation,
        jax.tree.map(shifted, context.past, context.observation),
        shifted(context.actions, found.executed(action)),
        shifted(context.rewards, found.reward),
        context.step + 1,
        context.return_so_far + found.reward,
    )
