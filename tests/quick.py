"""Compiling what runs once."""

import functools

import jax

from tests import QUICK

quick_jit = functools.partial(jax.jit, compiler_options=QUICK)
