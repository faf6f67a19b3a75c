"""How an agent acts with a network: it encodes contexts, and scores actions by an energy."""

from collections.abc import Callable
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from leapjax.agents.base import Setup
from leapjax.domain import check_context
from leapjax.energy import single_action
from leapjax.types import Context, EncodeNext, Energy, Params, PyTree


def make_encode(
    setup: Setup, encode: Callable[[Params, Context], PyTree]
) -> Callable[[Params, Context], PyTree]:
    """Makes an energy's `encode`, which checks the shapes of contexts while it is traced.

    Args:
        setup: arguments of `make_agent`.
        encode: (params, context) -> memory.
    """

    def checked(params: Params, context: Context) -> PyTree:
        check_context(context, setup.domain, setup.context)
        return encode(params, jax.tree.map(jnp.asarray, context))

    return checked


def make_encode_next(
    setup: Setup, module: nn.Module, encode: Callable[[Params, Context, jax.Array], PyTree]
) -> EncodeNext | None:
    """Makes an agent's `encode_next`. Its cache holds the tokens `[K, D]` of the last K states.

    Returns `None` if the encoder makes no token for each state, or if contexts hold no past.

    Args:
        setup: arguments of `make_agent`.
        module: network with `encode_next`.
        encode: (params, context, tokens of the encoder) -> memory.
    """
    if setup.model.architecture != "paper" or setup.context == 0:
        return None

    def encode_next(params: Params, context: Context, cache: PyTree) -> tuple[PyTree, PyTree]:
        check_context(context, setup.domain, setup.context)
        context = jax.tree.map(jnp.asarray, context)
        tokens: Any = module.apply(params, context, cache, method="encode_next")
        return encode(params, context, tokens), tokens[1 : setup.context + 1]

    return encode_next


def make_acting_energy(
    setup: Setup,
    apply: Callable[[Params, Context], PyTree],
    score: Callable[[PyTree], jax.Array] = lambda outputs: outputs["logits"],
) -> Energy:
    """Makes the energy of a method that chooses one action at a time.

    Args:
        setup: arguments of `make_agent`.
        apply: (params, context) -> outputs of the network.
        score: (outputs) -> logits or Q-values `[P, A - 1]` at the last P states; the last row is
            the current state's.
    """
    return single_action(
        make_encode(setup, apply),
        lambda params, outputs: score(outputs)[-1],
        setup.domain.num_actions,
    )
