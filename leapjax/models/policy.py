"""The network of methods that choose one action at a time: causal attention over a context."""

import flax.linen as nn
import jax
import jax.numpy as jnp

from leapjax.data import windows
from leapjax.models.config import ModelConfig, Sizes
from leapjax.models.encoder import Encoder
from leapjax.models.transformer import Transformer, causal_mask, dense, embed, interleave
from leapjax.types import Context

Said = dict[str, jax.Array]  # by head: [P, count]


class PolicyModel(nn.Module):
    """Logits, values or whatever a method needs, read off the states of a context.

    Architecture `paper`: tokens s_1 a_1 s_2 a_2 ... s_n, each of which sees those before it, and
    something is said at every state. Architecture `leapjax`: the encoder's few tokens and one
    that asks, so that something is said at the current state only. `P` states in all. Where it
    is conditioned on returns to go, their tokens precede the states', or join the one that asks
    (Chen et al., Decision Transformer).
    """

    config: ModelConfig
    sizes: Sizes
    encoder: Encoder  # the domain's: context -> [K + 1, D], or [C, D]
    heads: tuple[tuple[str, int], ...]  # what is said: a name, and how many numbers
    conditioned: bool = False  # on returns to go

    def setup(self) -> None:  # noqa: D102
        c = self.config
        if c.architecture == "paper":
            self.action = embed(self.sizes.num_actions + 2, c.width)
            zeros = nn.initializers.zeros
            tokens = (3 if self.conditioned else 2) * (self.sizes.context + 1) - 1
            self.position = nn.Embed(tokens, c.width, embedding_init=zeros)
            self.time = nn.Embed(self.sizes.max_steps + 1, c.width, embedding_init=zeros)
        else:
            self.question = embed(1, c.width)
        if self.conditioned:
            self.goal = dense(c.width, scale=1.0)
        self.transformer = Transformer(c.layers, c.width, c.heads, c.dropout, dtype=c.dtype)
        self.drop = nn.Dropout(c.dropout)
        self.said = [dense(count, name=name) for name, count in self.heads]

    def __call__(
        self,
        context: Context,
        deterministic: bool = True,
        returns: jax.Array | None = None,
        tokens: jax.Array | None = None,
    ) -> Said:
        """What each head says, `[P, count]`, at the last P states, the current one last.

        Args:
            context: what is known.
            deterministic: without dropout.
            returns: `[K + 1]` the return to go at each state, where it is conditioned on them.
            tokens: the encoder's, from `encode_batch` or `encode_next`; None: encode the context.
        """
        tokens = self.encoder(context) if tokens is None else tokens
        return self._say(tokens, context, deterministic, returns)

    def encode_batch(self, contexts: Context) -> jax.Array:
        """Returns the encoder's tokens `[B, C, D]` of B contexts."""
        return self.encoder.encode_batch(contexts)

    def encode_next(self, context: Context, known: jax.Array | None) -> jax.Array:
        """Returns the encoder's tokens of a context, given those of its past states."""
        return self.encoder.encode_next(context, known)

    def encode_transitions(self, contexts: Context) -> tuple[jax.Array, jax.Array]:
        """Returns the encoder's tokens before and after the steps of transitions, `[B, C, D]` each.

        Args:
            contexts: of B `TransitionWindow`s.
        """
        if self.config.architecture != "paper":
            earlier, later = (jax.vmap(f)(contexts) for f in (windows.before, windows.after))
            return self.encode_batch(earlier), self.encode_batch(later)
        states = self.encode_batch(contexts)  # [B, K + 2, D]: each is encoded once
        return states[:, :-1], states[:, 1:]

    def transition(
        self, context: Context, tokens: tuple[jax.Array, jax.Array], deterministic: bool = True
    ) -> tuple[Said, Said]:
        """What is said before and after the step of a transition.

        Args:
            context: of the `TransitionWindow`.
            tokens: its rows of what `encode_transitions` returned.
            deterministic: without dropout.
        """
        earlier, later = tokens
        return (
            self._say(earlier, windows.before(context), deterministic, None),
            self._say(later, windows.after(context), deterministic, None),
        )

    def _say(
        self, tokens: jax.Array, context: Context, deterministic: bool, returns: jax.Array | None
    ) -> Said:
        goals = None if returns is None else jnp.tanh(self.goal(returns[:, None]))  # [K + 1, D]
        read = self._sequence if self.config.architecture == "paper" else self._question
        h = read(tokens, context, deterministic, goals)
        return {name: said(h) for (name, _), said in zip(self.heads, self.said, strict=True)}

    def _sequence(
        self, states: jax.Array, context: Context, deterministic: bool, goals: jax.Array | None
    ) -> jax.Array:
        actions = jnp.tanh(self.action(context.actions))  # [K, D]
        each = [states, actions] if goals is None else [goals, states, actions]
        tokens = interleave(*each)
        tokens += self.position(jnp.arange(tokens.shape[0]))
        tokens += self.time(jnp.minimum(context.step, self.sizes.max_steps))
        return self.transformer(
            self.drop(tokens, deterministic=deterministic),
            len(each) * jnp.arange(states.shape[0]) + len(each) - 2,
            mask=causal_mask(tokens.shape[0]), deterministic=deterministic,
        )  # fmt: skip

    def _question(
        self, tokens: jax.Array, context: Context, deterministic: bool, goals: jax.Array | None
    ) -> jax.Array:
        del context
        tokens = self.drop(tokens, deterministic=deterministic)
        memory = self.transformer.prefix(tokens, deterministic=deterministic)
        first = jnp.zeros(1, jnp.int32)
        question = self.question(first) if goals is None else self.question(first) + goals[-1:]
        return self.transformer(question, first, memory, deterministic=deterministic)


def past_and_present(past: jax.Array, present: jax.Array, count: int) -> jax.Array:
    """What belongs to each of the last `count` states: `[K]` and `[]` to `[count]`."""
    return jnp.append(past, present)[past.shape[0] + 1 - count :]
