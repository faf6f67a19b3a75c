"""A convolution as one matrix product over shifted copies of its map.

On a CPU that is fastest for small maps of many channels, and for large strides
(docs/tried.md).
"""

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax.typing import Dtype

from leapjax.models.linear import linear


def patches(image: jax.Array, side: int, padding: tuple[int, int]) -> jax.Array:
    """`[X, Y, C]` to `[X', Y', side * side * C]`: the neighbourhood of every cell."""
    image = jnp.pad(image, (padding, padding, (0, 0)))
    width, height = image.shape[0] - side + 1, image.shape[1] - side + 1
    shifted = [image[x : x + width, y : y + height] for x in range(side) for y in range(side)]
    return jnp.concatenate(shifted, axis=-1)


def blocks(image: jax.Array, side: int) -> jax.Array:
    """`[X, Y, C]` to `[X / side, Y / side, side * side * C]`: blocks that do not overlap.

    What is left over at the far ends is left out.
    """
    width, height = image.shape[0] // side, image.shape[1] // side
    cut = image[: width * side, : height * side]
    apart = cut.reshape(width, side, height, side, -1).transpose(0, 2, 1, 3, 4)
    return apart.reshape(width, height, -1)


class Convolution(nn.Module):
    """A convolution as one matrix product."""

    features: int
    side: int = 3
    padding: tuple[int, int] = (1, 1)
    stride: int = 1
    dtype: Dtype = jnp.float32  # of the matrix product; parameters are float32

    @nn.compact
    def __call__(self, image: jax.Array) -> jax.Array:
        """`[X, Y, C]` to `[X', Y', features]`."""
        product = linear(self.features, nn.initializers.he_normal(), dtype=self.dtype)
        if self.side % self.stride == 0:  # then a patch is a few blocks, each made once
            image = jnp.pad(image, (self.padding, self.padding, (0, 0)))
            near = patches(blocks(image, self.stride), self.side // self.stride, (0, 0))
        else:
            near = patches(image, self.side, self.padding)[:: self.stride, :: self.stride]
        return product(near)
