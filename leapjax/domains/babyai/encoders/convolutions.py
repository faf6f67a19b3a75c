"""Convolutions, normalisation and pooling of the paper's encoder.

The fastest convolution on a CPU depends on the map. On these small maps with many channels it is a
matrix product over shifted copies. On whole grids with few channels it is XLA's.
"""

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax.typing import Dtype

NORM_GROUPS = 8  # groups of channels that are normalised together


def stack_patches(image: jax.Array, side: int, padding: tuple[int, int]) -> jax.Array:
    """Stacks the neighbourhood of every cell: `[X, Y, C]` to `[X', Y', side * side * C]`."""
    image = jnp.pad(image, (padding, padding, (0, 0)))
    width, height = image.shape[0] - side + 1, image.shape[1] - side + 1
    shifted = [image[x : x + width, y : y + height] for x in range(side) for y in range(side)]
    return jnp.concatenate(shifted, axis=-1)


def halve(image: jax.Array) -> jax.Array:
    """Takes the maximum of each 2x2 cells: `[X, Y, C]` to `[X // 2, Y // 2, C]`.

    It equals `nn.max_pool`, whose gradient is slower, because XLA searches window by window.
    """
    width, height = image.shape[0] // 2, image.shape[1] // 2
    windows = image[: 2 * width, : 2 * height].reshape(width, 2, height, 2, -1)
    return windows.max(axis=(1, 3))


class Convolution(nn.Module):
    """A convolution as one matrix product, for small maps with many channels.

    Attributes:
        features: features of the result.
        side: side of the kernel, in cells.
        padding: cells to add before and after, along both axes.
        stride: stride in cells.
        dtype: type of the matrix product; parameters are float32.
    """

    features: int
    side: int = 3
    padding: tuple[int, int] = (1, 1)
    stride: int = 1
    dtype: Dtype = jnp.float32

    @nn.compact
    def __call__(self, image: jax.Array) -> jax.Array:
        """Maps `[X, Y, C]` to `[X', Y', features]`."""
        kernel_init = nn.initializers.he_normal()
        product = nn.Dense(self.features, dtype=self.dtype, kernel_init=kernel_init)
        near = stack_patches(image, self.side, self.padding)
        return product(near[:: self.stride, :: self.stride])


class GroupNorm(nn.Module):
    """Group normalisation (Wu and He, 2018), in place of the authors' batch normalisation.

    It equals `nn.GroupNorm`, whose gradient takes as long as a convolution. This module sums over
    cells first, so it splits no large array into groups. Both treat the first axis as a batch, so
    they normalise each column of a map by itself (docs/deviations.md).

    Attributes:
        dtype: type of the result; statistics are float32.
    """

    dtype: Dtype = jnp.float32

    @nn.compact
    def __call__(self, image: jax.Array) -> jax.Array:
        """Scales `NORM_GROUPS` groups of channels of `[X, Y, C]` to mean 0 and variance 1."""
        channels = image.shape[-1]
        scale = self.param("scale", nn.initializers.ones, (channels,))
        bias = self.param("bias", nn.initializers.zeros, (channels,))
        exact = image.astype(jnp.float32)

        def mean(each: jax.Array) -> jax.Array:
            """Averages each column and group, repeated for the group's channels: `[X, 1, C]`."""
            groups = each.mean(axis=1, keepdims=True).reshape(len(image), 1, NORM_GROUPS, -1)
            return jnp.repeat(groups.mean(axis=-1), channels // NORM_GROUPS, axis=-1)

        centre = mean(exact)
        variance = jnp.maximum(mean(exact**2) - centre**2, 0)
        factor = scale * jax.lax.rsqrt(variance + 1e-6)
        return (image * factor + (bias - centre * factor)).astype(self.dtype)


class FiLMBlock(nn.Module):
    """Two convolutions modulated by a condition (paper: ExpertControllerFiLM).

    Attributes:
        width: features of the result.
        dtype: type of matrix products.
    """

    width: int
    dtype: Dtype = jnp.float32

    @nn.compact
    def __call__(self, image: jax.Array, condition: jax.Array) -> jax.Array:
        """Maps an image `[X, Y, C]` and a condition `[D]` to `[X, Y, width]`."""
        h = Convolution(self.width, dtype=self.dtype)(image)
        h = Convolution(self.width, dtype=self.dtype)(nn.relu(GroupNorm(self.dtype)(h)))
        scale, shift = nn.Dense(self.width)(condition), nn.Dense(self.width)(condition)
        return nn.relu(GroupNorm(self.dtype)(h * scale + shift))


class HalvingBlock(nn.Module):
    """A residual block of stride 2: halves the sides of a map, rounded up.

    Attributes:
        width: features of the result.
        dtype: type of matrix products.
    """

    width: int
    dtype: Dtype = jnp.float32

    @nn.compact
    def __call__(self, image: jax.Array) -> jax.Array:
        """Maps `[X, Y, C]` to `[ceil(X / 2), ceil(Y / 2), width]`."""
        h = Convolution(self.width, stride=2, dtype=self.dtype)(image)
        h = Convolution(self.width, dtype=self.dtype)(nn.relu(GroupNorm(self.dtype)(h)))
        aside = Convolution(self.width, 1, (0, 0), 2, self.dtype)(image)
        return nn.relu(GroupNorm(self.dtype)(h) + aside)
