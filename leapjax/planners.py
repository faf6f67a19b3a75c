"""Planners: `(energy, params, key, memory, config) -> Plan`, pure, for one context.

They know only `Energy`; `memory` is what its `encode` made of the context. `leapjax.batching` makes
one of them plan for any number of contexts.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from leapjax.checks import check_at_least, check_floats, check_kind, check_number, check_types
from leapjax.types import Energy, Params, Plan, PyTree, mask_token

HOTTEST = 1e30  # so that noise times temperature is a number
FILLS = ("together", "confident", "margin", "sequential", "random")
ORDERS = ("random", "sequential", "uncertain")


def check_temperature(temperature: float) -> None:
    """Checks a temperature.

    Raises:
        ValueError: not a number, negative, NaN or too large.
    """
    check_number("a temperature", temperature, 0, HOTTEST)


@dataclasses.dataclass(frozen=True)
class GibbsConfig:
    """Iterative planning through energy minimisation (paper, algorithm 1).

    Attributes:
        horizon: T, planned actions.
        iterations: N, passes of the model, those that fill the plan included.
        resampled: P, positions chosen together in a pass, except where a pass fills all.
        fill: How the first plan is made. "together": all positions in one pass, as in the paper.
            Otherwise P positions in each pass, while the others stay MASK: the most certain ones by
            the probability of the likeliest action ("confident") or by its lead over the
            second ("margin"), those from left to right ("sequential"), or those in "random" order.
        order: Which P positions every later iteration resamples: "random" ones, the next from left
            to right ("sequential"), or those that were least certain when they were chosen, each
            once before any is again ("uncertain").
        temperature: Temperature at which actions are drawn; 0 takes the most likely action.
        restarts: R, independent plans, of which the one of least energy is kept.
        score: Also return the energy of the plan, for T more passes.
        score_trace: Also return the energy after every iteration, for N * T more passes.
    """

    horizon: int = 5
    iterations: int = 10
    resampled: int = 1
    fill: str = "together"
    order: str = "random"
    temperature: float = 0.0
    restarts: int = 1
    score: bool = False
    score_trace: bool = False

    def __post_init__(self) -> None:
        check_types(self)
        check_at_least(self, 1, "horizon", "iterations", "resampled", "restarts")
        if self.resampled > self.horizon:
            raise ValueError(
                f"resampled is {self.resampled}, more positions than the horizon {self.horizon}"
            )
        check_temperature(self.temperature)
        for name, known in {"fill": FILLS, "order": ORDERS}.items():
            value = getattr(self, name)
            if value not in known:
                raise ValueError(f"unknown {name} {value!r}: expected one of {', '.join(known)}")
        if self.iterations < self.fill_iterations:
            raise ValueError(
                f"fill {self.fill!r} chooses {self.resampled} of {self.horizon} actions in a pass, "
                f"so it needs {self.fill_iterations} iterations, got {self.iterations}"
            )

    @property
    def fill_iterations(self) -> int:
        """The passes after which no position is MASK."""
        return 1 if self.fill == "together" else -(-self.horizon // self.resampled)


@dataclasses.dataclass(frozen=True)
class ShootingConfig:
    """Random shooting (paper, appendix, ablation): the best of random plans.

    Attributes:
        horizon: T, planned actions.
        candidates: Uniformly drawn plans, of which the one of least energy is kept.
        score: Also return the energy of the plan, which is known anyway.
    """

    horizon: int = 5
    candidates: int = 30
    score: bool = False

    def __post_init__(self) -> None:
        check_types(self)
        check_at_least(self, 1, "horizon", "candidates")


@dataclasses.dataclass(frozen=True)
class CrossEntropyConfig:
    """The cross-entropy method as the paper's appendix describes it.

    Attributes:
        horizon: T, planned actions.
        iterations: N, rounds; the first draws uniform plans.
        candidates: Plans in each round.
        elites: Plans of least energy. They survive, and are the parents of the next round: each
            child changes one action.
        score: Also return the energy of the plan.
    """

    horizon: int = 5
    iterations: int = 10
    candidates: int = 30
    elites: int = 3
    score: bool = False

    def __post_init__(self) -> None:
        check_types(self)
        check_at_least(self, 1, "horizon", "iterations", "candidates", "elites")
        if self.elites > self.candidates:
            raise ValueError(f"{self.elites} elites out of {self.candidates} candidates")


@dataclasses.dataclass(frozen=True)
class BeamConfig:
    """Beam search, from left to right: the best of the plans that began well.

    Attributes:
        horizon: T, planned actions.
        beams: W, partial plans that are kept.
        temperature: 0 keeps the best beams; above it beams are drawn, all different.
        score: Also return the energy of the plan.
    """

    horizon: int = 5
    beams: int = 10
    temperature: float = 0.0
    score: bool = False

    def __post_init__(self) -> None:
        check_types(self)
        check_at_least(self, 1, "horizon", "beams")
        check_temperature(self.temperature)

    @property
    def iterations(self) -> int:
        """Passes: each chooses one action of every plan."""
        return self.horizon


def undefined(energies: jax.Array) -> jax.Array:
    """Where an energy means nothing: NaN, or -inf, against which nothing can be weighed."""
    return jnp.isnan(energies) | jnp.isneginf(energies)


PlannerConfig = GibbsConfig | ShootingConfig | CrossEntropyConfig | BeamConfig


def guard_shapes(energy: Energy) -> Energy:
    """Returns an energy that refuses results of wrong shapes, or that are not real numbers.

    Raises:
        UserError: it is no `Energy`.
    """
    check_kind(energy, Energy)

    def conditional(
        params: Params, memory: PyTree, actions: jax.Array, positions: jax.Array
    ) -> jax.Array:
        energies = energy.conditional(params, memory, actions, positions)
        return check_floats(
            "conditional of the energy", energies, (positions.shape[0], energy.num_actions)
        )

    def total(params: Params, memory: PyTree, actions: jax.Array) -> jax.Array:
        found = energy.total(params, memory, actions)
        return check_floats("total of the energy", found, ())

    def violation(params: Params, memory: PyTree, actions: jax.Array) -> jax.Array:
        found = energy.violation(params, memory, actions)
        return check_floats("violation of the energy", found, ())

    return energy._replace(conditional=conditional, total=total, violation=violation)


def gibbs(
    energy: Energy, params: Params, key: jax.Array, memory: PyTree, config: GibbsConfig
) -> Plan:
    """Gibbs sampling over action tokens (paper, algorithm 1): N passes in all.

    The first iterations fill every position (see `GibbsConfig.fill`; for an energy that does not
    accept MASK the first plan is uniform, of plans whose first action is possible); each later
    one masks P positions, reads the energy of every action there, and draws actions with
    probability proportional to `exp(-energy / temperature)`.

    Filling one position at a time, at temperature 1 and with the conditionals of a joint
    distribution, draws from that joint: it is the chain rule, and which position comes next may
    depend on what was drawn before. At temperature 0 it is a search.

    Raises:
        ValueError: a plan should be filled position by position, and the energy accepts no MASK.
    """
    if config.fill != "together" and not energy.accepts_mask:
        raise ValueError(
            f"fill {config.fill!r} chooses actions while others are MASK, and this energy scores "
            "complete plans only (accepts_mask is False): use fill 'together'"
        )
    energy = guard_shapes(energy)
    chain = functools.partial(_gibbs_chain, energy, params, memory, config=config)
    if config.restarts == 1:
        actions, trace, valid = chain(key)
        least = None
    else:
        plans, traces, valids = jax.vmap(chain)(jax.random.split(key, config.restarts))
        energies = jax.vmap(lambda a: energy.total(params, memory, a))(plans)
        best = jnp.argmin(energies)
        actions, trace, least = plans[best], traces[best], energies[best]
        valid = jnp.all(valids) & ~jnp.any(undefined(energies))
    plan = Plan(actions, trace, energy.violation(params, memory, actions) <= 0, valid)
    if config.score:
        least = energy.total(params, memory, actions) if least is None else least
        plan = plan._replace(energy=least, valid=plan.valid & ~undefined(least))
    if config.score_trace:
        scores = jax.vmap(lambda a: energy.total(params, memory, a))(trace)
        plan = plan._replace(trace_energies=scores, valid=plan.valid & ~jnp.any(undefined(scores)))
    return plan


class _Chain(NamedTuple):
    """A plan in the making."""

    actions: jax.Array  # [T] int32; MASK where none is chosen yet
    age: jax.Array | None = None  # [T] how often each position was chosen, and for a fraction
    # half of the probability of what was; only where the order is "uncertain"


def _gibbs_chain(
    energy: Energy, params: Params, memory: PyTree, key: jax.Array, config: GibbsConfig
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """One chain: final actions `[T]`, the actions after every iteration `[N, T]`, `valid`."""
    horizon, filling = config.horizon, config.fill_iterations
    later = config.iterations - filling
    order_key, noise_key, start_key = jax.random.split(key, 3)
    everywhere = jnp.arange(horizon)
    mask = mask_token(energy.num_actions)

    # All randomness is drawn at once, before the loop: inside it costs more than the draws.
    def noise(k: jax.Array, *shape: int) -> jax.Array:
        if config.temperature:
            return jax.random.gumbel(k, (*shape, energy.num_actions))
        return jnp.zeros((*shape, 1))

    def energies_at(tokens: jax.Array, where: jax.Array) -> jax.Array:
        return energy.conditional(params, memory, tokens, where)

    def draw(
        chain: _Chain, where: jax.Array, energies: jax.Array, gumbel: jax.Array
    ) -> tuple[_Chain, jax.Array]:
        """The chain with new actions at positions `[P]`; whether no energy was NaN."""
        # Gumbel-max. Noise times temperature, not energy over temperature: exact at 0, and
        # +inf stays +inf.
        drawn = jnp.argmin(energies - config.temperature * gumbel, axis=-1).astype(jnp.int32)
        # Where every action is forbidden another position has to change: leave this one
        # (and 0 for MASK, which is the number of actions).
        hopeless = jnp.all(jnp.isinf(energies), axis=-1)
        drawn = jnp.where(hopeless, chain.actions[where] % energy.num_actions, drawn)
        age = chain.age
        if age is not None:
            chosen = jnp.take_along_axis(_probabilities(energies), drawn[:, None], axis=1)[:, 0]
            age = age.at[where].set(jnp.floor(age[where]) + 1 + chosen / 2)
        return _Chain(chain.actions.at[where].set(drawn), age), ~jnp.any(undefined(energies))

    def fill(
        chain: _Chain, inputs: tuple[jax.Array, jax.Array]
    ) -> tuple[_Chain, tuple[jax.Array, jax.Array]]:
        """P positions that are MASK get actions; the others stay as they are."""
        turn, gumbel = inputs
        masked = chain.actions == mask
        # One pass scores all that is masked. (A position that is not would become MASK by being
        # asked for: one that is stands in for it.)
        energies = energies_at(chain.actions, jnp.where(masked, everywhere, jnp.argmax(masked)))
        ranks = jnp.where(masked, _fill_ranks(energies, turn, config.fill), -jnp.inf)
        where = jax.lax.top_k(ranks, config.resampled)[1]
        drawn, valid = draw(chain, where, energies[where], gumbel)
        # The last pass may have fewer than P left.
        chain = jax.tree.map(lambda new, old: jnp.where(masked, new, old), drawn, chain)
        return chain, (chain.actions, valid)

    def resample(
        chain: _Chain, inputs: tuple[jax.Array, jax.Array]
    ) -> tuple[_Chain, tuple[jax.Array, jax.Array]]:
        """P positions are masked, and get new actions."""
        where, gumbel = inputs
        if chain.age is not None:
            where = jax.lax.top_k(-chain.age, config.resampled)[1]
        chain, valid = draw(chain, where, energies_at(chain.actions, where), gumbel)
        return chain, (chain.actions, valid)

    blank = jnp.full((horizon,), mask, jnp.int32)
    chain = _Chain(blank, jnp.zeros(horizon) if config.order == "uncertain" else None)
    if not energy.accepts_mask:
        uniform, begun_valid = _uniform_plan(energy, params, memory, start_key, horizon)
        chain, begun = chain._replace(actions=uniform), uniform[None]
    elif config.fill == "together":
        chain, begun_valid = draw(
            chain, everywhere, energies_at(blank, everywhere), noise(start_key, horizon)
        )
        begun = chain.actions[None]
    else:
        turns = jax.random.uniform(jax.random.fold_in(start_key, 1), (horizon,))
        turns = jnp.broadcast_to(turns, (filling, horizon))
        inputs = turns, noise(start_key, filling, config.resampled)
        chain, (begun, begun_valid) = jax.lax.scan(fill, chain, inputs)

    positions = _scan_order(order_key, config, later)  # [N - F, P]
    gumbel = noise(noise_key, later, config.resampled)  # [N - F, P, A]
    chain, (trace, valid) = jax.lax.scan(resample, chain, (positions, gumbel))
    return chain.actions, jnp.concatenate([begun, trace]), jnp.all(begun_valid) & valid.all()


def _uniform_plan(
    energy: Energy, params: Params, memory: PyTree, key: jax.Array, horizon: int
) -> tuple[jax.Array, jax.Array]:
    """A plan `[T]` of uniform actions, the first among those that can be; whether none was NaN.

    A plan that begins with its end has an infinite energy whatever follows, so that no later
    position would ever be changed.
    """
    plan_key, first_key = jax.random.split(key)
    plan = jax.random.randint(plan_key, (horizon,), 0, energy.num_actions)
    energies = energy.conditional(params, memory, plan, jnp.zeros(1, jnp.int32))[0]  # [A]
    impossible = jnp.isposinf(energies)
    first = jax.random.categorical(first_key, jnp.where(impossible, -jnp.inf, 0.0))
    first = jnp.where(jnp.all(impossible), plan[0], first).astype(jnp.int32)
    return plan.at[0].set(first), ~jnp.any(undefined(energies))


def _probabilities(energies: jax.Array) -> jax.Array:
    """Of each action `[P, A]`; 0 where all are forbidden."""
    return jnp.nan_to_num(jax.nn.softmax(-energies, axis=-1))


def _fill_ranks(energies: jax.Array, turn: jax.Array, fill: str) -> jax.Array:
    """Which of the positions that are MASK come first: `[T]`, the highest does.

    Certainty by margin is of Kim et al., 2025 (arXiv 2502.06768), by probability of Chang et al.,
    2022 (MaskGIT).

    Args:
        energies: `[T, A]`.
        turn: `[T]` random numbers.
        fill: of `FILLS`.
    """
    if fill == "random":
        return turn
    if fill == "sequential":
        return -jnp.arange(turn.shape[0], dtype=jnp.float32)
    likeliest = jax.lax.top_k(_probabilities(energies), min(2, energies.shape[-1]))[0]
    return likeliest[:, 0] if fill == "confident" else likeliest[:, 0] - likeliest[:, -1]


def _scan_order(key: jax.Array, config: GibbsConfig, later: int) -> jax.Array:
    """The positions of the iterations after the first plan: `[N - F, P]`, distinct in each."""
    shape = (later, config.resampled)
    if config.order == "sequential":
        return jnp.arange(shape[0] * shape[1]).reshape(shape) % config.horizon
    if config.resampled == 1:
        return jax.random.randint(key, shape, 0, config.horizon)
    scores = jax.random.uniform(key, (shape[0], config.horizon))
    return jnp.argsort(scores, axis=-1)[:, : config.resampled]


def _choices(energy: Energy, params: Params, memory: PyTree, horizon: int) -> jax.Array:
    """Logits `[T, A]` of a uniform action at every position: 0, and -inf where it cannot be.

    That is where its energy is infinite before anything is chosen, as an end action's is at the
    first position of a plan: nothing that is chosen later changes that. An energy that accepts no
    MASK cannot be asked.
    """
    if not energy.accepts_mask:
        return jnp.zeros((horizon, energy.num_actions))
    blank = jnp.full((horizon,), mask_token(energy.num_actions), jnp.int32)
    energies = energy.conditional(params, memory, blank, jnp.arange(horizon))
    return jnp.where(jnp.isposinf(energies), -jnp.inf, 0.0)


def _random_plans(key: jax.Array, choices: jax.Array, count: int) -> jax.Array:
    """`count` plans `[C, T]` of uniform actions, see `_choices`."""
    plans = jax.random.categorical(key, choices, shape=(count, choices.shape[0]))
    return plans.astype(jnp.int32)


def random_shooting(
    energy: Energy, params: Params, key: jax.Array, memory: PyTree, config: ShootingConfig
) -> Plan:
    """The random plan of least energy (paper, appendix, ablation), of those that can be."""
    energy = guard_shapes(energy)
    choices = _choices(energy, params, memory, config.horizon)
    plans = _random_plans(key, choices, config.candidates)
    energies = jax.vmap(lambda a: energy.total(params, memory, a))(plans)
    best = jnp.argmin(energies)
    plan = Plan(
        plans[best],
        plans[best][None],
        energy.violation(params, memory, plans[best]) <= 0,
        ~jnp.any(undefined(energies)),
    )
    return plan._replace(energy=energies[best]) if config.score else plan


def cross_entropy_method(
    energy: Energy, params: Params, key: jax.Array, memory: PyTree, config: CrossEntropyConfig
) -> Plan:
    """Keep the elites, change one token in each child (paper, appendix, ablation).

    The plan returned is the best of the last round, as in the paper. Elites survive unchanged, so
    it is also the best ever seen.
    """
    energy = guard_shapes(energy)
    count, horizon = config.candidates, config.horizon
    choices = _choices(energy, params, memory, horizon)

    def score(plans: jax.Array) -> jax.Array:
        return jax.vmap(lambda a: energy.total(params, memory, a))(plans)

    def breed(
        carry: tuple[jax.Array, jax.Array], round_key: jax.Array
    ) -> tuple[tuple[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]:
        plans, energies = carry
        parents = plans[jnp.argsort(energies)[: config.elites]]
        place_key, action_key = jax.random.split(round_key)
        children = parents[jnp.arange(count) % config.elites]
        where = jax.random.randint(place_key, (count,), 0, horizon)
        rows = jnp.arange(count)
        # Another action; as the last resort, where there is no other, the same.
        lowest = jnp.finfo(choices.dtype).min
        others = choices[where].at[rows, children[rows, where]].set(lowest)
        changed = jax.random.categorical(action_key, others).astype(jnp.int32)
        children = children.at[rows, where].set(changed)
        children = children.at[: config.elites].set(parents)
        energies = score(children)
        return (children, energies), (children[jnp.argmin(energies)], undefined(energies).any())

    first_key, loop_key = jax.random.split(key)
    plans = _random_plans(first_key, choices, count)
    energies = score(plans)
    first, first_invalid = plans[jnp.argmin(energies)], undefined(energies).any()
    keys = jax.random.split(loop_key, config.iterations)[1:]
    (plans, energies), (later, invalid) = jax.lax.scan(breed, (plans, energies), keys)
    best = jnp.argmin(energies)
    plan = Plan(
        plans[best],
        jnp.concatenate([first[None], later]),
        energy.violation(params, memory, plans[best]) <= 0,
        ~(first_invalid | invalid.any()),
    )
    return plan._replace(energy=energies[best]) if config.score else plan


class _Beams(NamedTuple):
    """W plans that have begun."""

    plans: jax.Array  # [W, T] int32; MASK where nothing is chosen yet
    sums: jax.Array  # [W] of the energies of what is chosen; +inf where there is no plan yet
    likelihoods: jax.Array  # [W] log-probability of being drawn, at the temperature
    ranks: jax.Array  # [W] the same and noise: those that are highest go on


def beam_search(
    energy: Energy, params: Params, key: jax.Array, memory: PyTree, config: BeamConfig
) -> Plan:
    """The plan of least summed conditional energy among W that began well, T passes in all.

    A position is chosen while those after it are still MASK. Where the conditionals are
    `-log p(a_t | those before)`, as of an autoregressive model, the sum is the negative log
    likelihood of the plan. At temperature 0 the W best go on, and A^(T - 1) of them find the
    likeliest plan of all. Above it they are drawn: W plans without replacement, each action with
    probability proportional to `exp(-energy / temperature)` (stochastic beam search, Kool et al.,
    2019); of one beam that is a plan drawn action by action. The trace is the first beam after
    every pass; what is not chosen yet is MASK there.

    Raises:
        ValueError: the energy does not accept MASK, so that no plan can be begun.
    """
    if not energy.accepts_mask:
        raise ValueError(
            "beam search begins plans that it ends later, and this energy scores complete plans "
            "only (accepts_mask is False): use another planner"
        )
    energy = guard_shapes(energy)
    actions = energy.num_actions

    def extend(
        beams: _Beams, inputs: tuple[jax.Array, jax.Array]
    ) -> tuple[_Beams, tuple[jax.Array, jax.Array]]:
        position, draw_key = inputs
        asked = jax.vmap(lambda beam: energy.conditional(params, memory, beam, position[None])[0])
        energies = asked(beams.plans)  # [W, A]
        sums = beams.sums[:, None] + energies
        likelihoods = ranks = -sums
        if config.temperature:
            likelihoods, ranks = _drawn(draw_key, beams, energies, config.temperature)
        _, chosen = jax.lax.top_k(ranks.reshape(-1), config.beams)
        plans = beams.plans[chosen // actions].at[:, position].set(chosen % actions)
        kept = (each.reshape(-1)[chosen] for each in (sums, likelihoods, ranks))
        return _Beams(plans, *kept), (plans[0], undefined(energies).any())

    blank = jnp.full((config.beams, config.horizon), mask_token(actions), jnp.int32)
    # One plan is blank, not W: the others would only repeat it.
    sums = jnp.full(config.beams, jnp.inf).at[0].set(0.0)
    inputs = jnp.arange(config.horizon), jax.random.split(key, config.horizon)
    beams, (trace, invalid) = jax.lax.scan(extend, _Beams(blank, sums, -sums, -sums), inputs)
    # In a dead end a constraint says nothing, so what it forbids may have the least sum.
    violations = jax.vmap(lambda beam: energy.violation(params, memory, beam))(beams.plans)
    found = jnp.argmin(jnp.where(jnp.isposinf(violations), jnp.inf, beams.sums))
    best, satisfied = beams.plans[found], violations[found] <= 0
    plan = Plan(best, trace.at[-1].set(best), satisfied, ~invalid.any())
    if config.score:
        total = energy.total(params, memory, best)
        plan = plan._replace(energy=total, valid=plan.valid & ~undefined(total))
    return plan


def _drawn(
    key: jax.Array, beams: _Beams, energies: jax.Array, temperature: float
) -> tuple[jax.Array, jax.Array]:
    """`likelihoods` and `ranks` `[W, A]` of plans that are one action longer.

    The highest rank of what a plan becomes is the plan's own (Kool et al., 2019, algorithm 1):
    so complete plans have ranks as if noise had been added to each of all that are possible.

    Args:
        key: of the noise.
        beams: that are made longer.
        energies: `[W, A]` of every action.
        temperature: of the draw, positive.
    """
    # Measured from the least first, so that the lowest temperature is a greedy choice.
    least = energies.min(axis=1, keepdims=True)
    hopeless = jnp.isinf(least) | jnp.isinf(beams.likelihoods)[:, None]  # nothing, or no plan
    likelihoods = jnp.where(hopeless, 0, jax.nn.log_softmax((least - energies) / temperature))
    noisy = likelihoods + jax.random.gumbel(key, energies.shape)
    highest = noisy.max(axis=1, keepdims=True)
    wanted = jnp.where(hopeless, 0, (beams.ranks - beams.likelihoods)[:, None])
    # -log(exp(-wanted) - exp(-highest) + exp(-noisy)), in a form that overflows nowhere.
    excess = wanted - noisy + jnp.log1p(-jnp.exp(noisy - highest))
    ranks = wanted - jnp.maximum(excess, 0) - jnp.log1p(jnp.exp(-jnp.abs(excess)))

    def after(each: jax.Array) -> jax.Array:
        return jnp.where(hopeless, -jnp.inf, each + beams.likelihoods[:, None])

    return after(likelihoods), after(ranks)


def find_planner(config: PlannerConfig) -> Callable[..., Plan]:
    """Returns the planner that takes a configuration: `gibbs`, `beam_search` and so on.

    Raises:
        TypeError: no planner takes such a configuration.
    """
    planners: dict[type, Callable[..., Plan]] = {
        GibbsConfig: gibbs,
        ShootingConfig: random_shooting,
        CrossEntropyConfig: cross_entropy_method,
        BeamConfig: beam_search,
    }
    if type(config) not in planners:
        known = ", ".join(kind.__name__ for kind in planners)
        raise TypeError(f"no planner takes a {type(config).__name__}: expected one of {known}")
    return planners[type(config)]


def bind(energy: Energy, config: PlannerConfig) -> Callable[[Params, jax.Array, PyTree], Plan]:
    """Returns `(params, key, context) -> Plan`, which encodes the context and plans.

    Raises:
        UserError: the energy is no `Energy`.
        TypeError: no planner takes such a configuration.
    """
    check_kind(energy, Energy)
    planner = find_planner(config)

    def plan(params: Params, key: jax.Array, context: PyTree) -> Plan:
        return planner(energy, params, key, energy.encode(params, context), config)

    return plan
