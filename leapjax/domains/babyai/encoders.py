"""Encoders of grids, poses and instructions: a context to tokens, for both architectures.

`StateTokens` is the paper's, a token for each state of the context; `ContextTokens` is ours.

Which convolution is fastest on a CPU depends on the map (docs/lessons.md): on whole
grids of few channels XLA's own is, on the small and deep maps of the paper's encoder one
matrix product over shifted copies.
"""

import functools
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax.typing import Dtype, Initializer

from leapjax.domains.babyai import symmetries, vocabulary
from leapjax.domains.babyai.adapter import NUM_ACTIONS
from leapjax.domains.babyai.observations import Observation
from leapjax.domains.babyai.runs import map_runs
from leapjax.domains.babyai.settings import Settings
from leapjax.models.encoder import Encoder
from leapjax.models.linear import linear
from leapjax.models.transformer import dense, embed
from leapjax.types import Context, pad_token

# MiniGrid's encoding of a cell: object 0 to 10, colour 0 to 5, state 0 to 3.
OBJECTS, COLOURS, STATES = 11, symmetries.COLOURS, 4
DIRECTIONS = 4
NORM_GROUPS = 8
FAR = 64.0  # the distance of what no way leads to
AT_A_TIME = 16  # states that a core encodes
BARRIER = 8.0  # steps that one goes round for each nat
# Where embeddings start: as PyTorch's, which are the authors'; and as Flax's.
LARGE = nn.initializers.normal(1.0)
SMALL = nn.initializers.variance_scaling(1.0, "fan_in", "normal", out_axis=0)
_OPPOSITE = (1, 0, 3, 2)  # of the neighbours at x - 1, x + 1, y - 1, y + 1


def patches(image: jax.Array, side: int, padding: tuple[int, int]) -> jax.Array:
    """`[X, Y, C]` to `[X', Y', side * side * C]`: the neighbourhood of every cell."""
    image = jnp.pad(image, (padding, padding, (0, 0)))
    width, height = image.shape[0] - side + 1, image.shape[1] - side + 1
    shifted = [image[x : x + width, y : y + height] for x in range(side) for y in range(side)]
    return jnp.concatenate(shifted, axis=-1)


def halved(image: jax.Array) -> jax.Array:
    """The largest of each 2x2 cells: `[X, Y, C]` to `[X // 2, Y // 2, C]`.

    As `nn.max_pool`, whose gradient XLA looks for window by window.
    """
    width, height = image.shape[0] // 2, image.shape[1] // 2
    windows = image[: 2 * width, : 2 * height].reshape(width, 2, height, 2, -1)
    return windows.max(axis=(1, 3))


class Convolution(nn.Module):
    """A convolution as one matrix product, for small maps of many channels."""

    features: int
    side: int = 3
    padding: tuple[int, int] = (1, 1)
    stride: int = 1
    dtype: Dtype = jnp.float32  # of the matrix product; parameters are float32

    @nn.compact
    def __call__(self, image: jax.Array) -> jax.Array:
        """`[X, Y, C]` to `[X', Y', features]`."""
        kernel_init = nn.initializers.he_normal()
        product = linear(self.features, kernel_init, dtype=self.dtype)
        near = patches(image, self.side, self.padding)
        return product(near[:: self.stride, :: self.stride])


class Instruction(NamedTuple):
    """An encoded instruction."""

    words: jax.Array  # [L, width] each word, with what was said before it
    given: jax.Array  # [L] bool: not padding
    whole: jax.Array  # [width] the state after the last word


class InstructionEncoder(nn.Module):
    """Word embeddings and a GRU (paper, appendix, network details)."""

    vocabulary: int
    width: int
    embedding_init: Initializer = SMALL

    @nn.compact
    def __call__(self, instruction: jax.Array) -> Instruction:
        """Of token ids `[L]`, 0 for padding."""
        table = nn.Embed(self.vocabulary, self.width, embedding_init=self.embedding_init)
        words = table(instruction)
        given = instruction > 0
        recurrence = nn.RNN(nn.GRUCell(self.width), return_carry=True)
        whole, states = recurrence(words, seq_lengths=jnp.sum(given))
        return Instruction(words + states, given, whole)


class WordAttention(nn.Module):
    """What an instruction says of each cell: attention from cells to words.

    'Go to the red ball and the key, then ...': one vector has to say of every object whether,
    and when, it is meant; here the cell that holds it finds the words that name it.
    """

    heads: int
    features: int = 16  # of a head

    @nn.compact
    def __call__(self, cells: jax.Array, instruction: Instruction) -> jax.Array:
        """Cells `[S, S, C]` to `[S, S, C]`."""

        def heads(x: jax.Array, name: str) -> jax.Array:
            return nn.DenseGeneral((self.heads, self.features), name=name)(x)

        words = instruction.words
        queries, keys, values = heads(cells, "query"), heads(words, "key"), heads(words, "value")
        scores = jnp.einsum("xyhd,lhd->xyhl", queries, keys) / self.features**0.5
        weights = jax.nn.softmax(jnp.where(instruction.given, scores, -1e30), axis=-1)
        said = jnp.einsum("xyhl,lhd->xyhd", weights, values)
        return nn.DenseGeneral(cells.shape[-1], axis=(-2, -1), name="output")(said)


class StateEncoder(nn.Module):
    """Pose, goal and carried object to one vector (paper, appendix: 256, 256, 128)."""

    side: int  # S
    width: int

    @nn.compact
    def __call__(self, observation: Observation) -> jax.Array:
        """`[width]`. Coordinates are embedded, not scaled, as in the authors' code."""

        def table(count: int, name: str) -> nn.Embed:
            return nn.Embed(count, self.width, embedding_init=LARGE, name=name)

        # One more row than the side, for the -1 of an unavailable goal.
        coordinates = table(self.side + 1, "coordinates")
        parts = [
            coordinates(observation.pose[:2]),
            table(DIRECTIONS, "direction")(observation.pose[2:]),
            coordinates(jnp.where(observation.goal < 0, self.side, observation.goal)),
            # Not in the appendix: levels where objects are moved need it.
            table(OBJECTS, "carried")(observation.carried[:1]),
            table(COLOURS, "carried_colour")(observation.carried[1:]),
        ]
        h = jnp.concatenate(parts).reshape(-1)
        h = jnp.tanh(nn.Dense(2 * self.width)(h))
        h = jnp.tanh(nn.Dense(2 * self.width)(h))
        return nn.Dense(self.width)(h)


class FiLMBlock(nn.Module):
    """Two convolutions modulated by a condition (paper: ExpertControllerFiLM)."""

    width: int
    dtype: Dtype = jnp.float32

    @nn.compact
    def __call__(self, image: jax.Array, condition: jax.Array) -> jax.Array:
        """`[X, Y, C]` and `[D]` to `[X, Y, width]`."""
        h = Convolution(self.width, dtype=self.dtype)(image)
        h = Convolution(self.width, dtype=self.dtype)(nn.relu(GroupNorm(self.dtype)(h)))
        scale, shift = nn.Dense(self.width)(condition), nn.Dense(self.width)(condition)
        return nn.relu(GroupNorm(self.dtype)(h * scale + shift))


class HalvingBlock(nn.Module):
    """A residual block of stride 2: half of a map, rounded up."""

    width: int
    dtype: Dtype = jnp.float32

    @nn.compact
    def __call__(self, image: jax.Array) -> jax.Array:
        """`[X, Y, C]` to `[ceil(X / 2), ceil(Y / 2), width]`."""
        h = Convolution(self.width, stride=2, dtype=self.dtype)(image)
        h = Convolution(self.width, dtype=self.dtype)(nn.relu(GroupNorm(self.dtype)(h)))
        aside = Convolution(self.width, 1, (0, 0), 2, self.dtype)(image)
        return nn.relu(GroupNorm(self.dtype)(h) + aside)


class GroupNorm(nn.Module):
    """Normalisation that needs no batch (Wu and He, 2018); the authors' code has batch norm.

    As `nn.GroupNorm`, whose gradient takes as long as a convolution here: this one sums over
    cells first, so that no large array is ever split into groups. As there, the first axis is
    taken for a batch: each column of a map is normalised by itself (docs/deviations.md).
    """

    dtype: Dtype = jnp.float32  # of the result; statistics are float32

    @nn.compact
    def __call__(self, image: jax.Array) -> jax.Array:
        """Of `[X, Y, C]`: groups of channels, `NORM_GROUPS` of them, to mean 0 and variance 1."""
        channels = image.shape[-1]
        scale = self.param("scale", nn.initializers.ones, (channels,))
        bias = self.param("bias", nn.initializers.zeros, (channels,))
        exact = image.astype(jnp.float32)

        def mean(each: jax.Array) -> jax.Array:
            """`[X, 1, C]`: of a column and a group, for each of its channels."""
            groups = each.mean(axis=1, keepdims=True).reshape(len(image), 1, NORM_GROUPS, -1)
            return jnp.repeat(groups.mean(axis=-1), channels // NORM_GROUPS, axis=-1)

        centre = mean(exact)
        variance = jnp.maximum(mean(exact**2) - centre**2, 0)
        factor = scale * jax.lax.rsqrt(variance + 1e-6)
        return (image * factor + (bias - centre * factor)).astype(self.dtype)


class PaperStateEncoder(nn.Module):
    """The image encoder of the appendix, fused with instruction and pose by FiLM."""

    side: int
    width: int
    dtype: Dtype = jnp.float32

    @nn.compact
    def __call__(self, observation: Observation, instruction: jax.Array) -> jax.Array:
        """One state and the encoded instruction `[D]` to the state's token `[width]`."""

        def layer(h: jax.Array, side: int) -> jax.Array:
            h = Convolution(self.width, side, dtype=self.dtype)(h)
            return nn.relu(GroupNorm(self.dtype)(h))

        h = layer(observation.grid.astype(jnp.float32), 2)
        h = halved(h)
        h = layer(h, 3)
        if self.side >= 7:  # of a smaller grid no map would be left
            h = halved(h)
        if self.side >= 16:  # "may vary a little depending on the environment size"
            h = HalvingBlock(self.width, self.dtype)(h)
        for _ in range(2):
            h = FiLMBlock(self.width, self.dtype)(h, instruction)
        state = StateEncoder(self.side, self.width)(observation)
        for _ in range(2):
            h = FiLMBlock(self.width, self.dtype)(h, state)
        return nn.relu(nn.Dense(self.width)(h.reshape(-1)))


class StateTokens(Encoder):
    """The appendix's: `[K + 1, D]`, a token for each state of the context, oldest first."""

    side: int
    width: int
    dtype: Dtype = jnp.float32
    later: bool = False  # one more token, of later states, whose pose nobody knows: (0, 0, 0)

    def setup(self) -> None:  # noqa: D102
        self.instruction = InstructionEncoder(vocabulary.SIZE, self.width, LARGE)
        self.state = PaperStateEncoder(self.side, self.width, self.dtype)

    def add_later_state(self) -> Encoder:  # noqa: D102
        return self.clone(later=True)

    def __call__(self, context: Context) -> jax.Array:  # noqa: D102
        return self.encode_next(context, None)

    def encode_next(self, context: Context, known: jax.Array | None) -> jax.Array:
        """In one batch, which takes less than one state after the other.

        A later state differs from the current one in the pose alone, which is read late: up to
        there both are one, apart from the past.
        """
        instruction = self.instruction(context.observation.instruction).whole
        now, past = context.observation, context.past
        read = jax.vmap(self.state, in_axes=(0, None))
        if not self.later:
            states = jax.tree.map(lambda leaf: leaf[None], now)
            if known is None:
                states = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), past, states)
            tokens = read(states, instruction)
        else:
            poses = jnp.stack([now.pose, _nowhere(now).pose])
            tokens = jax.vmap(lambda pose: self.state(now._replace(pose=pose), instruction))(poses)
            if known is None and context.actions.shape[0]:
                known = read(past, instruction)
        return tokens if known is None else jnp.concatenate([known, tokens])

    def encode_batch(self, contexts: Context) -> jax.Array:
        """On a CPU a few states at a time, whose maps stay in a core's cache, and no state twice.

        What stands in a context for the time before its episode is always the same, for example.
        """
        if not contexts.actions.shape[1] or jax.default_backend() != "cpu":
            return super().encode_batch(contexts)
        now = contexts.observation
        later = [jax.vmap(_nowhere)(now)] if self.later else []
        states = jax.tree.map(
            lambda past, *others: jnp.concatenate([past, *(x[:, None] for x in others)], axis=1),
            contexts.past, now, *later,
        )  # fmt: skip
        told = jax.vmap(lambda instruction: self.instruction(instruction).whole)(now.instruction)
        return map_runs(self.state, states, told, AT_A_TIME)


def _nowhere(observation: Observation) -> Observation:
    """Of an agent whose pose is not known."""
    return observation._replace(pose=jnp.zeros_like(observation.pose))


def _convolution(features: int, name: str, dtype: Dtype) -> nn.Conv:
    """A 3x3 convolution with padding, by XLA."""
    init = nn.initializers.he_normal()
    return nn.Conv(features, (3, 3), dtype=dtype, kernel_init=init, name=name)


class GridEncoder(nn.Module):
    """Cell features that know the way: learned distances, then local convolutions.

    Distances are value iteration in the min-plus sense (Tamar et al., Value Iteration
    Networks). How likely it is that a cell can be entered is learned from the demonstrations,
    per field: nothing says that walls are in the way. Half of the fields measure from the goal,
    where it is observed; where the others measure from is learned too. A sweep carries a
    distance one cell further and has no matrix product, so the dozens that mazes need cost
    little.
    """

    channels: int
    fields: int  # distance fields; 0: convolutions alone
    sweeps: int  # rounds of distances: how far a way can lead
    rounds: int  # rounds of convolutions, which share their weights
    dtype: Dtype = jnp.float32  # of the convolutions; distances are float32

    @nn.compact
    def __call__(
        self, cells: jax.Array, agent: jax.Array, goal: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Features `[S, S, channels]` and the agent's distances `[fields]`.

        Args:
            cells: `[S, S, C]` what is in each cell.
            agent: `[2]` its cell.
            goal: `[2]` its cell; (-1, -1) where it is not available.
        """
        distance = jnp.zeros((*cells.shape[:2], 0))
        if self.fields:
            distance = self._distances(cells, goal)
        # Locally only differences matter: measured from the agent, and squashed.
        here = feature_at(distance, agent)
        relative = jnp.tanh((distance - here) / 4)
        both = jnp.concatenate([cells, relative], axis=-1)
        source = _convolution(self.channels, "source", self.dtype)(both)
        step = _convolution(self.channels, "step", self.dtype)
        h = nn.relu(source)
        for _ in range(self.rounds):
            h = nn.relu(step(h) + source)
        return h, jnp.tanh(here / 16)

    def _distances(self, cells: jax.Array, goal: jax.Array) -> jax.Array:
        """`[S, S, fields]`."""
        local = nn.relu(_convolution(self.channels, "local", self.dtype)(cells))
        free = nn.initializers.constant(-3.0)
        cost = entering_cost(nn.Dense(self.fields, bias_init=free, name="blocked")(local))
        from_goal = (1 - one_cell(goal, cells.shape[0]))[..., None] * FAR
        far = nn.initializers.constant(10.0)
        learned = nn.softplus(
            nn.Dense(self.fields - self.fields // 2, bias_init=far, name="start")(local)
        )
        start = jnp.concatenate(
            [jnp.broadcast_to(from_goal, (*cells.shape[:2], self.fields // 2)), learned], axis=-1
        )
        return jnp.minimum(min_plus(start, cost, self.sweeps), FAR)


def entering_cost(blocked: jax.Array) -> jax.Array:
    """What it costs to enter a cell, in steps, from the log-odds `[...]` that it is blocked.

    One step, and `BARRIER` for each nat of -log P(free), so that distances prefer ways that are
    likely to be free, however long. Demonstrations alone ask for little: a cost that makes their
    own detours worthwhile, which are short.
    """
    return 1 + BARRIER * nn.softplus(blocked)


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def min_plus(start: jax.Array, cost: jax.Array, sweeps: int) -> jax.Array:
    """Distances `[S, S, F]`: d(c) = min(start(c), cost(c) + min over 4 neighbours of d).

    The gradient is that of the fixed point: it flows back along the shortest ways, which
    is exact once `sweeps` reaches the longest of them, and stores no sweep.

    Args:
        start: `[S, S, F]` the distance of a way that ends in the cell.
        cost: `[S, S, F]` of entering the cell.
        sweeps: rounds; a way of so many cells is found.
    """

    def sweep(_: int, distance: jax.Array) -> jax.Array:
        return jnp.minimum(start, cost + _neighbours(distance, FAR).min(axis=0))

    return jax.lax.fori_loop(0, sweeps, sweep, start)


def _min_plus_forward(
    start: jax.Array, cost: jax.Array, sweeps: int
) -> tuple[jax.Array, tuple[jax.Array, jax.Array, jax.Array]]:
    distance = min_plus(start, cost, sweeps)
    return distance, (start, cost, distance)


def _min_plus_backward(
    sweeps: int, saved: tuple[jax.Array, jax.Array, jax.Array], gradient: jax.Array
) -> tuple[jax.Array, jax.Array]:
    start, cost, distance = saved
    near = _neighbours(distance, FAR)  # [4, S, S, F]
    through = start > cost + near.min(axis=0)  # the way goes on, to the first nearest neighbour
    onward = jax.nn.one_hot(near.argmin(axis=0), 4, axis=0) * through

    def sweep(_: int, flow: jax.Array) -> jax.Array:
        """What arrives at a cell, from itself and from the neighbours whose way leads here."""
        sent = onward * flow
        return gradient + sum(
            _neighbours(sent[direction], 0.0)[_OPPOSITE[direction]] for direction in range(4)
        )

    flow = jax.lax.fori_loop(0, sweeps, sweep, gradient)
    return jnp.where(through, 0, flow), jnp.where(through, flow, 0)


min_plus.defvjp(_min_plus_forward, _min_plus_backward)


def _neighbours(image: jax.Array, outside: float) -> jax.Array:
    """`[4, S, S, F]`: what is at x - 1, x + 1, y - 1 and y + 1 of every cell."""
    padded = jnp.pad(image, ((1, 1), (1, 1), (0, 0)), constant_values=outside)
    return jnp.stack([padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:]])


class CellEmbedding(nn.Module):
    """What is in a cell, as a learned vector: never a raw index taken for a brightness."""

    channels: int

    @nn.compact
    def __call__(self, observation: Observation) -> jax.Array:
        """`[S, S, channels]`, with the agent's and the goal's cell marked."""
        grid = observation.grid
        side = grid.shape[0]
        # One-hot and a matrix product: the gradient of a table look-up is a slow scatter.
        kinds = [
            jax.nn.one_hot(grid[..., part], size)
            for part, size in enumerate((OBJECTS, COLOURS, STATES))
        ]
        marks = [
            one_cell(observation.pose[:2], side)[..., None],
            one_cell(observation.goal, side)[..., None],
        ]
        features = jnp.concatenate([*kinds, *marks], axis=-1)
        init = nn.initializers.normal(1.0)
        return nn.Dense(self.channels, use_bias=False, kernel_init=init)(features)


def one_cell(position: jax.Array, side: int) -> jax.Array:
    """`[S, S]` float32: 1 at a position `[2]`, all 0 for one outside the grid."""
    axis = jnp.arange(side)
    hit = (axis == position[0])[:, None] & (axis == position[1])[None, :]
    return hit.astype(jnp.float32)


def neighbourhood(image: jax.Array, position: jax.Array, radius: int) -> jax.Array:
    """The `(2 r + 1)^2 * C` features around a position, zero beyond the border."""
    padded = jnp.pad(image, ((radius, radius), (radius, radius), (0, 0)))
    size = 2 * radius + 1
    start = (position[0], position[1], jnp.zeros_like(position[0]))  # of one type, in 64 bits too
    return jax.lax.dynamic_slice(padded, start, (size, size, image.shape[-1])).reshape(-1)


def feature_at(image: jax.Array, position: jax.Array) -> jax.Array:
    """The features `[C]` of a cell, zero where the position is -1 (not available)."""
    return jnp.einsum("xyc,xy->c", image, one_cell(position, image.shape[0]))


class ContextTokens(Encoder):
    """Ours: what a plan must know of its context, in a few tokens.

    The grid is turned so that the agent faces right; learned distances spread over it; it is
    read at the agent, at the goal and as a whole.
    """

    settings: Settings
    width: int
    dtype: Dtype = jnp.float32

    @nn.compact
    def __call__(self, context: Context) -> jax.Array:
        """Tokens `[4, D]`: the agent, the goal, the whole grid, the instruction."""
        c, side = self.settings, context.observation.grid.shape[0]
        direction = context.observation.pose[2]
        observation = symmetries.rotate(context.observation, direction)
        words = InstructionEncoder(vocabulary.SIZE, self.width, name="instruction")
        instruction = words(observation.instruction)
        cells = CellEmbedding(c.channels, name="cells")(observation)
        if context.actions.shape[0]:
            faced = self._faced(context, observation.grid)
            cells += nn.Dense(c.channels, use_bias=False, name="faced")(faced)
        scale, shift = jnp.split(dense(2 * c.channels, name="modulation")(instruction.whole), 2)
        modulated = cells * (1 + scale) + shift
        if c.word_heads:
            modulated += WordAttention(c.word_heads, name="words")(cells, instruction)
        encoder = GridEncoder(c.channels, c.fields, c.sweeps, c.rounds, self.dtype, name="grid")
        grid, distances = encoder(modulated, observation.pose[:2], observation.goal)

        def read(features: jax.Array, name: str) -> jax.Array:
            return dense(self.width, scale=0.1, name=name)(features)

        # The agent's neighbourhood holds what the first steps depend on.
        around = neighbourhood(grid, observation.pose[:2], c.radius)
        kind, colour = observation.carried
        agent = read(around, "read_agent")
        if c.fields:
            agent += read(distances, "read_distances")
        agent += embed(OBJECTS, self.width, "carried")(kind)
        agent += embed(COLOURS, self.width, "carried_colour")(colour)
        goal = read(feature_at(grid, observation.goal), "read_goal")
        whole = read(grid.reshape(side * side, -1).max(axis=0), "read_all")
        return jnp.stack([agent, goal, whole, instruction.whole])

    def _faced(self, context: Context, turned: jax.Array) -> jax.Array:
        """Which objects and doors the agent has faced in the context, and when: `[S, S, 2]`.

        1 where it has, and how recently, in (0, 1]: 1 is now. That is what says which part of
        an instruction is done. The past actions, and where the agent went besides, are left
        out: by them a network can recognise a demonstration (docs/lessons.md).

        Args:
            context: what is known.
            turned: `[S, S, 3]` the current grid, turned so that the agent faces right.
        """
        side, past = turned.shape[0], context.actions.shape[0]
        direction = context.observation.pose[2]
        poses = jnp.concatenate([context.past.pose, context.observation.pose[None]])
        known = jnp.append(context.actions != pad_token(NUM_ACTIONS), True)
        recency = known * jnp.arange(1, past + 2) / (past + 1)

        def mark(pose: jax.Array) -> jax.Array:
            pose = symmetries.rotate_pose(pose, direction, side)
            front = pose[:2] + jnp.asarray(symmetries.DIRECTION_VECTORS)[pose[2]]
            return one_cell(front, side)

        kinds = turned[..., 0]
        named = (kinds >= symmetries.FIRST_COLOURED) & (kinds <= symmetries.LAST_COLOURED)
        latest = (jax.vmap(mark)(poses) * recency[:, None, None]).max(axis=0) * named
        return jnp.stack([latest > 0, latest], axis=-1)
