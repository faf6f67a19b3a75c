"""Reopens a plan: masks doubtful positions of a complete plan, and fills them again."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from leapjax.planners.guard import is_undefined, score_open
from leapjax.types import Energy, Params, PyTree, mask_token

HALVES = 2
LEAST_DOUBT = 1e-6  # of a position, in nats, so that no position is left out for good

# (plan [T], key) -> plan without MASK, number of passes, whether all energies are defined
Refill = Callable[[jax.Array, jax.Array], tuple[jax.Array, jax.Array, jax.Array]]


class Reopened(NamedTuple):
    """The result of `reopen`.

    Attributes:
        actions: plan `[T]` of least doubt.
        trace: `[N, T]`, the best plan after every pass.
        valid: `[]` bool: every energy was defined.
        passes: `[]` int32.
    """

    actions: jax.Array
    trace: jax.Array
    valid: jax.Array
    passes: jax.Array


class _Search(NamedTuple):
    """The state between two rounds.

    Attributes:
        plan: plan `[T]` of the last round.
        doubts: `[T]` of its positions.
        best: plan `[T]` of least doubt so far.
        least: `[]`, its doubt.
        rounds: `[]` int32.
        trace: `[N, T]`.
        valid: `[]` bool.
        passes: `[]` int32.
    """

    plan: jax.Array
    doubts: jax.Array
    best: jax.Array
    least: jax.Array
    rounds: jax.Array
    trace: jax.Array
    valid: jax.Array
    passes: jax.Array


def doubt(
    energy: Energy, params: Params, memory: PyTree, key: jax.Array, plan: jax.Array
) -> jax.Array:
    """Returns the doubt `[T]` at each position: the energy of its action with half a plan masked.

    A random half of the plan is masked, and read in one pass; then the other half. The energies of
    a pseudo-likelihood have all other actions in view, which may be wrong together.
    """
    positions = jnp.arange(plan.shape[0])
    half = jax.random.permutation(key, positions % HALVES)
    doubts = jnp.zeros(plan.shape)
    for each in range(HALVES):
        hidden = half == each
        seen = jnp.where(hidden, mask_token(energy.num_actions), plan)
        energies = score_open(energy, params, memory, seen)
        doubts = jnp.where(hidden, energies[positions, plan], doubts)
    return doubts


def reopen(
    energy: Energy, params: Params, memory: PyTree, key: jax.Array, filled: Reopened,
    refill: Refill, *, count: int, longest: int, enough: float,
) -> Reopened:  # fmt: skip
    """Improves a complete plan in rounds, until it has little doubt or too few passes are left.

    A round draws `count` positions of the last plan without replacement, in proportion to their
    doubt, masks them and fills them again. The plan of least doubt is returned.

    Sources: ReMDM (Wang et al., 2025, arXiv 2503.00307) and P2 (Peng et al., 2025, arXiv
    2502.03540) mask tokens again, by their own conditionals.

    Args:
        energy: energy that accepts MASK.
        params: parameters of the energy.
        memory: encoded context.
        key: key of all rounds.
        filled: the first plan, and how it was made.
        refill: fills the open positions of a plan.
        count: number of positions that a round masks.
        longest: number of passes that a refill takes at most.
        enough: doubt of a plan, in nats, at which it needs no more rounds.
    """
    most = filled.trace.shape[0]

    def judge(plan: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        doubts = doubt(energy, params, memory, key, plan)
        return doubts, ~jnp.any(is_undefined(doubts))

    def improve(state: _Search) -> _Search:
        draw_key, fill_key, judge_key = jax.random.split(jax.random.fold_in(key, state.rounds), 3)
        ranks = jnp.log(jnp.maximum(state.doubts, LEAST_DOUBT))
        ranks = jnp.minimum(ranks, jnp.finfo(ranks.dtype).max)  # a forbidden action comes first
        where = jax.lax.top_k(ranks + jax.random.gumbel(draw_key, ranks.shape), count)[1]
        opened = state.plan.at[where].set(mask_token(energy.num_actions))
        plan, passes, filled_valid = refill(opened, fill_key)
        doubts, judged_valid = judge(plan, judge_key)
        passes += state.passes + HALVES
        better = doubts.sum() < state.least
        best = jnp.where(better, plan, state.best)
        return _Search(
            plan, doubts, best, jnp.minimum(doubts.sum(), state.least), state.rounds + 1,
            jnp.where(jnp.arange(most)[:, None] < passes - 1, state.trace, best),
            state.valid & filled_valid & judged_valid, passes,
        )  # fmt: skip

    doubts, valid = judge(filled.actions, jax.random.fold_in(key, most))
    start = _Search(
        filled.actions, doubts, filled.actions, doubts.sum(), jnp.zeros((), jnp.int32),
        filled.trace, filled.valid & valid, filled.passes + HALVES,
    )  # fmt: skip
    last = most - longest - HALVES  # passes behind a round that still fits
    end = jax.lax.while_loop(
        lambda state: (state.passes <= last) & ~(state.least <= enough), improve, start
    )
    return Reopened(end.best, end.trace, end.valid, end.passes)
