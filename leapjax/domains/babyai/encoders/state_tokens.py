"""The paper's encoder: a token for each state of a context."""

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax.typing import Dtype

from leapjax.domains.babyai import vocabulary
from leapjax.domains.babyai.encoders.cells import COLOURS, DIRECTIONS, OBJECTS
from leapjax.domains.babyai.encoders.convolutions import (
    Convolution,
    FiLMBlock,
    GroupNorm,
    HalvingBlock,
    halve,
)
from leapjax.domains.babyai.encoders.instructions import LARGE, InstructionEncoder
from leapjax.domains.babyai.observations import Observation
from leapjax.domains.babyai.repeats import map_repeats
from leapjax.models.encoder import Encoder
from leapjax.types import Context

AT_A_TIME = 16  # states that a core encodes together


class StateEncoder(nn.Module):
    """Encodes pose, goal and carried object as one vector (paper, appendix: 256, 256, 128).

    Attributes:
        side: S, side of the grid.
        width: width of the vector.
    """

    side: int
    width: int

    @nn.compact
    def __call__(self, observation: Observation) -> jax.Array:
        """Computes `[width]`; embeds coordinates instead of scaling them, as the authors' code."""

        def table(count: int, name: str) -> nn.Embed:
            return nn.Embed(count, self.width, embedding_init=LARGE, name=name)

        # The last row is for unobserved goals, whose coordinates are -1.
        coordinates = table(self.side + 1, "coordinates")
        parts = [
            coordinates(observation.pose[:2]),
            table(DIRECTIONS, "direction")(observation.pose[2:]),
            coordinates(jnp.where(observation.goal < 0, self.side, observation.goal)),
            # The appendix does not encode the carried object; levels with movable objects need it.
            table(OBJECTS, "carried")(observation.carried[:1]),
            table(COLOURS, "carried_colour")(observation.carried[1:]),
        ]
        h = jnp.concatenate(parts).reshape(-1)
        h = jnp.tanh(nn.Dense(2 * self.width)(h))
        h = jnp.tanh(nn.Dense(2 * self.width)(h))
        return nn.Dense(self.width)(h)


class PaperStateEncoder(nn.Module):
    """The image encoder of the appendix, fused with instruction and pose by FiLM.

    Attributes:
        side: S, side of the grid.
        width: D, width of the token.
        dtype: type of convolutions.
    """

    side: int
    width: int
    dtype: Dtype = jnp.float32

    @nn.compact
    def __call__(self, observation: Observation, instruction: jax.Array) -> jax.Array:
        """Computes the token `[width]` of one state, given the encoded instruction `[D]`."""

        def layer(h: jax.Array, side: int) -> jax.Array:
            h = Convolution(self.width, side, dtype=self.dtype)(h)
            return nn.relu(GroupNorm(self.dtype)(h))

        h = layer(observation.grid.astype(jnp.float32), 2)
        h = halve(h)
        h = layer(h, 3)
        if self.side >= 7:  # a smaller grid would leave an empty map
            h = halve(h)
        if self.side >= 16:  # "may vary a little depending on the environment size"
            h = HalvingBlock(self.width, self.dtype)(h)
        for _ in range(2):
            h = FiLMBlock(self.width, self.dtype)(h, instruction)
        state = StateEncoder(self.side, self.width)(observation)
        for _ in range(2):
            h = FiLMBlock(self.width, self.dtype)(h, state)
        return nn.relu(nn.Dense(self.width)(h.reshape(-1)))


class StateTokens(Encoder):
    """The encoder of the appendix: `[K + 1, D]`, a token for each state, oldest first.

    Attributes:
        side: S, side of the grid.
        width: D, width of a token.
        dtype: type of convolutions.
        later: whether to add a token for later states, whose unknown pose is (0, 0, 0).
    """

    side: int
    width: int
    dtype: Dtype = jnp.float32
    later: bool = False

    def setup(self) -> None:  # noqa: D102
        self.instruction = InstructionEncoder(vocabulary.SIZE, self.width, LARGE)
        self.state = PaperStateEncoder(self.side, self.width, self.dtype)

    def add_later_state(self) -> Encoder:  # noqa: D102
        return self.clone(later=True)

    def __call__(self, context: Context) -> jax.Array:  # noqa: D102
        return self.encode_next(context, None)

    def encode_next(self, context: Context, known: jax.Array | None) -> jax.Array:
        """Encodes all states in a batch, which is faster than one after the other.

        A later state differs from the current state only in its pose, which the network reads late.
        So `vmap` over the two poses computes the layers before it once.
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
            poses = jnp.stack([now.pose, _hide_pose(now).pose])
            tokens = jax.vmap(lambda pose: self.state(now._replace(pose=pose), instruction))(poses)
            if known is None and context.actions.shape[0]:
                known = read(past, instruction)
        return tokens if known is None else jnp.concatenate([known, tokens])

    def encode_batch(self, contexts: Context) -> jax.Array:
        """Encodes contexts; on a CPU a few states at a time, and equal consecutive states once.

        The feature maps of a few states fit in a core's cache. Consecutive states are equal, for
        example, before the start of an episode.
        """
        if not contexts.actions.shape[1] or jax.default_backend() != "cpu":
            return super().encode_batch(contexts)
        now = contexts.observation
        later = [jax.vmap(_hide_pose)(now)] if self.later else []
        states = jax.tree.map(
            lambda past, *others: jnp.concatenate([past, *(x[:, None] for x in others)], axis=1),
            contexts.past, now, *later,
        )  # fmt: skip
        instructions = jax.vmap(lambda instruction: self.instruction(instruction).whole)(
            now.instruction
        )
        return map_repeats(self.state, states, instructions, AT_A_TIME)


def _hide_pose(observation: Observation) -> Observation:
    """Sets the pose to (0, 0, 0), which stands for an unknown pose."""
    return observation._replace(pose=jnp.zeros_like(observation.pose))
