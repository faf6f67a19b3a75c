"""Compiling what runs once."""

import functools

import jax

# Programs this small cost seconds to optimise and milliseconds to run.
quick_jit = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
