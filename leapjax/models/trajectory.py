"""Masked language models over trajectories (paper, section 3.1): `encode`, then `logits`.

Both models score actions from the same `Context`. No position of the plan carries a later
state than the current one (paper, equation 4), so the memory is computed once per plan and only
action tokens change from pass to pass. What a state looks like is the domain's: its `Encoder`
is a field of the model.
"""

import dataclasses
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from leapjax.checks import check_at_least, check_types
from leapjax.models.dropout import Dropout
from leapjax.models.encoder import Encoder
from leapjax.models.transformer import KeysValues, Transformer, causal_mask, dense, embed
from leapjax.types import Context, PyTree

ARCHITECTURES = ("paper", "leapjax")
ATTENTIONS = ("full", "causal")
DTYPES = ("float32", "bfloat16")
MOST_LAYERS = 200  # each is compiled by itself, which takes about a second


@dataclasses.dataclass(frozen=True)
class ModelConfig:
    """The network. The defaults are the paper's transformer.

    Attributes:
        architecture: Network: "leapjax" for ours, "paper" for that of the appendix.
        layers: Transformer layers.
        heads: Attention heads.
        width: D, embedding dimension; a multiple of the heads.
        dropout: Dropout rate of embeddings, attention and residuals.
        dtype: Type of matrix products, "float32" or "bfloat16"; parameters are always float32.
        attention: Attention between the actions of a plan: "full", or "causal", where no action
            sees a later one.
        neighbours: The token of an action also holds the actions beside it. Only LEAP with
            architecture "leapjax" has this.
    """

    architecture: str = "leapjax"
    layers: int = 3
    heads: int = 4
    width: int = 128
    dropout: float = 0.1
    dtype: str = "float32"
    attention: str = "full"
    neighbours: bool = False

    def __post_init__(self) -> None:
        check_types(self)
        if self.architecture not in ARCHITECTURES:
            raise ValueError(
                f"unknown architecture {self.architecture!r}: "
                f"expected one of {', '.join(ARCHITECTURES)}"
            )
        if self.attention not in ATTENTIONS:
            raise ValueError(
                f"unknown attention {self.attention!r}: expected one of {', '.join(ATTENTIONS)}"
            )
        check_at_least(self, 1, "layers", most=MOST_LAYERS)
        check_at_least(self, 1, "heads", "width")
        if self.neighbours and (self.architecture, self.attention) != ("leapjax", "full"):
            raise ValueError(
                "neighbours needs architecture 'leapjax', where actions stand side by side, and "
                "attention 'full': with 'causal' a token may not hold a later action"
            )
        if not 0 <= self.dropout < 1:
            raise ValueError(f"dropout must be in [0, 1), got {self.dropout}")
        if self.dtype not in DTYPES:
            raise ValueError(f"unknown dtype {self.dtype!r}: expected one of {', '.join(DTYPES)}")
        if self.width % self.heads:
            raise ValueError(f"width {self.width} is not a multiple of {self.heads} heads")


@dataclasses.dataclass(frozen=True)
class Sizes:
    """What a model must know of its environment and of the plans it scores."""

    num_actions: int  # A, the end action included
    context: int  # K
    horizon: int  # T
    max_steps: int  # the longest episode, for the embedding of time


def forbid_early_end(logits: jax.Array, positions: jax.Array) -> jax.Array:
    """The end action, which is the last one, is never the first of a plan: `[P, A]`."""
    end = jnp.arange(logits.shape[-1]) == logits.shape[-1] - 1
    return jnp.where(end & (positions[:, None] == 0), -jnp.inf, logits)


def attention_mask(config: ModelConfig, tokens: int, prefix: int = 0) -> jax.Array | None:
    """What each token of a plan may attend to, `[tokens, prefix + tokens]`; None: to all."""
    return causal_mask(tokens, prefix) if config.attention == "causal" else None


class Memory(NamedTuple):
    """What all plans from one context share, to the paper's network."""

    prefix: list[KeysValues] | None  # of the context's tokens, per layer, where none sees a plan
    tokens: jax.Array  # embeddings of all other tokens


class PaperModel(nn.Module):
    """The network of the paper's appendix: state and action tokens, interleaved.

    Tokens s_1 a_1 ... s_n a_n s_n a_n+1 ... with fully bidirectional attention (or causal
    attention, as the paper has it in Atari); an action is read off its state token and all
    tokens share one embedding of the time at the end of the plan, as in the authors' code.
    Where it is conditioned on returns to go, the token of one precedes each state's.

    With causal attention no token of the context depends on the plan: their keys and values are
    computed once per plan, and a pass runs over the plan's tokens only.
    """

    config: ModelConfig
    sizes: Sizes
    states: Encoder  # the domain's: a token for each state of a context, [K + 1, D], of which the
    # last stands at all positions of a plan (eq. 4); or one more, which stands at the later ones
    conditioned: bool = False  # on returns to go

    def setup(self) -> None:  # noqa: D102
        c, sizes = self.config, self.sizes
        nn.share_scope(self, self.states)  # its parameters lie beside the others
        self.action = embed(sizes.num_actions + 2, c.width)
        self.each = 3 if self.conditioned else 2  # tokens of a step
        tokens = self.each * (sizes.context + sizes.horizon)
        self.position = nn.Embed(tokens, c.width, embedding_init=nn.initializers.zeros)
        steps = sizes.max_steps + sizes.horizon + 1
        self.time = nn.Embed(steps, c.width, embedding_init=nn.initializers.zeros)
        if self.conditioned:
            self.goal = dense(c.width, scale=1.0)
        self.transformer = Transformer(c.layers, c.width, c.heads, c.dropout, dtype=c.dtype)
        self.drop = Dropout(c.dropout)
        self.head = dense(sizes.num_actions, use_bias=False)

    def encode_batch(self, contexts: Context) -> jax.Array:
        """Returns the encoder's tokens `[B, K + 1, D]` of B contexts, or K + 2 of each."""
        return self.states.encode_batch(contexts)

    def encode_next(self, context: Context, known: jax.Array | None) -> jax.Array:
        """Returns the encoder's tokens of a context, given those of its past states."""
        return self.states.encode_next(context, known)

    def encode(
        self,
        context: Context,
        deterministic: bool = True,
        returns: jax.Array | None = None,
        tokens: jax.Array | None = None,
    ) -> Memory:
        """What every pass shares: the context's keys and values, per layer, and embeddings.

        Those are of the plan's tokens, `[2 T, D]`, or 3 for each step where it is conditioned. With
        full attention, or no past, there are no keys and values, and the embeddings are of all
        tokens, `[2 (K + T), D]`.

        Args:
            context: what is known.
            deterministic: without dropout.
            returns: `[K + 1]` the return to go at each state, where it is conditioned on them.
            tokens: the encoder's, from `encode_batch` or `encode_next`; None: encode the context.
        """
        horizon = self.sizes.horizon
        seen = self.states(context) if tokens is None else tokens
        states, later = seen[: self.sizes.context + 1], seen[-1]

        def with_plan(known: jax.Array, ahead: jax.Array) -> jax.Array:
            return jnp.concatenate([known, jnp.repeat(ahead[None], horizon - 1, axis=0)])

        actions = jnp.tanh(self.action(context.actions))
        actions = jnp.concatenate([actions, jnp.zeros((horizon, self.config.width))])
        steps = [with_plan(states, later), actions]  # of [K + T, D]
        if returns is not None:
            wanted = jnp.tanh(self.goal(returns[:, None]))
            steps.insert(0, with_plan(wanted, wanted[-1]))
        tokens = jnp.stack(steps, axis=1).reshape(-1, self.config.width)
        time = self.time(jnp.minimum(context.step, self.sizes.max_steps) + horizon)
        tokens = tokens + self.position(jnp.arange(tokens.shape[0])) + time
        if self.config.attention != "causal" or self.sizes.context == 0:
            return Memory(None, tokens)
        known, planned = jnp.split(tokens, [self.each * self.sizes.context])
        known = self.drop(known, deterministic=deterministic)
        mask = causal_mask(known.shape[0])
        return Memory(self.transformer.prefix(known, mask, deterministic), planned)

    def logits(
        self,
        memory: Memory,
        actions: jax.Array,
        positions: jax.Array,
        deterministic: bool = True,
    ) -> jax.Array:
        """Logits `[P, A]` at `positions [P]` of plan `actions [T]`, which may hold MASK."""
        check_plan(actions, self.sizes.horizon)
        prefix, tokens = memory
        before = tokens.shape[0] - self.each * self.sizes.horizon  # tokens of the context
        asked = before + self.each * jnp.arange(self.sizes.horizon) + self.each - 2
        x = tokens.at[asked + 1].add(jnp.tanh(self.action(actions)))
        x = self.drop(x, deterministic=deterministic)
        mask = attention_mask(self.config, x.shape[0], 0 if prefix is None else len(prefix[0].keys))
        h = self.transformer(x, asked[positions], prefix, mask, deterministic)
        return forbid_early_end(self.head(h), positions)


class Prefix(NamedTuple):
    """What all plans from one context share, to our network."""

    known: list[KeysValues]  # of the context's tokens, per layer
    places: jax.Array  # [T, D] what each position of the plan is


class LeapModel(nn.Module):
    """Ours: the state once, and a cached context.

    The tokens of the context are a prefix that never attends to the plan, so its keys and
    values are computed once per plan, and a pass runs over T action tokens only. Where it is
    conditioned on the return to go, that is one more token of the context.

    Where the encoder does not say what a position of the plan is (`encode_positions`), an
    embedding of it is learned.
    """

    config: ModelConfig
    sizes: Sizes
    context: Encoder  # the domain's: a few tokens of a context, [C, D]
    conditioned: bool = False  # on the return to go

    def setup(self) -> None:  # noqa: D102
        c, sizes = self.config, self.sizes
        self.action = embed(sizes.num_actions + 2, c.width)
        if self.conditioned:
            self.goal = dense(c.width, scale=1.0)
        self.position = embed(sizes.horizon, c.width)
        if c.neighbours:
            scale = c.width**-0.5
            self.before = dense(c.width, use_bias=False, scale=scale)
            self.after = dense(c.width, use_bias=False, scale=scale)
        self.transformer = Transformer(c.layers, c.width, c.heads, c.dropout, dtype=c.dtype)
        self.drop = Dropout(c.dropout)
        self.head = dense(sizes.num_actions, use_bias=False)

    def encode_batch(self, contexts: Context) -> jax.Array:
        """Returns the encoder's tokens `[B, C, D]` of B contexts."""
        return self.context.encode_batch(contexts)

    def encode(
        self,
        context: Context,
        deterministic: bool = True,
        returns: jax.Array | None = None,
        tokens: jax.Array | None = None,
    ) -> Prefix:
        """Keys and values of the prefix tokens, and what positions of a plan are.

        Args:
            context: what is known.
            deterministic: without dropout.
            returns: `[K + 1]` the return to go at each state, where it is conditioned on it.
            tokens: the encoder's, from `encode_batch`; None: encode the context.
        """
        tokens = self.context(context) if tokens is None else tokens
        if returns is not None:
            tokens = jnp.concatenate([tokens, jnp.tanh(self.goal(returns[-1:, None]))])
        tokens = self.drop(tokens, deterministic=deterministic)
        known = self.transformer.prefix(tokens, deterministic=deterministic)
        places = self.context.encode_positions(context, self.sizes.horizon)
        if places is None:
            places = self.position(jnp.arange(self.sizes.horizon))
        return Prefix(known, places)

    def logits(
        self,
        memory: Prefix,
        actions: jax.Array,
        positions: jax.Array,
        deterministic: bool = True,
    ) -> jax.Array:
        """Logits `[P, A]` at `positions [P]` of plan `actions [T]`, which may hold MASK."""
        check_plan(actions, self.sizes.horizon)
        x = self.drop(self._tokens(actions) + memory.places, deterministic=deterministic)
        mask = attention_mask(self.config, self.sizes.horizon, memory.known[0].keys.shape[0])
        h = self.transformer(x, positions, memory.known, mask, deterministic=deterministic)
        return forbid_early_end(self.head(h), positions)

    def _tokens(self, actions: jax.Array) -> jax.Array:
        """`[T, D]` of the actions of a plan.

        With those beside each of them a layer finds what goes with its neighbour. Otherwise one
        has to learn to fetch the neighbour before the next can learn to use it, neither of which
        is of use alone (short convolutions: Fu et al., 2023, H3).
        """
        each = self.action(actions)
        if not self.config.neighbours:
            return each
        nothing = jnp.zeros_like(each[:1])
        before = self.before(jnp.concatenate([nothing, each[:-1]]))
        after = self.after(jnp.concatenate([each[1:], nothing]))
        return each + before + after


class SequenceClassifier(nn.Module):
    """An LSTM that reads a whole plan and says how corrupted it is (paper, appendix, ablation).

    The tokens of the context are the LSTM's first memory.
    """

    config: ModelConfig
    sizes: Sizes
    context: Encoder  # the domain's: context -> [C, D]

    def setup(self) -> None:  # noqa: D102
        c = self.config
        self.begin = dense(2 * c.width, scale=0.1)
        self.action = embed(self.sizes.num_actions, c.width)
        self.recurrence = nn.RNN(nn.OptimizedLSTMCell(c.width))
        self.head = nn.Dense(1)

    def encode_batch(self, contexts: Context) -> jax.Array:
        """Returns the encoder's tokens `[B, C, D]` of B contexts."""
        return self.context.encode_batch(contexts)

    def encode(self, context: Context, tokens: jax.Array | None = None) -> PyTree:
        """The LSTM's first carry, `[D]` and `[D]`.

        Args:
            context: what is known.
            tokens: the encoder's, from `encode_batch`; None: encode the context.
        """
        tokens = self.context(context) if tokens is None else tokens
        return tuple(jnp.split(self.begin(tokens.reshape(-1)), 2))

    def degree(self, memory: PyTree, actions: jax.Array) -> jax.Array:
        """The degree of corruption `[]` of a complete plan `[T]`: 0 none of it, 1 all."""
        check_plan(actions, self.sizes.horizon)
        states = self.recurrence(self.action(actions), initial_carry=memory)
        return self.head(states[-1])[0]


Model = PaperModel | LeapModel


def build(
    config: ModelConfig,
    sizes: Sizes,
    encoder: Encoder,
    conditioned: bool = False,
    repeat_state: bool = True,
) -> Model:
    """The masked language model that a configuration describes, around a domain's encoder.

    Args:
        config: of the network.
        sizes: of what it plans in.
        encoder: the domain's, for its architecture.
        conditioned: on returns to go.
        repeat_state: at all positions of a plan (paper, equation 4); if not, later ones have one
            without a pose.

    Raises:
        UserError: the state shall not be repeated, and nothing else can stand in its place.
    """
    encoder = encoder if repeat_state else encoder.add_later_state()
    if config.architecture == "paper":
        return PaperModel(config, sizes, encoder, conditioned)
    return LeapModel(config, sizes, encoder, conditioned)


def check_plan(actions: jax.Array, horizon: int) -> None:
    """Refuses plans that are longer or shorter than those a network was made for.

    Raises:
        ValueError: says how long they have to be.
    """
    if actions.shape != (horizon,):
        raise ValueError(f"a plan of shape {actions.shape}: this network was made for ({horizon},)")
