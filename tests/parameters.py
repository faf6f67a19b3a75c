"""Parameters of networks that have learned nothing, and yet say something of what they see."""

import jax
import numpy as np


def random_like(shapes, scale=0.5, seed=0):
    """Random numbers of the shapes of parameters: nothing is compiled for them.

    Nothing is zero or tiny, as after initialisation: what leaks, or a wrong mask, must show.
    """
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda x: rng.normal(0, scale, x.shape).astype(x.dtype), shapes)


def random_parameters(agent, scale=0.5, seed=0):
    """The same for the parameters of an agent."""
    return random_like(jax.eval_shape(agent.init, jax.random.key(0)).params, scale, seed)
