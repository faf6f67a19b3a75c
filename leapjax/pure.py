"""Plays episodes entirely inside `jit`, in environments that are pure functions.

The episodes are the same as in `leapjax.rollouts.evaluate`, but rewards are summed in float32. One
call of one program plays thousands of them.
"""

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from leapjax import compilation
from leapjax.batching import check_fit, plan_key, planner_key
from leapjax.checks import check_integer, check_kind, check_seeds
from leapjax.environments import Transition
from leapjax.errors import UserError
from leapjax.planners import PlannerConfig, bind
from leapjax.rollouts import Episodes, check_actions, check_limits
from leapjax.types import Array, Context, Energy, Params, PyTree, pad_token

BOOLEAN, INTEGER = (jnp.bool_,), (jnp.integer,)
NUMBER = (jnp.floating, *INTEGER, *BOOLEAN)


class PureEnvironment(NamedTuple):
    """An environment as two pure functions of one episode.

    `step` returns states and observations with the structure, shapes and types that
    `reset` returns. Observations, rewards and scores must be finite.

    Attributes:
        reset: (key) -> (state, observation).
        step: (state, action `[]` int32) -> (state, `Transition` of arrays).
        num_actions: A, the end action included; `step` takes actions `0 .. A - 2`.
    """

    reset: Callable[[jax.Array], tuple[PyTree, PyTree]]
    step: Callable[[PyTree, jax.Array], tuple[PyTree, Transition]]
    num_actions: int


class _Episode(NamedTuple):
    """An episode in progress."""

    state: PyTree
    context: Context
    score: jax.Array  # [] float32: the reported return
    over: jax.Array  # [] bool
    success: jax.Array  # [] bool
    plans: jax.Array  # [] int32
    passes: jax.Array  # [] int32: passes of the model in all plans
    valid: jax.Array  # [] bool: no energy was NaN or -inf
    strange: jax.Array  # [] int32: the first step with a number out of range, or -1


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

    Each number of episodes compiles at its first use. Compiled programs are kept on disk, as in
    `compile_planner`.

    Args:
        environment: environment to play in.
        energy: energy to minimise, with as many actions as the environment.
        config: settings of the planner.
        context: K.
        max_steps: number of steps after which an episode is cut off.
        executed: number of actions to execute before replanning; `None` for all T.

    Returns:
        `(params, level seeds [E], seed of the planner's randomness) -> Episodes`. The episode of a
        level seed begins with `jax.random.key(level seed)`. Plans are the same as in `evaluate`.
        `planning_seconds` is the time of the whole program, which cannot time planning alone.

    Raises:
        UserError: A count is not an integer in its range, or `step` returns other structures,
            shapes or types than `reset`. The returned function raises it if there are no seeds or
            a seed is not an integer in 0 .. 2^32 - 1. It also does if 64-bit parameters do not fit
            32 bits, or the environment gave numbers that are not finite or a `taken` out of range.
        ValueError: The environment and the energy have different actions. The returned function
            raises it if an energy was NaN or -inf.
    """
    context, max_steps = check_integer("context", context), check_integer("max_steps", max_steps, 1)
    executed, _ = check_limits(executed, max_steps)
    check_kind(environment, PureEnvironment)
    check_actions("energy", check_kind(energy, Energy).num_actions, environment.num_actions)
    _check_environment(environment)
    compilation.use_disk_cache()
    plan = bind(energy, config)
    end = energy.num_actions - 1

    def begin(level_seed: jax.Array) -> _Episode:
        state, observation = environment.reset(jax.random.key(level_seed))
        observation = jax.tree.map(jnp.asarray, observation)
        past = jax.tree.map(lambda x: jnp.zeros((context, *x.shape), x.dtype), observation)
        blank = Context(
            observation, past, jnp.full(context, pad_token(end + 1), jnp.int32),
            jnp.zeros(context), jnp.int32(0), jnp.float32(0),
        )  # fmt: skip
        no, yes, zero = jnp.bool_(False), jnp.bool_(True), jnp.int32(0)
        strange = jnp.where(_is_finite(observation), -1, 0)
        return _Episode(state, blank, jnp.float32(0), no, no, zero, zero, yes, strange)

    def act(carry: tuple[_Episode, jax.Array], action: jax.Array) -> tuple[PyTree, None]:
        """Takes one action of a plan, unless the plan or the episode is over."""
        episode, ended = carry
        ended |= action >= end  # or MASK
        state, found = environment.step(episode.state, jnp.minimum(action, end - 1))
        taken = jnp.asarray(found.executed(action))
        now = _advance_context(episode.context, taken, found)
        sound = _is_finite((found[:2], found.counted)) & (taken >= 0) & (taken < end)
        over = jnp.asarray(found.terminated | found.truncated) | (now.step >= max_steps)
        acted = episode._replace(
            state=state, context=now, score=episode.score + found.counted, over=over,
            success=jnp.asarray(found.success),  # of the last step, also if the planner gives up
            strange=jnp.where(
                (episode.strange < 0) & ~sound, now.step, episode.strange
            ),
        )  # fmt: skip
        idle = ended | episode.over
        kept = jax.tree.map(lambda a, b: jnp.where(idle, a, b), episode, acted)
        return (kept, ended), None

    def play(params: Params, level_seed: jax.Array, key: jax.Array) -> _Episode:
        def replanned(episode: _Episode) -> _Episode:
            found = plan(params, plan_key(key, level_seed, episode.plans), episode.context)
            actions = found.actions[:executed]
            episode = episode._replace(
                plans=episode.plans + 1,
                passes=episode.passes + found.passes,
                valid=episode.valid & found.valid,
            )
            (acted, _), _ = jax.lax.scan(act, (episode, jnp.bool_(False)), actions)
            return acted._replace(over=acted.over | (actions[0] >= end))  # the planner gave up

        return jax.lax.while_loop(lambda e: ~e.over, replanned, begin(level_seed))

    many = jax.jit(jax.vmap(play, in_axes=(None, 0, None)))

    def rollout(params: Params, seeds: Sequence[int], seed: int = 0) -> Episodes:
        begun = time.perf_counter()
        level_seeds, key = check_seeds(seeds, "level seed"), planner_key(seed)
        if not level_seeds.size:
            raise UserError("no seeds: there is no episode to play")
        check_fit("params", params)
        played = jax.device_get(many(params, level_seeds, key))
        strange = played.strange >= 0
        if strange.any():
            first = np.argmax(strange)
            raise UserError(
                f"the environment gave numbers that are not finite (or `taken` outside of 0 .. "
                f"{end - 1}) in {strange.sum()} of {len(level_seeds)} episodes, the first at step "
                f"{played.strange[first]} of level seed {level_seeds[first]}"
            )
        if not played.valid.all():
            raise ValueError(
                f"the energy is NaN or -inf in {np.sum(~played.valid)} of {len(level_seeds)} "
                "episodes"
            )
        seconds = time.perf_counter() - begun
        return Episodes(
            np.asarray(seeds), played.success, played.context.step, played.score,
            int(played.plans.sum()), int(played.passes.sum()), seconds, seconds,
        )  # fmt: skip

    return rollout


def _check_environment(environment: PureEnvironment) -> None:
    """Compares the shapes and types that `step` and `reset` return, without running them.

    Raises:
        UserError: a part differs; the message names it and the difference.
    """
    began = jax.eval_shape(environment.reset, jax.eval_shape(jax.random.key, 0))
    if not (isinstance(began, tuple) and len(began) == 2):
        raise UserError(f"reset must return (state, observation), got {type(began).__name__}")
    led = jax.eval_shape(environment.step, began[0], jax.ShapeDtypeStruct((), jnp.int32))
    if not (isinstance(led, tuple) and len(led) == 2 and isinstance(led[1], Transition)):
        raise UserError(f"step must return (state, Transition), got {type(led).__name__}")
    state, found = led
    _check_same("state", began[0], state)
    _check_same("observation", began[1], found.observation)
    kinds = {
        "reward": ("a real number", NUMBER),
        "terminated": ("a boolean", BOOLEAN),
        "truncated": ("a boolean", BOOLEAN),
        "success": ("a boolean", BOOLEAN),
        "score": ("a real number", NUMBER),
        "taken": ("an integer", INTEGER),
    }
    for name, (kind, types) in kinds.items():
        value = getattr(found, name)
        if value is None and name in Transition._field_defaults:
            continue
        leaves = jax.tree.leaves(value)
        fits = [not leaf.shape and _is_one_of(leaf.dtype, types) for leaf in leaves]
        if fits != [True]:
            raise UserError(
                f"step must return {kind} of shape () as {name}, got {_describe_shapes(value)}"
            )


def _is_one_of(dtype: Any, types: Sequence[Any]) -> bool:
    return any(jnp.issubdtype(dtype, each) for each in types)


def _check_same(name: str, began: PyTree, led: PyTree) -> None:
    """Checks that `step` returns the structure, shapes and types that `reset` returns.

    The type of a leaf may differ if JAX promotes the type in `step` to the type in `reset`.

    Args:
        name: "state" or "observation", for the message.
        began: abstract value that `reset` returns.
        led: abstract value that `step` returns.

    Raises:
        UserError: a leaf differs; the message names the first, and the difference.
    """
    before: Any = jax.tree.structure(began)
    after: Any = jax.tree.structure(led)
    if before != after:
        raise UserError(
            f"step returns a {name} of another structure than reset: {after}, not {before}"
        )
    leaves = jax.tree.leaves(led)
    for (path, first), then in zip(jax.tree.leaves_with_path(began), leaves, strict=True):
        if first.shape != then.shape or not _is_promoted(first, then):
            raise UserError(
                f"step returns {name}{jax.tree_util.keystr(path)} as {_describe_shapes(then)}, but "
                f"reset as {_describe_shapes(first)}: expected the same"
            )


def _is_promoted(first: jax.ShapeDtypeStruct, then: jax.ShapeDtypeStruct) -> bool:
    """Returns whether a loop can carry a value that begins as `first` and goes on as `then`."""
    if first.dtype == then.dtype or first.weak_type:
        return True
    try:
        return jax.eval_shape(jnp.add, first, then).dtype == first.dtype
    except TypeError:  # random keys cannot be added
        return False


def _describe_shapes(tree: PyTree) -> str:
    """Describes shapes and types, for a message."""
    leaves = [f"{leaf.dtype}{list(leaf.shape)}" for leaf in jax.tree.leaves(tree)]
    return ", ".join(leaves) or str(tree)


def _is_finite(tree: PyTree) -> jax.Array:
    """Returns whether all floats of a tree are finite: `[]` bool."""
    leaves = [jnp.asarray(leaf) for leaf in jax.tree.leaves(tree)]
    floats = [leaf for leaf in leaves if jnp.issubdtype(leaf.dtype, jnp.floating)]
    return jnp.array([jnp.isfinite(leaf).all() for leaf in floats], bool).all()


def _advance_context(context: Context, taken: jax.Array, found: Transition) -> Context:
    """Makes the context after a step, in which an action was taken."""

    def shifted(past: jax.Array, latest: Array) -> jax.Array:
        return jnp.concatenate([past, jnp.asarray(latest, past.dtype)[None]])[1:]

    return Context(
        found.observation,
        jax.tree.map(shifted, context.past, context.observation),
        shifted(context.actions, taken),
        shifted(context.rewards, found.reward),
        context.step + 1,
        context.return_so_far + found.reward,
    )
