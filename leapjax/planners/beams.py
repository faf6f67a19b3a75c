"""Beam search over partial plans, in any order of positions."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from leapjax.checks import check_kind
from leapjax.planners.configs import BeamConfig, check_masks, find_selection, make_commitment
from leapjax.planners.guard import (
    check_constraints,
    guard_shapes,
    is_undefined,
    map_few,
    score_open,
)
from leapjax.planners.judges import JUDGES
from leapjax.planners.positions import choose_open
from leapjax.types import Energy, Params, Plan, PyTree, mask_token, no_violation


class _Beams(NamedTuple):
    """W partial plans, the best first.

    Attributes:
        plans: actions `[W, T]`, MASK at open positions.
        sums: sum `[W]` of the conditional energies of the chosen actions.
        likelihoods: log-probability `[W]` of drawing the choices, at the temperature.
        ranks: likelihoods `[W]` with noise; the highest ranks survive.
        dead: booleans `[W]`: no plan, a plan of probability 0, or a plan that breaks a constraint
            whatever follows.
    """

    plans: jax.Array
    sums: jax.Array
    likelihoods: jax.Array
    ranks: jax.Array
    dead: jax.Array


def beam_search(
    energy: Energy, params: Params, key: jax.Array, memory: PyTree, config: BeamConfig
) -> Plan:
    """Searches for the plan of least energy among W partial plans, in at most T passes for each.

    In every pass each beam chooses its next position (`BeamConfig.fill`) while the others stay
    open, and branches there: one continuation for each action. The best W continuations of all
    beams survive. A beam's sum adds the conditional energies of its actions. With exact
    conditionals of a joint distribution it is the negative log-probability of these actions,
    whatever their order.

    At temperature 0 the W least sums survive; with W = A^(T - 1) it finds the plan of least sum.
    Above it, W continuations are drawn without replacement, each action with probability
    proportional to `exp(-energy / temperature)` (stochastic beam search, Kool et al., 2019). One
    beam then draws a plan action by action. A beam that breaks a constraint of infinite penalty is
    kept only if too few others are left. The trace holds the first beam after every pass.

    Raises:
        UserError: the energy does not accept MASK where beams of this configuration leave it.
    """
    check_kind(config, BeamConfig)
    energy = guard_shapes(energy)
    check_masks(energy, config)
    judge = None if config.judge == "sum" else JUDGES[config.judge]
    actions, width, horizon = energy.num_actions, config.beams, config.horizon
    mask = mask_token(actions)
    select, commitment = find_selection(config.fill), make_commitment(config)

    def grow(plan: jax.Array, select_key: jax.Array) -> tuple[jax.Array, ...]:
        """Chooses the next position of a beam.

        Returns:
            The plan after the fill, the sum of the energies that this added, the position to branch
            at, the energies `[A]` there, and whether all energies are defined.
        """
        open_ = plan == mask
        if config.fill == "sequential" and not commitment.adapts:
            # The next position does not depend on energies, so the pass scores no other.
            branch, filled, paid = jnp.argmax(open_), plan, jnp.zeros(())
            energies = energy.conditional(params, memory, plan, branch[None])
            branches = energies[0]
        else:
            energies = score_open(energy, params, memory, plan)
            where, chosen = choose_open(energies, open_, select(energies, select_key), commitment)
            branch = where[jnp.maximum(chosen.sum() - 1, 0)]
            sure = jnp.zeros(horizon, bool).at[where].set(chosen).at[branch].set(False)
            filled = jnp.where(sure, jnp.argmin(energies, axis=-1).astype(jnp.int32), plan)
            paid = jnp.where(sure, energies.min(axis=-1), 0).sum()
            branches = energies[branch]
        # A complete plan has one continuation: itself.
        same = jnp.where(jnp.arange(actions) == plan[branch], 0.0, jnp.inf)
        branches = jnp.where(open_.any(), branches, same)
        return filled, paid, branch, branches, ~jnp.any(is_undefined(energies))

    def extend(
        state: tuple[_Beams, jax.Array, jax.Array, jax.Array],
    ) -> tuple[_Beams, jax.Array, jax.Array, jax.Array]:
        beams, done, trace, valid = state
        grown = jax.vmap(grow, in_axes=(0, None))(beams.plans, select_key)
        plans, paid, branch, energies, defined = grown
        impossible = _is_impossible(beams)
        sums = (beams.sums + paid)[:, None] + energies  # [W, A]
        sums = jnp.where(impossible[:, None], jnp.inf, sums)
        likelihoods = ranks = -sums
        if config.temperature:
            likelihoods, ranks = _draw_ranks(draw_keys[done], beams, energies, config.temperature)
        children = jax.vmap(lambda plan, at: jnp.tile(plan, (actions, 1)).at[:, at].set(choices))(
            plans, branch
        )  # [W, A, T]
        dead = beams.dead[:, None] | jnp.isposinf(sums)
        if energy.violation is not no_violation:
            dead |= jnp.isposinf(jax.vmap(jax.vmap(violate))(children))
        order = jnp.lexsort((-ranks.reshape(-1), dead.reshape(-1)))[:width]
        beams = _Beams(
            children.reshape(-1, horizon)[order],
            *(leaf.reshape(-1)[order] for leaf in (sums, likelihoods, ranks, dead)),
        )
        valid &= (defined | impossible).all()
        return beams, done + 1, trace.at[done].set(beams.plans[0]), valid

    def violate(plan: jax.Array) -> jax.Array:
        return energy.violation(params, memory, plan)

    def is_incomplete(state: tuple[_Beams, jax.Array, jax.Array, jax.Array]) -> jax.Array:
        open_ = jnp.any(state[0].plans == mask, axis=-1)
        return jnp.any(open_ & (~state[0].dead | state[0].dead.all()))

    choices = jnp.arange(actions, dtype=jnp.int32)
    blank = jnp.full((width, horizon), mask, jnp.int32)
    # One beam starts; copies of it would only repeat its continuations.
    missing = jnp.arange(width) > 0
    sums = jnp.where(missing, jnp.inf, 0.0)
    # One key per pass draws beams; one key ranks positions, the same in every pass.
    draw_keys, select_key = jax.random.split(key, horizon), jax.random.fold_in(key, 1)
    start = _Beams(blank, sums, -sums, -sums, missing)
    beams, done, trace, valid = jax.lax.while_loop(
        is_incomplete,
        extend,
        (start, jnp.zeros((), jnp.int32), blank[:1].repeat(horizon, 0), jnp.array(True)),
    )
    passes = done * width
    judged = beams.sums
    if judge is not None:
        judge_key = jax.random.fold_in(key, 2)
        judged = map_few(
            lambda plan: judge.score(energy, params, memory, judge_key, plan), beams.plans
        )
        valid &= ~jnp.any(is_undefined(judged) & ~_is_impossible(beams))
        passes += width * judge.count_passes(horizon)
    found = jnp.lexsort((judged, beams.dead))[0]
    best = beams.plans[found]
    trace = jnp.where(jnp.arange(horizon)[:, None] < done - 1, trace, best)
    satisfied, defined = check_constraints(energy, params, memory, best)
    plan = Plan(best, trace, satisfied, valid & defined, passes)
    if config.score and config.judge == "energy":
        plan = plan._replace(energy=judged[found])
    elif config.score:
        total = energy.total(params, memory, best)
        plan = plan._replace(
            energy=total, valid=valid & ~is_undefined(total), passes=passes + horizon
        )
    return plan


def _is_impossible(beams: _Beams) -> jax.Array:
    """Tells which beams `[W]` have probability 0, if not all: their energies may be undefined."""
    impossible = jnp.isposinf(beams.sums)
    return impossible & ~impossible.all()


def _draw_ranks(
    key: jax.Array, beams: _Beams, energies: jax.Array, temperature: float
) -> tuple[jax.Array, jax.Array]:
    """Draws the log-likelihoods and ranks `[W, A]` of the continuations of all beams.

    The highest rank among the continuations of a beam equals the rank of the beam (Kool et al.,
    2019, algorithm 1). So the ranks of complete plans are log-probabilities plus independent Gumbel
    noise, and the highest W are a sample without replacement.

    Args:
        key: key of the noise.
        beams: beams that branch.
        energies: energy `[W, A]` of every action.
        temperature: temperature of the draw, positive.
    """
    # The least energy is subtracted first, so that the lowest temperature is a greedy choice.
    least = energies.min(axis=1, keepdims=True)
    hopeless = jnp.isinf(least) | jnp.isinf(beams.likelihoods)[:, None]
    likelihoods = jnp.where(hopeless, 0, jax.nn.log_softmax((least - energies) / temperature))
    noisy = likelihoods + jax.random.gumbel(key, energies.shape)
    highest = noisy.max(axis=1, keepdims=True)
    wanted = jnp.where(hopeless, 0, (beams.ranks - beams.likelihoods)[:, None])
    # -log(exp(-wanted) - exp(-highest) + exp(-noisy)), in a form that does not overflow.
    excess = wanted - noisy + jnp.log1p(-jnp.exp(noisy - highest))
    ranks = wanted - jnp.maximum(excess, 0) - jnp.log1p(jnp.exp(-jnp.abs(excess)))

    def after(each: jax.Array) -> jax.Array:
        return jnp.where(hopeless, -jnp.inf, each + beams.likelihoods[:, None])

    return after(likelihoods), after(ranks)
