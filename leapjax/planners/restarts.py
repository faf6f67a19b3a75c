"""Restarts: several chains for one context, of which a judge takes the best plan."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from leapjax.planners.configs import GibbsConfig
from leapjax.planners.guard import is_undefined, map_few
from leapjax.planners.judges import JUDGES
from leapjax.types import Energy, Params, PyTree, no_turn


class Chain(NamedTuple):
    """The result of a chain, or of the best of some chains.

    Attributes:
        trace: actions `[N, T]` after every iteration.
        valid: `[]` bool: every energy was defined, in all chains.
        passes: `[]` int32, of all chains and the judge.
        scores: `[C]`, the judge's scores of the plans that may be returned, the last C of the
            trace. 0 while nobody has judged.
    """

    trace: jax.Array
    valid: jax.Array
    passes: jax.Array
    scores: jax.Array


Run = Callable[[jax.Array, PyTree], Chain]  # (key, memory) -> chain, not judged


def turns_contexts(energy: Energy, config: GibbsConfig) -> bool:
    """Tells whether each restart sees the context turned by a symmetry of its own."""
    return config.restarts > 1 and energy.turn is not no_turn


def find_best_chain(
    energy: Energy, params: Params, key: jax.Array, memory: PyTree, config: GibbsConfig, run: Run
) -> Chain:
    """Runs the chains of all restarts, and returns the one with the best plan.

    If the energy knows symmetries, each restart sees the context turned by its own; the judge sees
    what the restart saw.
    """
    judge = JUDGES[config.judge]
    turns, kept = turns_contexts(energy, config), config.returnable
    judge_key = jax.random.fold_in(key, 1)

    def look(key: jax.Array) -> PyTree:
        """Returns the memory that a restart sees."""
        return energy.turn(params, jax.random.fold_in(key, 1), memory) if turns else memory

    def score(plan: jax.Array, seen: PyTree) -> jax.Array:
        return judge.score(energy, params, seen, judge_key, plan)

    def add_scores(chain: Chain, scores: jax.Array) -> Chain:
        passes = chain.passes + scores.size * judge.count_passes(config.horizon)
        return Chain(chain.trace, chain.valid & ~jnp.any(is_undefined(scores)), passes, scores)

    def run_and_judge(key: jax.Array) -> Chain:
        seen = look(key)
        chain = run(key, seen)
        return add_scores(chain, map_few(lambda plan: score(plan, seen), chain.trace[-kept:]))

    if config.restarts == 1:
        return run_and_judge(key) if config.is_judged else run(key, memory)
    keys = jax.random.split(key, config.restarts)
    if config.enough is not None:
        return _run_in_turn(run_and_judge, keys, config.enough)

    seen = jax.vmap(look)(keys) if turns else memory
    chains = jax.vmap(run, in_axes=(0, 0 if turns else None))(keys, seen)

    # Scores are computed a few at a time: a judge may make a copy of a plan for each action.
    def score_row(plan: jax.Array, row: jax.Array) -> jax.Array:
        return score(plan, jax.tree.map(lambda leaf: leaf[row], seen) if turns else seen)

    plans = chains.trace[:, -kept:].reshape(-1, config.horizon)
    scores = map_few(score_row, plans, jnp.repeat(jnp.arange(config.restarts), kept))
    best = jnp.argmin(scores) // kept
    chain = Chain(chains.trace[best], chains.valid.all(), chains.passes.sum(), chains.scores[best])
    return add_scores(chain, scores)._replace(scores=scores.reshape(-1, kept)[best])


def _run_in_turn(run: Callable[[jax.Array], Chain], keys: jax.Array, enough: float) -> Chain:
    """Runs one chain after the other, until the score of a plan is `enough`; the best of them."""

    def goes_on(state: tuple[Chain, jax.Array]) -> jax.Array:
        best, done = state
        return (done < len(keys)) & ~jnp.any(best.scores <= enough)

    def improve(state: tuple[Chain, jax.Array]) -> tuple[Chain, jax.Array]:
        best, done = state
        chain = run(keys[done])
        better = chain.scores.min() < best.scores.min()
        new = jax.tree.map(lambda mine, old: jnp.where(better, mine, old), chain, best)
        valid, passes = best.valid & chain.valid, best.passes + chain.passes
        return new._replace(valid=valid, passes=passes), done + 1

    return jax.lax.while_loop(goes_on, improve, (run(keys[0]), jnp.ones((), jnp.int32)))[0]
