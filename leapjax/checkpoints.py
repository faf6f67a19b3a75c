"""Checkpoints: Orbax for the arrays, JSON for what they mean. Nothing is ever unpickled."""

import dataclasses
import json
import types
import typing
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import orbax.checkpoint as ocp

from leapjax.errors import UserError, first_line
from leapjax.types import PyTree, TrainState

T = TypeVar("T")


class Checkpoints:
    """The training states of one run, newest last, in one folder.

    Saving is asynchronous and atomic: a killed program loses the steps since the last
    checkpoint and never more.
    """

    def __init__(self, folder: Path, keep: int = 2) -> None:
        self._manager = ocp.CheckpointManager(
            folder.absolute(),
            options=ocp.CheckpointManagerOptions(max_to_keep=keep, cleanup_tmp_directories=True),
        )

    @property
    def latest(self) -> int | None:
        """The step of the newest checkpoint, or None."""
        return self._manager.latest_step()

    def save(self, state: TrainState) -> None:
        """Writes a state, in the background."""
        self._manager.save(int(state.step), args=ocp.args.StandardSave(state._asdict()))

    def restore(self, like: TrainState) -> TrainState:
        """The newest state; `like` gives structure, shapes and placement.

        Raises:
            UserError: it cannot be read.
        """
        target = jax.tree.map(ocp.utils.to_shape_dtype_struct, like._asdict())
        try:
            restored = self._manager.restore(self.latest, args=ocp.args.StandardRestore(target))
        except Exception as error:  # noqa: BLE001  (TensorStore and Orbax raise many kinds)
            raise UserError(
                f"the checkpoint {self._manager.directory / str(self.latest)} cannot be read "
                f"({first_line(error)}): delete it to continue from the one before"
            ) from None
        return TrainState(**restored)

    def wait(self) -> None:
        """Returns when everything is on disk."""
        self._manager.wait_until_finished()

    def close(self) -> None:
        """Waits, then lets go of the folder."""
        self.wait()
        self._manager.close()


def restore_params(folder: Path, like: PyTree) -> PyTree:
    """The parameters of the newest checkpoint in a folder, with the structure of `like`.

    Raises:
        UserError: there is none, it is damaged, or its arrays have other shapes.
    """
    step = None
    if folder.is_dir():
        steps = [int(p.name) for p in folder.iterdir() if p.name.isdecimal()]
        step = max(steps, default=None)
    if step is None:
        raise UserError(f"no checkpoint in {folder}: expected a folder that a run has written")
    path = (folder / str(step) / "default").absolute()
    try:
        with ocp.PyTreeCheckpointer() as checkpointer:
            saved = checkpointer.metadata(path).item_metadata.tree["params"]
            _check_shapes(saved, like, folder)
            target = {"params": jax.tree.map(ocp.utils.to_shape_dtype_struct, like)}
            arguments = ocp.checkpoint_utils.construct_restore_args(target)
            restored = checkpointer.restore(
                path,
                args=ocp.args.PyTreeRestore(target, restore_args=arguments, partial_restore=True),
            )
    except UserError:
        raise
    except Exception as error:  # noqa: BLE001  (TensorStore and Orbax raise many kinds)
        raise UserError(f"the checkpoint {path} cannot be read ({first_line(error)})") from None
    return jax.tree.map(jnp.asarray, restored["params"])


def _check_shapes(saved: PyTree, like: PyTree, folder: Path) -> None:
    def shapes(tree: PyTree) -> dict[str, tuple[int, ...]]:
        leaves = jax.tree_util.tree_leaves_with_path(tree)
        return {jax.tree_util.keystr(path): tuple(leaf.shape) for path, leaf in leaves}

    found, expected = shapes(saved), shapes(like)
    for name in sorted(expected.keys() | found.keys()):
        if found.get(name) != expected.get(name):
            raise UserError(
                f"the checkpoint in {folder} does not fit its configuration: {name} is "
                f"{found.get(name, 'missing')}, expected {expected.get(name, 'nothing')}"
            )


def from_json(kind: type[T], values: Any) -> T:
    """A frozen configuration dataclass from what `dataclasses.asdict` and JSON made of it.

    Raises:
        UserError: a field that is missing, unknown or of another type.
    """
    if not isinstance(values, dict):
        raise UserError(f"a {kind.__name__} must be a JSON object, got {type(values).__name__}")
    hints = typing.get_type_hints(kind)
    names = {field.name for field in dataclasses.fields(kind)}  # type: ignore[arg-type]
    if names != values.keys():
        odd = sorted(names ^ values.keys())
        raise UserError(f"{kind.__name__}: missing or unknown {', '.join(odd)}")
    converted = {name: _convert(hints[name], values[name], name) for name in names}
    try:
        return kind(**converted)
    except ValueError as error:
        raise UserError(f"{kind.__name__}: {error}") from None


def _convert(hint: Any, value: Any, name: str) -> Any:
    if dataclasses.is_dataclass(hint):
        return from_json(hint, value)  # type: ignore[arg-type]
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        options = typing.get_args(hint)
        if value is None and type(None) in options:
            return None
        return _convert(next(o for o in options if o is not type(None)), value, name)
    if typing.get_origin(hint) is tuple:
        element = typing.get_args(hint)[0]
        if isinstance(value, list):
            return tuple(_convert(element, item, name) for item in value)
    elif hint is float and isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    elif isinstance(value, hint) and (hint is bool or not isinstance(value, bool)):
        return value
    raise UserError(f"{name} must be of type {getattr(hint, '__name__', hint)}, got {value!r}")


def read_json(path: Path) -> Any:
    """The contents of a JSON file.

    Raises:
        UserError: it is missing or is not JSON.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror or error}") from None
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path} is not valid JSON ({error})") from None
