"""Masked language models over trajectories (paper, section 3.1): `encode`, then `logits`.

Both models score actions from the same `Context`. Every position of the plan carries the
current state (paper, equation 4), so the memory is computed once per plan and only action
tokens change from pass to pass.
"""

import dataclasses

import flax.linen as nn
import jax
import jax.numpy as jnp

from leapjax.data import symmetries
from leapjax.errors import UserError, check_at_least
from leapjax.models import encoders
from leapjax.models.transformer import Transformer, dense
from leapjax.types import Context, Observation, PyTree

ARCHITECTURES = ("paper", "leapjax")
DTYPES = ("float32", "bfloat16")


@dataclasses.dataclass(frozen=True)
class ModelConfig:
    """The network. The defaults are the paper's transformer."""

    architecture: str = "leapjax"  # "paper": the appendix's network; "leapjax": ours
    layers: int = 3  # transformer layers
    heads: int = 4  # attention heads
    width: int = 128  # D, embedding dimension
    dropout: float = 0.1  # of embeddings, attention and residuals
    channels: int = 32  # leapjax: features per grid cell
    rounds: int = 2  # leapjax: rounds of convolution over the grid
    fields: int = 8  # leapjax: learned distance fields
    sweeps: int = 16  # leapjax: rounds of value iteration that make them
    word_heads: int = 0  # leapjax: attention heads from cells to words; 0: none
    radius: int = 3  # leapjax: how far around the agent its cells are read one by one
    dtype: str = "float32"  # of matrix products: "float32" or "bfloat16"; parameters are float32

    def __post_init__(self) -> None:
        if self.architecture not in ARCHITECTURES:
            raise ValueError(
                f"unknown architecture {self.architecture!r}: "
                f"expected one of {', '.join(ARCHITECTURES)}"
            )
        check_at_least(self, 1, "layers", "heads", "width", "channels", "fields", "sweeps")
        check_at_least(self, 0, "rounds", "radius", "word_heads")
        if not 0 <= self.dropout < 1:
            raise ValueError(f"dropout must be in [0, 1), got {self.dropout}")
        if self.dtype not in DTYPES:
            raise ValueError(f"unknown dtype {self.dtype!r}: expected one of {', '.join(DTYPES)}")
        if self.width % self.heads:
            raise ValueError(f"width {self.width} is not a multiple of {self.heads} heads")
        if self.architecture == "paper" and self.width % encoders.NORM_GROUPS:
            raise ValueError(
                f"width {self.width} is not a multiple of {encoders.NORM_GROUPS}, the groups of "
                "channels that the paper's encoder normalises"
            )


@dataclasses.dataclass(frozen=True)
class Sizes:
    """What a model must know of its environment and of the plans it scores."""

    side: int  # S
    vocabulary: int  # number of word ids, padding included
    num_actions: int  # A, the end action included
    context: int  # K
    horizon: int  # T
    max_steps: int  # the longest episode, for the embedding of time


def forbid_early_end(logits: jax.Array, positions: jax.Array) -> jax.Array:
    """The end action, which is the last one, is never the first of a plan: `[P, A]`."""
    end = jnp.arange(logits.shape[-1]) == logits.shape[-1] - 1
    return jnp.where(end & (positions[:, None] == 0), -jnp.inf, logits)


class PaperModel(nn.Module):
    """The network of the paper's appendix: state and action tokens, interleaved.

    Tokens s_1 a_1 ... s_n a_n s_n a_n+1 ... with fully bidirectional attention; an action
    is read off its state token and all tokens share one embedding of the time at the end
    of the plan, as in the authors' code.
    """

    config: ModelConfig
    sizes: Sizes

    def setup(self) -> None:  # noqa: D102
        c, sizes = self.config, self.sizes
        self.instruction = encoders.InstructionEncoder(sizes.vocabulary, c.width)
        self.state = encoders.PaperStateEncoder(sizes.side, c.width, c.dtype)
        self.action = _embed(sizes.num_actions + 2, c.width)
        tokens = 2 * (sizes.context + sizes.horizon)
        self.position = nn.Embed(tokens, c.width, embedding_init=nn.initializers.zeros)
        steps = sizes.max_steps + sizes.horizon + 1
        self.time = nn.Embed(steps, c.width, embedding_init=nn.initializers.zeros)
        self.transformer = Transformer(c.layers, c.width, c.heads, c.dropout, dtype=c.dtype)
        self.drop = nn.Dropout(c.dropout)
        self.head = dense(sizes.num_actions, use_bias=False)

    def encode(self, context: Context, deterministic: bool = True) -> PyTree:
        """The embeddings that every pass shares: `[2 (K + T), D]`."""
        del deterministic
        _check_context(context, self.sizes)
        horizon, past = self.sizes.horizon, self.sizes.context
        instruction = self.instruction(context.observation.instruction).whole
        states = jax.tree.map(
            lambda x, y: jnp.concatenate([x, y[None]]), context.past, context.observation
        )
        states = jax.vmap(self.state, in_axes=(0, None))(states, instruction)  # [K + 1, D]
        states = jnp.concatenate([states, jnp.repeat(states[-1:], horizon - 1, axis=0)])
        actions = jnp.tanh(self.action(context.actions))
        actions = jnp.concatenate([actions, jnp.zeros((horizon, self.config.width))])
        tokens = jnp.stack([states, actions], axis=1).reshape(2 * (past + horizon), -1)
        time = self.time(jnp.minimum(context.step, self.sizes.max_steps) + horizon)
        return tokens + self.position(jnp.arange(tokens.shape[0])) + time

    def logits(
        self,
        memory: PyTree,
        actions: jax.Array,
        positions: jax.Array,
        deterministic: bool = True,
    ) -> jax.Array:
        """Logits `[P, A]` at `positions [P]` of plan `actions [T]`, which may hold MASK."""
        first = 2 * self.sizes.context
        embedded = jnp.tanh(self.action(actions))
        x = memory.at[first + 1 + 2 * jnp.arange(self.sizes.horizon)].add(embedded)
        x = self.drop(x, deterministic=deterministic)
        h = self.transformer(x, first + 2 * positions, deterministic=deterministic)
        return forbid_early_end(self.head(h), positions)


class ContextTokens(nn.Module):
    """Ours: what a plan must know of its context, in a few tokens.

    The grid is turned so that the agent faces right; learned distances spread over it; it is
    read at the agent, at the goal and as a whole.
    """

    config: ModelConfig
    sizes: Sizes

    @nn.compact
    def __call__(self, context: Context) -> jax.Array:
        """Tokens `[4, D]`: the agent, the goal, the whole grid, the instruction."""
        _check_context(context, self.sizes)
        c, side = self.config, self.sizes.side
        direction = context.observation.pose[2]
        observation = symmetries.rotate(context.observation, direction)
        words = encoders.InstructionEncoder(self.sizes.vocabulary, c.width, name="instruction")
        instruction = words(observation.instruction)
        cells = encoders.CellEmbedding(c.channels, name="cells")(observation)
        if self.sizes.context:
            faced = self._faced(context, observation.grid)
            cells += nn.Dense(c.channels, use_bias=False, name="faced")(faced)
        scale, shift = jnp.split(dense(2 * c.channels, name="modulation")(instruction.whole), 2)
        modulated = cells * (1 + scale) + shift
        if c.word_heads:
            modulated += encoders.WordAttention(c.word_heads, name="words")(cells, instruction)
        encoder = encoders.GridEncoder(
            c.channels, c.fields, c.sweeps, c.rounds, c.dtype, name="grid"
        )
        grid, distances = encoder(modulated, observation.pose[:2], observation.goal)

        def read(features: jax.Array, name: str) -> jax.Array:
            return dense(c.width, scale=0.1, name=name)(features)

        # The agent's neighbourhood holds what the first steps depend on.
        around = encoders.neighbourhood(grid, observation.pose[:2], c.radius)
        kind, colour = observation.carried
        agent = read(around, "read_agent") + read(distances, "read_distances")
        agent += _embed(encoders.OBJECTS, c.width, "carried")(kind)
        agent += _embed(encoders.COLOURS, c.width, "carried_colour")(colour)
        goal = read(encoders.feature_at(grid, observation.goal), "read_goal")
        whole = read(grid.reshape(side * side, -1).max(axis=0), "read_all")
        return jnp.stack([agent, goal, whole, instruction.whole])

    def _faced(self, context: Context, turned: jax.Array) -> jax.Array:
        """Which objects and doors the agent has faced in the context, and when: `[S, S, 2]`.

        1 where it has, and how recently, in (0, 1]: 1 is now. That is what says which part of
        an instruction is done. The past actions, and where the agent went besides, are left
        out: by them a network can recognise a demonstration (docs/experiments.md).

        Args:
            context: what is known.
            turned: `[S, S, 3]` the current grid, turned so that the agent faces right.
        """
        side, past = self.sizes.side, self.sizes.context
        direction = context.observation.pose[2]
        poses = jnp.concatenate([context.past.pose, context.observation.pose[None]])
        known = jnp.append(context.actions <= self.sizes.num_actions, True)  # PAD: before the start
        recency = known * jnp.arange(1, past + 2) / (past + 1)

        def mark(pose: jax.Array) -> jax.Array:
            pose = symmetries.rotate_pose(pose, direction, side)
            front = pose[:2] + jnp.asarray(symmetries.DIRECTION_VECTORS)[pose[2]]
            return encoders.one_cell(front, side)

        kinds = turned[..., 0]
        named = (kinds >= symmetries.FIRST_COLOURED) & (kinds <= symmetries.LAST_COLOURED)
        latest = (jax.vmap(mark)(poses) * recency[:, None, None]).max(axis=0) * named
        return jnp.stack([latest > 0, latest], axis=-1)


class LeapModel(nn.Module):
    """Ours: the state once, and a cached context.

    The tokens of the context are a prefix that never attends to the plan, so its keys and
    values are computed once per plan, and a pass runs over T action tokens only.
    """

    config: ModelConfig
    sizes: Sizes

    def setup(self) -> None:  # noqa: D102
        c, sizes = self.config, self.sizes
        self.context = ContextTokens(c, sizes)
        self.action = _embed(sizes.num_actions + 2, c.width)
        self.position = _embed(sizes.horizon, c.width)
        self.transformer = Transformer(c.layers, c.width, c.heads, c.dropout, dtype=c.dtype)
        self.drop = nn.Dropout(c.dropout)
        self.head = dense(sizes.num_actions, use_bias=False)

    def encode(self, context: Context, deterministic: bool = True) -> PyTree:
        """Keys and values of the prefix tokens, per layer."""
        tokens = self.drop(self.context(context), deterministic=deterministic)
        return self.transformer.prefix(tokens, deterministic=deterministic)

    def logits(
        self,
        memory: PyTree,
        actions: jax.Array,
        positions: jax.Array,
        deterministic: bool = True,
    ) -> jax.Array:
        """Logits `[P, A]` at `positions [P]` of plan `actions [T]`, which may hold MASK."""
        x = self.action(actions) + self.position(jnp.arange(self.sizes.horizon))
        x = self.drop(x, deterministic=deterministic)
        h = self.transformer(x, positions, memory, deterministic=deterministic)
        return forbid_early_end(self.head(h), positions)


class SequenceClassifier(nn.Module):
    """An LSTM that reads a whole plan and says how corrupted it is (paper, appendix, ablation).

    The context is the same as `LeapModel`'s; it is the LSTM's first memory.
    """

    config: ModelConfig
    sizes: Sizes

    def setup(self) -> None:  # noqa: D102
        c = self.config
        self.context = ContextTokens(c, self.sizes)
        self.begin = dense(2 * c.width, scale=0.1)
        self.action = _embed(self.sizes.num_actions, c.width)
        self.recurrence = nn.RNN(nn.OptimizedLSTMCell(c.width))
        self.head = nn.Dense(1)

    def encode(self, context: Context) -> PyTree:
        """The LSTM's first carry, `[D]` and `[D]`."""
        return tuple(jnp.split(self.begin(self.context(context).reshape(-1)), 2))

    def degree(self, memory: PyTree, actions: jax.Array) -> jax.Array:
        """The degree of corruption `[]` of a complete plan `[T]`: 0 none of it, 1 all."""
        states = self.recurrence(self.action(actions), initial_carry=memory)
        return self.head(states[-1])[0]


def _check_context(context: Context, sizes: Sizes) -> None:
    """Refuses what another network would be needed for, while the program is being traced."""
    found = {
        "grid": (context.observation.grid.shape, (sizes.side, sizes.side, 3)),
        "past actions": (context.actions.shape, (sizes.context,)),
    }
    for name, (shape, expected) in found.items():
        if shape != expected:
            raise UserError(
                f"the context's {name} has shape {shape}, but this network was made for "
                f"{expected}: use the level and the context length that it was trained with"
            )


def _embed(count: int, width: int, name: str | None = None) -> nn.Embed:
    return nn.Embed(count, width, embedding_init=_small, name=name)


def _small(key: jax.Array, shape: tuple[int, ...], dtype: jnp.dtype = jnp.float32) -> jax.Array:
    return nn.initializers.normal(0.02)(key, shape, dtype)


def build(config: ModelConfig, sizes: Sizes) -> PaperModel | LeapModel:
    """The module that a configuration describes."""
    if config.architecture == "paper":
        return PaperModel(config, sizes)
    return LeapModel(config, sizes)


def blank_context(sizes: Sizes, instruction_length: int) -> Context:
    """A context of the right shapes, all zeros: what parameters are initialised with."""
    observation = Observation(
        grid=jnp.zeros((sizes.side, sizes.side, 3), jnp.uint8),
        pose=jnp.zeros(3, jnp.int32),
        carried=jnp.zeros(2, jnp.int32),
        goal=jnp.zeros(2, jnp.int32),
        instruction=jnp.ones(instruction_length, jnp.int32),
    )
    past = jax.tree.map(lambda x: jnp.zeros((sizes.context, *x.shape), x.dtype), observation)
    return Context(observation, past, jnp.zeros(sizes.context, jnp.int32), jnp.int32(0))
