"""Planners: `(energy, params, key, context, config) -> Plan`, pure, for one context.

They know only `Energy`. `leapjax.batching` makes one of them plan for any number of contexts.
"""

import dataclasses
import functools
from collections.abc import Callable

import chex
import jax
import jax.numpy as jnp

from leapjax.errors import check_at_least
from leapjax.types import Energy, Params, Plan, PyTree, mask_token

HOTTEST = 1e30  # so that noise times temperature is a number
ORDERS = ("random", "sequential")


@dataclasses.dataclass(frozen=True)
class GibbsConfig:
    """Iterative planning through energy minimisation (paper, algorithm 1)."""

    horizon: int = 5  # T, planned actions
    iterations: int = 10  # N, passes of the model; the first fills every position
    resampled: int = 1  # P, positions resampled together in every later iteration
    order: str = "random"  # which positions: "random", or "sequential" from left to right
    temperature: float = 0.0  # 0 takes the most likely action
    restarts: int = 1  # R independent plans, of which the one of least energy is kept
    score: bool = False  # also return the energy of the plan (T more passes)
    score_trace: bool = False  # also return the energy after every iteration (N * T passes)

    def __post_init__(self) -> None:
        check_at_least(self, 1, "horizon", "iterations", "resampled", "restarts")
        if self.resampled > self.horizon:
            raise ValueError(
                f"resampled is {self.resampled}, more positions than the horizon {self.horizon}"
            )
        if not 0 <= self.temperature <= HOTTEST:  # false for NaN too
            raise ValueError(f"a temperature must be in 0 .. {HOTTEST}, got {self.temperature}")
        if self.order not in ORDERS:
            raise ValueError(f"unknown order {self.order!r}: expected one of {', '.join(ORDERS)}")


@dataclasses.dataclass(frozen=True)
class ShootingConfig:
    """Random shooting (paper, appendix, ablation): the best of random plans."""

    horizon: int = 5  # T
    candidates: int = 30  # uniform action sequences
    score: bool = False  # also return the energy of the plan (known anyway)

    def __post_init__(self) -> None:
        check_at_least(self, 1, "horizon", "candidates")


@dataclasses.dataclass(frozen=True)
class CrossEntropyConfig:
    """The cross-entropy method as the paper's appendix describes it."""

    horizon: int = 5  # T
    iterations: int = 10  # N, rounds; the first draws uniform sequences
    candidates: int = 30  # sequences per round
    elites: int = 3  # kept as parents of the next round, each child with one token changed
    keep_elites: bool = True  # elites survive unchanged, so the best energy never rises
    score: bool = False

    def __post_init__(self) -> None:
        check_at_least(self, 1, "horizon", "iterations", "candidates", "elites")
        if self.elites > self.candidates:
            raise ValueError(f"{self.elites} elites out of {self.candidates} candidates")


@dataclasses.dataclass(frozen=True)
class BeamConfig:
    """Beam search, from left to right: the best of the plans that began well."""

    horizon: int = 5  # T
    beams: int = 10  # W, partial plans that are kept
    score: bool = False  # also return the energy of the plan

    def __post_init__(self) -> None:
        check_at_least(self, 1, "horizon", "beams")

    @property
    def iterations(self) -> int:
        """Passes: each chooses one action of every plan."""
        return self.horizon


def undefined(energies: jax.Array) -> jax.Array:
    """Where an energy means nothing: NaN, or -inf, against which nothing can be weighed."""
    return jnp.isnan(energies) | jnp.isneginf(energies)


PlannerConfig = GibbsConfig | ShootingConfig | CrossEntropyConfig | BeamConfig


def gibbs(
    energy: Energy, params: Params, key: jax.Array, context: PyTree, config: GibbsConfig
) -> Plan:
    """Gibbs sampling over action tokens (paper, algorithm 1): N passes in all.

    Iteration 1 fills every position from all MASK (or is a uniform plan, for an energy
    that does not accept MASK); iterations 2 to N mask P positions, read the energy of
    every action there, and draw actions with probability proportional to
    `exp(-energy / temperature)`.
    """
    memory = energy.encode(params, context)
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


def _gibbs_chain(
    energy: Energy, params: Params, memory: PyTree, key: jax.Array, config: GibbsConfig
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """One chain: final actions `[T]`, the actions after every iteration `[N, T]`, `valid`."""
    horizon, later = config.horizon, config.iterations - 1
    order_key, noise_key, start_key = jax.random.split(key, 3)

    # All randomness is drawn at once, before the loop: inside it costs more than the draws.
    def noise(k: jax.Array, *shape: int) -> jax.Array:
        if config.temperature:
            return jax.random.gumbel(k, (*shape, energy.num_actions))
        return jnp.zeros((*shape, 1))

    def draw(tokens: jax.Array, where: jax.Array, gumbel: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Tokens `[T]` with new actions at positions `[P]`; whether no energy was NaN."""
        energies = energy.conditional(params, memory, tokens, where)
        chex.assert_shape(energies, (where.shape[0], energy.num_actions))
        # Gumbel-max. Noise times temperature, not energy over temperature: exact at 0, and
        # +inf stays +inf.
        drawn = jnp.argmin(energies - config.temperature * gumbel, axis=-1).astype(jnp.int32)
        # Where every action is forbidden another position has to change: leave this one
        # (and 0 for MASK, which is the number of actions).
        hopeless = jnp.all(jnp.isinf(energies), axis=-1)
        drawn = jnp.where(hopeless, tokens[where] % energy.num_actions, drawn)
        return tokens.at[where].set(drawn), ~jnp.any(undefined(energies))

    if energy.accepts_mask:
        blank = jnp.full((horizon,), mask_token(energy.num_actions), jnp.int32)
        first, first_valid = draw(blank, jnp.arange(horizon), noise(start_key, horizon))
    else:
        first = jax.random.randint(start_key, (horizon,), 0, energy.num_actions)
        first_valid = jnp.bool_(True)

    def iterate(
        actions: jax.Array, inputs: tuple[jax.Array, jax.Array]
    ) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        actions, valid = draw(actions, *inputs)
        return actions, (actions, valid)

    positions = _scan_order(order_key, config)  # [N - 1, P]
    gumbel = noise(noise_key, later, config.resampled)  # [N - 1, P, A]
    last, (trace, valid) = jax.lax.scan(iterate, first, (positions, gumbel))
    return last, jnp.concatenate([first[None], trace]), first_valid & valid.all()


def _scan_order(key: jax.Array, config: GibbsConfig) -> jax.Array:
    """The positions of iterations 2 to N: `[N - 1, P]`, distinct within an iteration."""
    shape = (config.iterations - 1, config.resampled)
    if config.order == "sequential":
        return jnp.arange(shape[0] * shape[1]).reshape(shape) % config.horizon
    if config.resampled == 1:
        return jax.random.randint(key, shape, 0, config.horizon)
    scores = jax.random.uniform(key, (shape[0], config.horizon))
    return jnp.argsort(scores, axis=-1)[:, : config.resampled]


def random_shooting(
    energy: Energy, params: Params, key: jax.Array, context: PyTree, config: ShootingConfig
) -> Plan:
    """The uniform random plan of least energy (paper, appendix, ablation)."""
    memory = energy.encode(params, context)
    plans = jax.random.randint(key, (config.candidates, config.horizon), 0, energy.num_actions)
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
    energy: Energy, params: Params, key: jax.Array, context: PyTree, config: CrossEntropyConfig
) -> Plan:
    """Keep the elites, change one token in each child (paper, appendix, ablation).

    The plan returned is the best of the last round, as in the paper; with `keep_elites`
    that is also the best ever seen.
    """
    memory = energy.encode(params, context)
    count, horizon = config.candidates, config.horizon

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
        # A shift by 1 .. A-1 always changes the token.
        shift = jax.random.randint(action_key, (count,), 1, max(energy.num_actions, 2))
        rows = jnp.arange(count)
        changed = (children[rows, where] + shift) % energy.num_actions
        children = children.at[rows, where].set(changed)
        if config.keep_elites:
            children = children.at[: config.elites].set(parents)
        energies = score(children)
        return (children, energies), (children[jnp.argmin(energies)], undefined(energies).any())

    first_key, loop_key = jax.random.split(key)
    plans = jax.random.randint(first_key, (count, horizon), 0, energy.num_actions)
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


def beam_search(
    energy: Energy, params: Params, key: jax.Array, context: PyTree, config: BeamConfig
) -> Plan:
    """The plan of least summed conditional energy among the W that began best, T passes in all.

    A position is chosen while those after it are still MASK. Where the conditionals are
    `-log p(a_t | those before)`, as of an autoregressive model, the sum is the negative log
    likelihood of the plan, and A^(T - 1) beams find the likeliest of all. Nothing is
    drawn. The trace is the best beam after every pass; what is not chosen yet is MASK there.

    Raises:
        ValueError: the energy does not accept MASK, so that no plan can be begun.
    """
    del key
    if not energy.accepts_mask:
        raise ValueError(
            "beam search begins plans that it ends later, and this energy scores complete plans "
            "only (accepts_mask is False): use another planner"
        )
    memory = energy.encode(params, context)
    actions = energy.num_actions

    def extend(
        carry: tuple[jax.Array, jax.Array], position: jax.Array
    ) -> tuple[tuple[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]:
        beams, sums = carry  # [W, T], [W]
        each = jax.vmap(lambda beam: energy.conditional(params, memory, beam, position[None])[0])
        energies = each(beams)  # [W, A]
        least, chosen = jax.lax.top_k(-(sums[:, None] + energies).reshape(-1), config.beams)
        beams = beams[chosen // actions].at[:, position].set(chosen % actions)
        return (beams, -least), (beams[0], undefined(energies).any())

    blank = jnp.full((config.beams, config.horizon), mask_token(actions), jnp.int32)
    # One plan is blank, not W: the others would only repeat it.
    sums = jnp.full(config.beams, jnp.inf).at[0].set(0.0)
    (beams, _), (trace, invalid) = jax.lax.scan(extend, (blank, sums), jnp.arange(config.horizon))
    best = beams[0]
    plan = Plan(best, trace, energy.violation(params, memory, best) <= 0, ~invalid.any())
    if config.score:
        found = energy.total(params, memory, best)
        plan = plan._replace(energy=found, valid=plan.valid & ~undefined(found))
    return plan


def bind(energy: Energy, config: PlannerConfig) -> Callable[[Params, jax.Array, PyTree], Plan]:
    """`(params, key, context) -> Plan`: the planner that a configuration belongs to.

    Raises:
        TypeError: it belongs to none.
    """
    planners: dict[type, Callable[..., Plan]] = {
        GibbsConfig: gibbs,
        ShootingConfig: random_shooting,
        CrossEntropyConfig: cross_entropy_method,
        BeamConfig: beam_search,
    }
    if type(config) not in planners:
        raise TypeError(f"no planner takes a {type(config).__name__}")
    return functools.partial(planners[type(config)], energy, config=config)
