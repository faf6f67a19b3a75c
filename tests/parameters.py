"""Small agents, and random parameters that make outputs depend on inputs."""

import jax
import jax.numpy as jnp
import numpy as np

from leapjax import sharding
from leapjax.agents.base import Setup
from leapjax.methods import find_method
from leapjax.models.config import ModelConfig
from leapjax.presets import find_preset


def make_leap_agent(name, domain, **model):
    """Makes LEAP's agent with a small network; `name` is the name of the domain."""
    config = find_preset(name, domain.level, "leap", "leapjax")
    model = ModelConfig(layers=1, heads=2, width=16, dropout=0.0, **model)
    setup = Setup(domain, 0, config.planner.horizon, model, config.training, config.method_settings)
    return find_method("leap").make_agent(setup, None)


def random_like(shapes, scale=0.5, seed=0):
    """Draws random numbers in the shapes of parameters, without compiling a program.

    Initialisation would set some to zero, which could hide a leak or a wrong mask.
    """
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda x: rng.normal(0, scale, x.shape).astype(x.dtype), shapes)


def scaled_like(shapes, seed=0):
    """Draws like `random_like`, at scales that keep signals stable through many layers."""
    rng = np.random.default_rng(seed)

    def leaf(path, shape):
        kind = path[-1].key
        scale = shape.shape[-2] ** -0.5 if kind == "kernel" else 0.5
        value = rng.normal(scale=scale, size=shape.shape)
        return (value + (kind == "scale")).astype(np.float32)

    return jax.tree_util.tree_map_with_path(leaf, shapes)


def random_parameters(agent, scale=0.5, seed=0):
    """Draws parameters of an agent, like `random_like`."""
    return random_like(jax.eval_shape(agent.init, jax.random.key(0)).params, scale, seed)


def random_state(agent):
    """Makes a `TrainState` with random parameters, before the first step."""
    shapes = jax.eval_shape(agent.init, jax.random.key(0))
    state = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), shapes)
    return state._replace(
        params=random_like(shapes.params, 0.1), extra=random_like(shapes.extra, 0.1)
    )


def make_begin(agent, mesh):
    """Replaces `training.make_begin`, which takes as long to compile as a step.

    For tests that depend neither on initial parameters nor on learning.
    """
    state = random_state(agent)
    whole = jax.sharding.NamedSharding(mesh, sharding.REPLICATED)
    return jax.jit(
        lambda seed: (jax.tree.map(jnp.asarray, state), jax.random.key(seed)),
        out_shardings=(sharding.parameter_shardings(state, mesh), whole),
    )
