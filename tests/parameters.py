"""Parameters of networks that have learned nothing, and yet say something of what they see."""

import jax
import jax.numpy as jnp
import numpy as np

from leapjax import sharding


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


def random_state(agent):
    """A `TrainState` with such parameters, before any step."""
    shapes = jax.eval_shape(agent.init, jax.random.key(0))
    state = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), shapes)
    return state._replace(
        params=random_like(shapes.params, 0.1), extra=random_like(shapes.extra, 0.1)
    )


def make_begin(agent, mesh):
    """In the place of `training.make_begin`, which takes as long to compile as a step.

    For tests that ask neither what a network begins with nor whether it learns.
    """
    state = random_state(agent)
    whole = jax.sharding.NamedSharding(mesh, sharding.REPLICATED)
    return jax.jit(
        lambda seed: (jax.tree.map(jnp.asarray, state), jax.random.key(seed)),
        out_shardings=(sharding.parameter_shardings(state, mesh), whole),
    )
