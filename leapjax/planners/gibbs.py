"""Gibbs sampling over action tokens (paper, algorithm 1): fill a plan, then resample it."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from leapjax.checks import check_kind
from leapjax.planners.configs import GibbsConfig, check_masks, find_selection, make_commitment
from leapjax.planners.guard import (
    check_constraints,
    compute_totals,
    guard_shapes,
    is_undefined,
    score_open,
)
from leapjax.planners.positions import choose_open, compute_probabilities
from leapjax.planners.restarts import Chain, find_best_chain, turns_contexts
from leapjax.types import Energy, Params, Plan, PyTree, mask_token


def gibbs(
    energy: Energy, params: Params, key: jax.Array, memory: PyTree, config: GibbsConfig
) -> Plan:
    """Plans by Gibbs sampling over action tokens (paper, algorithm 1), in at most N passes.

    The first iterations fill every position (see `GibbsConfig.fill`). An energy that does not
    accept MASK starts from uniform actions instead, the first of them possible. Each later
    iteration masks P positions, reads the energy of every action there, and draws actions with
    probability proportional to `exp(-energy / temperature)`.

    Filling one position at a time, at temperature 1 and with the conditionals of a joint
    distribution, draws from that joint by the chain rule. The next position may depend on the
    actions drawn before. At temperature 0 it is a search.

    Raises:
        UserError: the plan should be filled position by position or judged by halves, and the
            energy does not accept MASK.
    """
    check_kind(config, GibbsConfig)
    energy = guard_shapes(energy)
    check_masks(energy, config)

    def run(key: jax.Array, memory: PyTree) -> Chain:
        return _run_chain(energy, params, memory, key, config)

    chain = find_best_chain(energy, params, key, memory, config, run)
    best = jnp.argmin(chain.scores)
    actions = chain.trace[-config.returnable :][best]
    satisfied, defined = check_constraints(energy, params, memory, actions)
    plan = Plan(actions, chain.trace, satisfied, chain.valid & defined, chain.passes)
    # The judge knows the energies, unless it is another or saw the context turned.
    known = config.judge == "energy" and not turns_contexts(energy, config)
    if config.score and known and config.is_judged:
        plan = plan._replace(energy=chain.scores[best])
    elif config.score:
        plan, totals = _score(energy, params, memory, plan, actions[None])
        plan = plan._replace(energy=totals[0])
    if config.score_trace and known and config.keep == "best" and config.fill == "together":
        plan = plan._replace(trace_energies=chain.scores)
    elif config.score_trace:
        plan, totals = _score(energy, params, memory, plan, chain.trace)
        plan = plan._replace(trace_energies=totals)
    return plan


def _score(
    energy: Energy, params: Params, memory: PyTree, plan: Plan, plans: jax.Array
) -> tuple[Plan, jax.Array]:
    """Computes the total energies `[C]` of plans `[C, T]`; a `Plan` with their cost comes first."""
    totals = compute_totals(energy, params, memory, plans)
    valid = plan.valid & ~jnp.any(is_undefined(totals))
    return plan._replace(valid=valid, passes=plan.passes + plans.size), totals


class _Plan(NamedTuple):
    """An incomplete plan.

    Attributes:
        actions: actions `[T]`, MASK at open positions.
        age: number `[T]` of times that each position was chosen, plus half of the probability of
            its last action; `None` unless the order is "uncertain".
    """

    actions: jax.Array
    age: jax.Array | None = None


def _run_chain(
    energy: Energy, params: Params, memory: PyTree, key: jax.Array, config: GibbsConfig
) -> Chain:
    """Fills a plan, and then resamples it."""
    horizon, filling = config.horizon, config.fill_iterations
    later = config.iterations - filling
    order_key, noise_key, start_key = jax.random.split(key, 3)
    everywhere = jnp.arange(horizon)
    mask = mask_token(energy.num_actions)

    # The noise of all iterations is drawn here: a draw inside the loop costs more.
    def draw_noise(k: jax.Array, *shape: int) -> jax.Array:
        if config.temperature or config.cool_to:
            return jax.random.gumbel(k, (*shape, energy.num_actions))
        return jnp.zeros((*shape, 1))

    def query(tokens: jax.Array, where: jax.Array) -> jax.Array:
        return energy.conditional(params, memory, tokens, where)

    def draw(
        plan: _Plan, where: jax.Array, energies: jax.Array, noise: jax.Array
    ) -> tuple[_Plan, jax.Array]:
        """Draws actions at positions `[P]`; returns the plan, and whether energies are defined."""
        # Gumbel-max: the noise is multiplied by the temperature, not the energy divided by it.
        # So temperature 0 is exact, and +inf stays +inf.
        drawn = jnp.argmin(energies - noise, axis=-1).astype(jnp.int32)
        # If every action is forbidden, another position has to change: this one keeps its action
        # (action 0 in place of MASK, which is the number of actions).
        hopeless = jnp.all(jnp.isposinf(energies), axis=-1)
        drawn = jnp.where(hopeless, plan.actions[where] % energy.num_actions, drawn)
        age = plan.age
        if age is not None:
            chosen = jnp.take_along_axis(compute_probabilities(energies), drawn[:, None], axis=1)
            age = age.at[where].set(jnp.floor(age[where]) + 1 + chosen[:, 0] / 2)
        return _Plan(plan.actions.at[where].set(drawn), age), ~jnp.any(is_undefined(energies))

    def fill(
        state: tuple[_Plan, jax.Array, jax.Array, jax.Array],
    ) -> tuple[_Plan, jax.Array, jax.Array, jax.Array]:
        """Fills open positions; the others keep their actions."""
        plan, done, trace, valid = state
        open_ = plan.actions == mask
        energies = score_open(energy, params, memory, plan.actions)
        ranks = select(energies, fill_key)
        where, chosen = choose_open(energies, open_, ranks, commitment)
        drawn, defined = draw(plan, where, energies[where], fill_noise[done])
        changed = jnp.zeros(horizon, bool).at[where].set(chosen)
        plan = jax.tree.map(lambda new, old: jnp.where(changed, new, old), drawn, plan)
        return plan, done + 1, trace.at[done].set(plan.actions), valid & defined

    def resample(
        plan: _Plan, inputs: tuple[jax.Array, jax.Array]
    ) -> tuple[_Plan, tuple[jax.Array, jax.Array]]:
        """Masks P positions, and draws new actions there."""
        where, noise = inputs
        if plan.age is not None:
            where = jax.lax.top_k(-plan.age, config.resampled)[1]
        plan, defined = draw(plan, where, query(plan.actions, where), noise)
        return plan, (plan.actions, defined)

    blank = jnp.full((horizon,), mask, jnp.int32)
    plan = _Plan(blank, jnp.zeros(horizon) if config.order == "uncertain" else None)
    passes: jax.Array = jnp.ones((), jnp.int32)
    if not energy.accepts_mask:
        uniform, begun_valid = _draw_uniform_plan(energy, params, memory, start_key, horizon)
        plan, begun = plan._replace(actions=uniform), uniform[None]
    elif config.fill == "together":
        noise = config.temperature * draw_noise(start_key, horizon)
        plan, begun_valid = draw(plan, everywhere, query(blank, everywhere), noise)
        begun = plan.actions[None]
    else:
        select, commitment = find_selection(config.fill), make_commitment(config)
        fill_key = jax.random.fold_in(start_key, 1)
        most = horizon if commitment.adapts else config.resampled
        fill_noise = config.temperature * draw_noise(start_key, filling, most)
        begun = jnp.tile(blank, (filling, 1))
        plan, passes, begun, begun_valid = jax.lax.while_loop(
            lambda state: jnp.any(state[0].actions == mask),
            fill,
            (plan, jnp.zeros((), jnp.int32), begun, jnp.array(True)),
        )
        begun = jnp.where(jnp.arange(filling)[:, None] < passes, begun, plan.actions)

    positions = _order_positions(order_key, config, later)  # [N - F, P]
    last = config.temperature if config.cool_to is None else config.cool_to
    temperatures = jnp.linspace(config.temperature, last, later + 1)[1:, None, None]
    noise = temperatures * draw_noise(noise_key, later, config.resampled)  # [N - F, P, A]
    plan, (trace, valid) = jax.lax.scan(resample, plan, (positions, noise))
    trace = jnp.concatenate([begun, trace])
    scores = jnp.zeros(config.returnable)
    return Chain(trace, begun_valid & valid.all(), passes + later, scores)


def _draw_uniform_plan(
    energy: Energy, params: Params, memory: PyTree, key: jax.Array, horizon: int
) -> tuple[jax.Array, jax.Array]:
    """Draws a plan `[T]` of uniform actions; also returns whether all energies are defined.

    The first action is a possible one. A plan that begins with the end action has an infinite
    energy whatever follows, so no later position would ever change.
    """
    plan_key, first_key = jax.random.split(key)
    plan = jax.random.randint(plan_key, (horizon,), 0, energy.num_actions)
    energies = energy.conditional(params, memory, plan, jnp.zeros(1, jnp.int32))[0]  # [A]
    impossible = jnp.isposinf(energies)
    first = jax.random.categorical(first_key, jnp.where(impossible, -jnp.inf, 0.0))
    first = jnp.where(jnp.all(impossible), plan[0], first).astype(jnp.int32)
    return plan.at[0].set(first), ~jnp.any(is_undefined(energies))


def _order_positions(key: jax.Array, config: GibbsConfig, later: int) -> jax.Array:
    """Returns the positions `[N - F, P]` that later iterations resample, distinct in each."""
    shape = (later, config.resampled)
    if config.order == "sequential":
        return jnp.arange(shape[0] * shape[1]).reshape(shape) % config.horizon
    if config.resampled == 1:
        return jax.random.randint(key, shape, 0, config.horizon)
    scores = jax.random.uniform(key, (shape[0], config.horizon))
    return jnp.argsort(scores, axis=-1)[:, : config.resampled]
