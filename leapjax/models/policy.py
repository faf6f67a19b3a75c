"""The network of methods that choose one action at a time: causal attention over a context."""

import flax.linen as nn
import jax
import jax.numpy as jnp

from leapjax.data import windows
from leapjax.models.dropout import Dropout
from leapjax.models.trajectory import ModelConfig, Sizes
from leapjax.models.transformer import Transformer, causal_mask, dense, embed, interleave
from leapjax.types import Context

Said = dict[str, jax.Array]  # by head: [P, count]; as `tokens`, those of the encoder


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
    encoder: nn.Module  # the domain's: context -> [K + 1, D], or [C, D]
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
        self.drop = Dropout(c.dropout)
        self.said = [dense(count, name=name) for name, count in self.heads]

    def __call__(
        self,
        context: Context,
        deterministic: bool = True,
        returns: jax.Array | None = None,
        seen: jax.Array | None = None,
    ) -> Said:
        """What each head says, `[P, count]`, at the last P states, the current one last.

        Args:
            context: what is known.
            deterministic: without dropout.
            returns: `[K + 1]` the return to go at each state, where it is conditioned on them.
            seen: the tokens of the states, if they are known; of a batch, by `see_all`.
        """
        tokens = self.encoder(context) if seen is None else seen
        return self._say(tokens, context, deterministic, returns)

    def see_all(self, contexts: Context) -> jax.Array:
        """A token for each state of B contexts, `[B, K + 1, D]`, of an encoder with `of_all`."""
        return self.encoder.of_all(contexts)

    def transition(
        self, context: Context, deterministic: bool = True, seen: jax.Array | None = None
    ) -> tuple[Said, Said]:
        """What is said before and after the step of a `TransitionWindow`, of its context."""
        earlier, later = windows.before(context), windows.after(context)
        if self.config.architecture != "paper":
            return self(earlier, deterministic), self(later, deterministic)
        states = self.encoder(context) if seen is None else seen  # [K + 2, D]: each is encoded once
        return (
            self._say(states[:-1], earlier, deterministic, None),
            self._say(states[1:], later, deterministic, None),
        )

    def _say(
        self, tokens: jax.Array, context: Context, deterministic: bool, returns: jax.Array | None
    ) -> Said:
        goals = None if returns is None else jnp.tanh(self.goal(returns[:, None]))  # [K + 1, D]
        read = self._sequence if self.config.architecture == "paper" else self._question
        h = read(tokens, context, deterministic, goals)
        found = {name: said(h) for (name, _), said in zip(self.heads, self.said, strict=True)}
        return {**found, "tokens": tokens}

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
