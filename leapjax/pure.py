"""Plan, act, replan entirely inside `jit`, for environments that are pure functions.

The same episodes as `leapjax.rollouts.evaluate`, thousands of them in one call of one program.
"""

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

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

    A step hands on what a reset began: states and observations of the same structure, shapes and
    types, numbers that are finite.

    Attributes:
        reset: (key) -> state, observation.
        step: (state, action `[]` int32) -> state, what the step gave, as arrays.
        num_actions: A, the end action included: the environment has A - 1.
    """

    reset: Callable[[jax.Array], tuple[PyTree, PyTree]]
    step: Callable[[PyTree, jax.Array], tuple[PyTree, Transition]]
    num_actions: int


class _Episode(NamedTuple):
    """An episode under way."""

    state: PyTree
    context: Context
    score: jax.Array  # [] float32: its return as reported
    over: jax.Array  # [] bool
    success: jax.Array  # [] bool
    plans: jax.Array  # [] int32
    valid: jax.Array  # [] bool: no energy met was NaN
    strange: jax.Array  # [] int32: the first step that gave a number that is not finite; -1: none


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
        max_steps: of an episode, at most; it is then cut off.
        executed: actions to execute before replanning; None for all T.

    Returns:
        `(params, level seeds [E], seed of the planner's randomness) -> Episodes`. The episode of a
        level seed begins with `jax.random.key(level seed)`; plans are those of `evaluate`. The
        time of planning cannot be told from the rest of the program: it is all of it.

    Raises:
        UserError: a count that is not an integer of its range, other actions than the energy's, or
            a step that returns something else than the reset began; raised by the function
            returned, a seed that is not an integer in 0 .. 2^32 - 1, parameters of 64 bits that do
            not fit 32, or an environment that gave numbers that are not finite.
        ValueError: raised by the function returned, an energy that was NaN.
    """
    context, max_steps = check_integer("context", context), check_integer("max_steps", max_steps, 1)
    executed, _ = check_limits(executed, max_steps)
    check_kind(environment, PureEnvironment)
    check_actions("energy", check_kind(energy, Energy).num_actions, environment.num_actions)
    _check_environment(environment)
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
        no, yes = jnp.bool_(False), jnp.bool_(True)
        strange = jnp.where(_is_finite(observation), -1, 0)
        return _Episode(state, blank, jnp.float32(0), no, no, jnp.int32(0), yes, strange)

    def act(carry: tuple[_Episode, jax.Array], action: jax.Array) -> tuple[PyTree, None]:
        """One action of a plan, unless the plan or the episode is over."""
        episode, ended = carry
        ended |= action >= end  # or MASK
        state, found = environment.step(episode.state, jnp.minimum(action, end - 1))
        now = _advance_context(episode.context, action, found)
        over = jnp.asarray(found.terminated | found.truncated) | (now.step >= max_steps)
        acted = episode._replace(
            state=state, context=now, score=episode.score + found.counted, over=over,
            success=found.success & over,
            strange=jnp.where(
                (episode.strange < 0) & ~_is_finite((found[:2], found.counted)),
                now.step, episode.strange,
            ),
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
        level_seeds, key = check_seeds(seeds, "level seed"), planner_key(seed)
        if not level_seeds.size:
            raise UserError("no seeds: there is no episode to play")
        check_fit("params", params)
        played = jax.device_get(many(params, level_seeds, key))
        strange = played.strange >= 0
        if strange.any():
            first = np.argmax(strange)
            raise UserError(
                f"the environment gave numbers that are not finite in {strange.sum()} of "
                f"{len(level_seeds)} episodes, the first at step {played.strange[first]} of level "
                f"seed {level_seeds[first]}"
            )
        if not played.valid.all():
            raise ValueError(
                f"the energy is NaN or -inf in {np.sum(~played.valid)} of {len(level_seeds)} "
                "episodes"
            )
        seconds = time.perf_counter() - begun
        return Episodes(
            np.asarray(seeds), played.success, played.context.step, played.score,
            int(played.plans.sum()), seconds, seconds,
        )  # fmt: skip

    return rollout


def _check_environment(environment: PureEnvironment) -> None:
    """Compares what a step returns with what a reset returns, without computing either.

    Raises:
        UserError: names the part that differs, and how.
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
    """Checks that a step hands on what a reset began, as abstract values.

    Types may differ where JAX promotes that of the step to that of the reset.

    Raises:
        UserError: names the first leaf that differs, and how.
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
    """Whether a loop can carry a value that begins as `first` and goes on as `then`."""
    if first.dtype == then.dtype or first.weak_type:
        return True
    try:
        return jax.eval_shape(jnp.add, first, then).dtype == first.dtype
    except TypeError:  # keys of random numbers are added to nothing
        return False


def _describe_shapes(tree: PyTree) -> str:
    """Shapes and types in a message."""
    leaves = [f"{leaf.dtype}{list(leaf.shape)}" for leaf in jax.tree.leaves(tree)]
    return ", ".join(leaves) or str(tree)


def _is_finite(tree: PyTree) -> jax.Array:
    """`[]` bool: whether all floats of a tree are finite."""
    leaves = [jnp.asarray(leaf) for leaf in jax.tree.leaves(tree)]
    floats = [leaf for leaf in leaves if jnp.issubdtype(leaf.dtype, jnp.floating)]
    return jnp.array([jnp.isfinite(leaf).all() for leaf in floats], bool).all()


def _advance_context(context: Context, action: jax.Array, found: Transition) -> Context:
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
