"""Reads and writes the parameters of a model alone, without the rest of a training state."""

import contextlib
import math
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import orbax.checkpoint as ocp

from leapjax.checkpoints.contents import (
    ITEM,
    check_shapes,
    make_blank,
    read_identity,
    read_shapes,
)
from leapjax.checkpoints.damage import describe_damage
from leapjax.checkpoints.logs import hush_orbax
from leapjax.checkpoints.paths import find_newest, to_absolute
from leapjax.checkpoints.sealing import check_same, seal, unseal
from leapjax.checkpoints.states import Checkpoints
from leapjax.errors import UserError
from leapjax.types import PyTree, TrainState


class Unfinished(UserError):
    """The requested step of a run does not exist, or its checkpoint cannot be read."""


def check_identity(folder: Path, identity: str) -> list[int]:
    """Checks the identity of the newest readable checkpoint without reading its parameters.

    Returns:
        Number of elements of each array of the parameters.

    Raises:
        UserError: there is no checkpoint, or it was saved with another identity.
        Unfinished: no checkpoint can be read.
    """
    reasons = []
    for step in _find_steps(folder):
        path = to_absolute(folder) / str(step)
        try:
            shapes, saved = read_shapes(path), read_identity(path)
        except Exception as error:  # noqa: BLE001  (TensorStore raises many kinds)
            reasons.append(describe_damage(path, error))
            continue
        check_same(saved, identity, path)
        return [math.prod(shapes[place]) for place in shapes if place.startswith("params/")]
    raise Unfinished("; ".join(reasons))


def restore_params(
    folder: Path, like: PyTree, identity: str = "", step: int | None = None
) -> tuple[PyTree, int]:
    """Reads the parameters of the newest readable checkpoint, or of the checkpoint of a step.

    Warns of each damaged checkpoint that it skips.

    Args:
        folder: folder of checkpoints.
        like: parameters of the same structure and shapes.
        identity: identity of their configuration.
        step: step of the checkpoint; `None` for the newest readable checkpoint.

    Returns:
        The parameters, and the step of the checkpoint that they are from.

    Raises:
        UserError: there is no readable checkpoint, or its arrays have other shapes or another
            identity.
        Unfinished: the checkpoint of `step` does not exist, or cannot be read.
    """
    hush_orbax()
    steps = _find_steps(folder)
    if step is not None:
        if step not in steps:
            raise Unfinished(
                f"{folder} ends at step {steps[0]} of {step}: start the run's command again, and "
                "it goes on"
            )
        steps = [step]
    reasons = []
    for step in steps:
        path = to_absolute(folder) / str(step)
        try:
            target = seal({"params": make_blank(like)}, identity)
            prefixes = ("params/", "digests/params/", "identity/")
            found = {
                place: shape
                for place, shape in read_shapes(path).items()
                if f"{place}/".startswith(prefixes)  # skips the target network
            }
            check_shapes(found, target, path)
            arguments = ocp.checkpoint_utils.construct_restore_args(target)
            with ocp.PyTreeCheckpointer() as checkpointer:
                restored = checkpointer.restore(
                    path / ITEM,
                    args=ocp.args.PyTreeRestore(
                        target, restore_args=arguments, partial_restore=True
                    ),
                )
            params = unseal(restored, identity, path)["params"]
        except UserError:
            raise
        except Exception as error:  # noqa: BLE001  (TensorStore and Orbax raise many kinds)
            reasons.append(describe_damage(path, error))
        else:
            for reason in reasons:
                warnings.warn(f"{reason}: using step {step}", stacklevel=2)
            return jax.tree.map(jnp.asarray, params), step
    raise (UserError if step is None else Unfinished)("; ".join(reasons))


def save_params(folder: Path, params: PyTree, identity: str, step: int) -> None:
    """Writes parameters alone, for `restore_params`.

    Args:
        folder: folder of checkpoints; its other checkpoints are removed.
        params: parameters to write.
        identity: identity of their configuration.
        step: number of training steps of the parameters.

    Raises:
        UserError: the parameters cannot be written.
    """
    with contextlib.closing(Checkpoints(folder, identity, keep=1)) as saved:
        saved.save(TrainState(params, (), jnp.int32(step)))


def _find_steps(folder: Path) -> list[int]:
    """Returns the steps of the checkpoints in a folder, the newest first.

    Raises:
        UserError: the folder has no checkpoint.
    """
    steps = find_newest(folder)
    if not steps:
        raise UserError(f"no checkpoint in {folder}: expected a folder that a run has written")
    return steps
