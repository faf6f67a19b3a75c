"""Distance fields on a grid, and convolutions that read them.

Sweeps of value iteration in the min-plus sense compute the fields (Tamar et al., 2016, "Value
Iteration Networks").
"""

import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax.typing import Dtype

from leapjax.domains.babyai.encoders.cells import mark_cell, read_cell

FAR = 64.0  # largest distance in steps, also of cells that no path reaches
BARRIER = 8.0  # cost in steps of each nat of -log P(free)
_OPPOSITE = (1, 0, 3, 2)  # opposite of the neighbours at x - 1, x + 1, y - 1, y + 1


class GridEncoder(nn.Module):
    """Features of cells: learned distances, then local convolutions.

    Each field learns from the demonstrations which cells the agent can enter; the code does not say
    that walls block it. Half of the fields measure from the goal if it is observed. The others
    measure from places that they learn. A sweep carries a distance one cell further without a
    matrix product, so the dozens of sweeps that mazes need cost little.

    Attributes:
        channels: features of a cell.
        fields: number of distance fields; 0 for convolutions alone.
        sweeps: rounds of value iteration; the longest path that they find has so many cells.
        rounds: rounds of convolutions, which share their weights.
        dtype: type of the convolutions; distances are float32.
    """

    channels: int
    fields: int
    sweeps: int
    rounds: int
    dtype: Dtype = jnp.float32

    @nn.compact
    def __call__(
        self, cells: jax.Array, inside: jax.Array, agent: jax.Array, goal: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Computes features `[S, S, channels]` and the agent's distances `[fields]`.

        Features of padding are zeros, as beyond the border, so the result does not depend on S.

        Args:
            cells: features `[S, S, C]` of each cell's content.
            inside: `[S, S, 1]`, 1 for cells of the level, 0 for padding.
            agent: the agent's cell `[2]`.
            goal: the goal's cell `[2]`; (-1, -1) if it is not observed.
        """
        cells = cells * inside
        distance = jnp.zeros((*cells.shape[:2], 0))
        if self.fields:
            distance = self._compute_fields(cells, inside, goal)
        # A convolution needs only differences: distances relative to the agent's, squashed.
        here = read_cell(distance, agent)
        relative = jnp.tanh((distance - here) / 4) * inside
        both = jnp.concatenate([cells, relative], axis=-1)
        source = _make_convolution(self.channels, "source", self.dtype)(both)
        step = _make_convolution(self.channels, "step", self.dtype)
        h = nn.relu(source) * inside
        for _ in range(self.rounds):
            h = nn.relu(step(h) + source) * inside
        return h, jnp.tanh(here / 16)

    def _compute_fields(self, cells: jax.Array, inside: jax.Array, goal: jax.Array) -> jax.Array:
        """Computes the distance fields `[S, S, fields]`; padding is as far as the border."""
        local = nn.relu(_make_convolution(self.channels, "local", self.dtype)(cells))
        free = nn.initializers.constant(-3.0)
        cost = compute_entering_cost(nn.Dense(self.fields, bias_init=free, name="blocked")(local))
        from_goal = (1 - mark_cell(goal, cells.shape[0]))[..., None] * FAR
        far = nn.initializers.constant(10.0)
        learned = nn.softplus(
            nn.Dense(self.fields - self.fields // 2, bias_init=far, name="start")(local)
        )
        start = jnp.concatenate(
            [jnp.broadcast_to(from_goal, (*cells.shape[:2], self.fields // 2)), learned], axis=-1
        )
        start, cost = (jnp.where(inside, each, FAR) for each in (start, cost))
        return jnp.minimum(find_distances(start, cost, self.sweeps), FAR)


def _make_convolution(features: int, name: str, dtype: Dtype) -> nn.Conv:
    """Makes XLA's 3x3 convolution with padding."""
    init = nn.initializers.he_normal()
    return nn.Conv(features, (3, 3), dtype=dtype, kernel_init=init, name=name)


def compute_entering_cost(blocked: jax.Array) -> jax.Array:
    """Computes the cost of entering a cell, in steps, from the log-odds that it is blocked.

    The cost is one step, and `BARRIER` for each nat of -log P(free). Distances then prefer paths
    that are likely to be free, however long. Demonstrations alone would teach a lower cost, just
    enough to explain their own detours, which are short.

    Args:
        blocked: log-odds `[...]`.
    """
    return 1 + BARRIER * nn.softplus(blocked)


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def find_distances(start: jax.Array, cost: jax.Array, sweeps: int) -> jax.Array:
    """Finds distances `[S, S, F]`: d(c) = min(start(c), cost(c) + min over 4 neighbours of d).

    The gradient is the gradient of the fixed point: it flows back along the shortest paths, so no
    sweep is stored. It is exact if no shortest path has more than `sweeps` cells.

    Args:
        start: distance `[S, S, F]` of a path that ends in the cell.
        cost: cost `[S, S, F]` of entering the cell.
        sweeps: number of rounds; finds paths of at most so many cells.
    """

    def sweep(_: int, distance: jax.Array) -> jax.Array:
        return jnp.minimum(start, cost + _stack_neighbours(distance, FAR).min(axis=0))

    return jax.lax.fori_loop(0, sweeps, sweep, start)


def _find_forward(
    start: jax.Array, cost: jax.Array, sweeps: int
) -> tuple[jax.Array, tuple[jax.Array, jax.Array, jax.Array]]:
    distance = find_distances(start, cost, sweeps)
    return distance, (start, cost, distance)


def _find_backward(
    sweeps: int, saved: tuple[jax.Array, jax.Array, jax.Array], gradient: jax.Array
) -> tuple[jax.Array, jax.Array]:
    start, cost, distance = saved
    near = _stack_neighbours(distance, FAR)  # [4, S, S, F]
    through = start > cost + near.min(axis=0)  # the path goes on, to the first nearest neighbour
    onward = jax.nn.one_hot(near.argmin(axis=0), 4, axis=0) * through

    def sweep(_: int, flow: jax.Array) -> jax.Array:
        """Adds each cell's gradient to the flow from neighbours whose path leads through it."""
        sent = onward * flow
        return gradient + sum(
            _stack_neighbours(sent[direction], 0.0)[_OPPOSITE[direction]] for direction in range(4)
        )

    flow = jax.lax.fori_loop(0, sweeps, sweep, gradient)
    return jnp.where(through, 0, flow), jnp.where(through, flow, 0)


find_distances.defvjp(_find_forward, _find_backward)


def _stack_neighbours(image: jax.Array, outside: float) -> jax.Array:
    """Stacks the neighbours at x - 1, x + 1, y - 1 and y + 1 of every cell: `[4, S, S, F]`."""
    padded = jnp.pad(image, ((1, 1), (1, 1), (0, 0)), constant_values=outside)
    return jnp.stack([padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:]])
