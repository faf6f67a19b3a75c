"""Quick compilation of programs that run once."""

import functools

import jax

from leapjax.planners import bind
from tests import QUICK

quick_jit = functools.partial(jax.jit, compiler_options=QUICK)


@functools.cache
def many_plans(energy, config):
    """Makes a planner for a batch of keys in one context; later calls return the same one."""
    return quick_jit(jax.vmap(bind(energy, config), (None, 0, None)))
