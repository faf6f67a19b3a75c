"""Parameters of networks that have learned nothing, and yet say something of what they see."""

import jax
import numpy as np


def random_like(shapes, scale=0.5, seed=0):
    """Random numbers of the shapes of parameters: nothing is compiled for them.

    Unlike after initialisation nothing is zero: what leaks, or a wrong mask, must show.
    """
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda x: rng.normal(0, scale, x.shape).astype(x.dtype), shapes)


def scaled_like(shapes, seed=0):
    """The same, so that what passes through many layers neither fades nor explodes."""
    rng = np.random.default_rng(seed)

    def leaf(path, shape):
        kind = path[-1].key
        scale = shape.shape[-2] ** -0.5 if kind == "kernel" else 0.5
        value = rng.normal(scale=scale, size=shape.shape)
        return (value + (kind == "scale")).astype(np.float32)

    return jax.tree_util.tree_map_with_path(leaf, shapes)


def random_parameters(agent, scale=0.5, seed=0):
    """The same for the parameters of an agent."""
    return random_like(jax.eval_shape(agent.init, jax.random.key(0)).params, scale, seed)
