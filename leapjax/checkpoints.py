"""Checkpoints: Orbax for the arrays, JSON for what they mean. Nothing is ever unpickled."""

import contextlib
import errno
import functools
import glob
import hashlib
import json
import logging
import math
import os
import shutil
import traceback
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
import tensorstore

from leapjax import files, processes, sharding
from leapjax.errors import UserError, first_line
from leapjax.serialization import IDENTITY, identity_digest
from leapjax.types import PyTree, TrainState

ITEM = "default"  # Orbax's name for the only thing that a checkpoint of ours holds
PASSING = {errno.EMFILE, errno.ENFILE, errno.EACCES, errno.EPERM, errno.ENOMEM}  # not damage
ORBAX = Path(ocp.__file__).parent
Shapes = dict[str, tuple[int, ...]]  # by the place of an array in its tree
NO_ROOM = [os.strerror(number) for number in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)]


class Checkpoints:
    """The training states of one run, newest last, in one folder.

    Saving is asynchronous and atomic: a killed program loses the steps since the last
    checkpoint and never more. A checkpoint holds whole arrays, so that a run can go on with
    another number of devices or processes. Of several processes the first one reads and
    writes; all of them call every method but `close`.

    A checkpoint belongs to a configuration: it holds the `identity` with which it was saved,
    and is refused where that is another.
    """

    def __init__(self, folder: Path, identity: str = "", keep: int = 2) -> None:
        check_path(folder)
        hush_orbax()
        self._folder = _absolute(folder)
        self._identity = identity
        self._keep = keep
        self._saved: int | None = None  # the step that was saved last
        if processes.is_first():
            self._manager = self._open()

    def _open(self) -> ocp.CheckpointManager:
        alone = ocp.options.MultiprocessingOptions(primary_host=0, active_processes={0})
        # Orbax makes no folders for some processes only.
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(f"cannot write to {self._folder}: {first_line(error)}") from None
        options = ocp.CheckpointManagerOptions(
            max_to_keep=self._keep, cleanup_tmp_directories=True, create=False,
            multiprocessing_options=alone,
        )  # fmt: skip
        return ocp.CheckpointManager(self._folder, options=options)

    @property
    def latest(self) -> int | None:
        """The step of the newest checkpoint, or None."""
        return processes.first_does(lambda: self._manager.latest_step())

    def save(self, state: TrainState) -> None:
        """Writes a state, in the background.

        Raises:
            UserError: this one, or the one before it, cannot be written.
        """
        # A copy: on a CPU these may be the device's own buffers, which training reuses.
        values = jax.tree.map(np.array, sharding.to_host(state))

        def write() -> None:
            self._finish()
            files.check_room(self._folder, sum(x.nbytes for x in jax.tree.leaves(values)))
            with self._writing():
                arguments = ocp.args.StandardSave(_sealed(values._asdict(), self._identity))
                self._manager.save(int(values.step), args=arguments)
            self._saved = int(values.step)

        processes.first_does(write)

    def restore(
        self, like: TrainState, skipped: Callable[[str], Any] = warnings.warn
    ) -> TrainState | None:
        """The newest state that can be read, or None; `like` gives structure and placement.

        A damaged checkpoint is set aside, as `<step>.damaged`, and the one before is tried.

        Args:
            like: the state of a run of this configuration, on its devices.
            skipped: called with one line for each checkpoint that was set aside.

        Raises:
            UserError: a checkpoint is whole, but of another configuration.
        """
        blank = _blank(like)
        found: list[TrainState] = []

        def read() -> bool:
            found.extend(self._read(blank, skipped))
            return bool(found)

        if not processes.first_does(read):
            return None
        values = processes.broadcast(found[0] if found else blank)
        return sharding.place(values, jax.tree.map(lambda leaf: leaf.sharding, like))

    def _read(self, like: TrainState, skipped: Callable[[str], Any]) -> list[TrainState]:
        """The newest state, as arrays of NumPy, or nothing."""
        self._finish()  # one that is still being written is the newest
        while (latest := self._manager.latest_step()) is not None:
            path = self._folder / str(latest)
            try:
                target = _sealed(like._asdict(), self._identity)
                _check_shapes(_saved_shapes(path), target, path)
                arguments = ocp.args.StandardRestore(target)
                restored = self._manager.restore(latest, args=arguments)
                return [TrainState(**_opened(restored, self._identity, path))]
            except UserError:
                raise
            except Exception as error:  # noqa: BLE001  (TensorStore and Orbax raise many kinds)
                if isinstance(error, MemoryError) or getattr(error, "errno", None) in PASSING:
                    raise UserError(
                        f"cannot read {path} now ({first_line(error)}): it is left as it is"
                    ) from None
                aside = path.with_name(f"{path.name}.damaged")
                shutil.rmtree(aside, ignore_errors=True)
                path.rename(aside)
                self._manager.close()
                self._manager = self._open()
                older = self._manager.latest_step() is not None
                before = "the one before is used" if older else "there is none before it"
                skipped(f"{path} is damaged ({first_line(error)}); it is now {aside}; {before}")
        return []

    def close(self) -> None:
        """Waits until everything is on disk, then lets go of the folder.

        The only method that asks nothing of the other processes: it also ends a run that
        went wrong, where they may be anywhere.

        Raises:
            UserError: a state cannot be written, or is not found where it was to be.
        """
        if processes.is_first():
            self._finish()
            self._manager.close()

    def _finish(self) -> None:
        """Waits until the last state is on disk, and looks for it where it will be read."""
        with self._writing():
            self._manager.wait_until_finished()
        if self._saved is None:
            return
        path, self._saved = self._folder / str(self._saved), None
        try:
            _saved_shapes(path)
        except Exception as error:  # noqa: BLE001  (TensorStore raises many kinds)
            raise UserError(
                f"a checkpoint was written, but is not found in {path} ({first_line(error)}): "
                "choose another folder"
            ) from None

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except Exception as error:  # noqa: BLE001  (TensorStore and Orbax raise many kinds)
            # TensorStore says it at the end of a long line.
            said = next((text for text in NO_ROOM if text in str(error)), first_line(error))
            raise UserError(
                f"cannot write a checkpoint to {self._folder} ({said}); those written before are "
                "intact: make room, and start the same command again"
            ) from None


def _absolute(folder: Path) -> Path:
    """The same folder, by a path that TensorStore reads, which it does not if there is a ".."."""
    return folder.resolve() if ".." in folder.parts else folder.absolute()


def check_path(folder: Path) -> None:
    """Refuses a folder in which checkpoints would not be found again.

    Raises:
        UserError: says how the libraries that write them read its name.
    """
    path = str(_absolute(files.check_path(folder)))
    try:  # of a backslash TensorStore makes a slash
        spec = tensorstore.KvStore.Spec({"driver": "file", "path": f"{path}/"})
        written = spec.to_json()["path"].removesuffix("/")
    except Exception as error:  # noqa: BLE001  (TensorStore raises many kinds)
        written = first_line(error)
    if written != path:
        taken = f"TensorStore takes it for {written}"
    elif glob.escape(path) != path:
        taken = "Orbax takes it for a pattern, with '*', '?' or '['"
    elif ":/" in path:
        taken = "Orbax takes it for an address, with ':/'"
    else:
        return
    raise UserError(f"{path} cannot hold checkpoints ({taken}): choose another folder")


@functools.cache
def hush_orbax() -> None:
    """Keeps Orbax from logging what this module says in one line.

    Of a full disk or a damaged checkpoint many threads of Orbax fail at once, and log each
    failure with its traceback.
    """
    for name in ("absl", "asyncio"):
        logging.getLogger(name).addFilter(lambda record: not _is_of_orbax(record))


def _is_of_orbax(record: logging.LogRecord) -> bool:
    """Whether a warning was logged by Orbax, or is about an exception in it."""
    if record.levelno < logging.WARNING:
        return False
    failure = record.exc_info[2] if record.exc_info else None
    places = [record.pathname, *(frame.filename for frame in traceback.extract_tb(failure))]
    return any(Path(place).is_relative_to(ORBAX) for place in places)


class Unfinished(UserError):
    """A step of a run that was asked for is not there, or cannot be read."""


def newest(folder: Path) -> list[int]:
    """The steps of the checkpoints in a folder, the newest first.

    Raises:
        UserError: the folder cannot hold checkpoints, or cannot be read.
    """
    check_path(folder)
    if not folder.is_dir():
        return []
    try:
        names = [path.name for path in folder.iterdir()]
    except OSError as error:
        raise UserError(f"cannot read {folder}: {first_line(error)}") from None
    # Not `isdecimal` alone: it takes digits of every script, and a number may have many.
    steps = [int(name) for name in names if name.isascii() and name.isdecimal() and len(name) < 20]
    return sorted(steps, reverse=True)


def check_identity(folder: Path, identity: str) -> list[int]:
    """Checks with which identity the newest readable checkpoint was saved, and reads no more.

    Returns:
        How many numbers each array of its parameters has.

    Raises:
        UserError: there is no checkpoint, or it was saved with another identity.
        Unfinished: none can be read.
    """
    reasons = []
    for step in _steps(folder):
        path = _absolute(folder) / str(step)
        try:
            shapes, saved = _saved_shapes(path), _saved_identity(path)
        except Exception as error:  # noqa: BLE001  (TensorStore raises many kinds)
            reasons.append(_cannot_be_read(path, error))
            continue
        _check_same(saved, identity, path)
        return [math.prod(shapes[place]) for place in shapes if place.startswith("params/")]
    raise Unfinished("; ".join(reasons))


def restore_params(
    folder: Path, like: PyTree, identity: str = "", step: int | None = None
) -> PyTree:
    """The parameters of the newest readable checkpoint, with the structure of `like`.

    Warns of each damaged one that it skips; with `step`, no other than that of this step will do.

    Raises:
        UserError: there is none, none can be read, its arrays have other shapes, or it was
            saved with another identity.
        Unfinished: that of `step` is not there, or cannot be read.
    """
    hush_orbax()
    steps = _steps(folder)
    if step is not None:
        if step not in steps:
            raise Unfinished(
                f"{folder} ends at step {steps[0]} of {step}: start the run's command again, and "
                "it goes on"
            )
        steps = [step]
    reasons = []
    for step in steps:
        path = _absolute(folder) / str(step)
        try:
            target = _sealed({"params": _blank(like)}, identity)
            wanted = ("params/", "digests/params/", "identity/")
            found = {
                place: shape
                for place, shape in _saved_shapes(path).items()
                if f"{place}/".startswith(wanted)  # what a target network holds is not asked for
            }
            _check_shapes(found, target, path)
            arguments = ocp.checkpoint_utils.construct_restore_args(target)
            with ocp.PyTreeCheckpointer() as checkpointer:
                restored = checkpointer.restore(
                    path / ITEM,
                    args=ocp.args.PyTreeRestore(
                        target, restore_args=arguments, partial_restore=True
                    ),
                )
            params = _opened(restored, identity, path)["params"]
        except UserError:
            raise
        except Exception as error:  # noqa: BLE001  (TensorStore and Orbax raise many kinds)
            reasons.append(_cannot_be_read(path, error))
        else:
            for reason in reasons:
                warnings.warn(f"{reason}: using step {step}", stacklevel=2)
            return jax.tree.map(jnp.asarray, params)
    raise (UserError if step is None else Unfinished)("; ".join(reasons))


def save_params(folder: Path, params: PyTree, identity: str, step: int) -> None:
    """Writes parameters alone, as `restore_params` reads them.

    Args:
        folder: of checkpoints; others in it are removed.
        params: to write.
        identity: of their configuration.
        step: that they are of.

    Raises:
        UserError: they cannot be written.
    """
    with contextlib.closing(Checkpoints(folder, identity, keep=1)) as saved:
        saved.save(TrainState(params, (), jnp.int32(step)))


def _steps(folder: Path) -> list[int]:
    """The steps of the checkpoints in a folder, the newest first; at least one."""
    steps = newest(folder)
    if not steps:
        raise UserError(f"no checkpoint in {folder}: expected a folder that a run has written")
    return steps


def _cannot_be_read(checkpoint: Path, error: Exception) -> str:
    return f"the checkpoint {checkpoint} cannot be read ({first_line(error)})"


def _blank(like: PyTree) -> PyTree:
    """Arrays of NumPy to say what is to be read."""
    return jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), like)


def _sealed(parts: dict[str, PyTree], identity: str) -> dict[str, PyTree]:
    """The parts of a state, the SHA-256 of the arrays of each, and whose they are.

    The format underneath notices damage to its own structure, not to the numbers.
    """
    return {
        **parts,
        "digests": {name: _digest(part) for name, part in parts.items()},
        IDENTITY: identity_digest(identity),
    }


def _opened(saved: dict[str, PyTree], identity: str, path: Path) -> dict[str, PyTree]:
    """The parts alone, if their arrays are those that were saved, with this identity.

    Raises:
        ValueError: they are damaged.
        UserError: they are whole, but of another configuration.
    """
    parts = {name: part for name, part in saved.items() if name not in ("digests", IDENTITY)}
    for name, part in parts.items():
        if not np.array_equal(_digest(part), saved["digests"][name]):
            raise ValueError(f"the numbers of {name} are not those that were saved")
    _check_same(saved[IDENTITY], identity, path)
    return parts


def _check_same(saved: np.ndarray, identity: str, checkpoint: Path) -> None:
    """Refuses a checkpoint that was saved with another identity."""
    if not np.array_equal(saved, identity_digest(identity)):
        raise UserError(
            f"the checkpoint {checkpoint} is of another configuration than the one beside it: it "
            "was copied here from another run, or the specification was changed; put back what "
            "was there, or train again in another --runs folder"
        )


def _digest(tree: PyTree) -> np.ndarray:
    """`[32]` uint8."""
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(tree):
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return np.frombuffer(digest.digest(), np.uint8)


def _store(checkpoint: Path) -> tensorstore.KvStore:
    """The keys and values of a checkpoint."""
    base = {"driver": "file", "path": f"{checkpoint / ITEM}/"}
    return tensorstore.KvStore.open({"driver": "ocdbt", "base": base}).result()


def _saved_shapes(checkpoint: Path) -> Shapes:
    """The shapes of the arrays in a checkpoint, by their place in the tree.

    Nothing is read but what the arrays say of themselves. (Orbax's `metadata` does the same,
    and keeps a megabyte for ever each time.)

    Raises:
        ValueError: it has no arrays, or some that would be unpacked to more than they hold.
    """
    store = _store(checkpoint)
    shapes = {}
    for key in store.list().result():
        name = key.decode()
        if name.endswith("/.zarray"):
            description = json.loads(store.read(key).result().value)
            place = name.removesuffix("/.zarray").replace(".", "/")
            shapes[place] = tuple(description["shape"])
            pieces = zip(description["chunks"], shapes[place], strict=True)
            if any(piece > max(1, size) for piece, size in pieces):
                raise ValueError(f"{place} is in pieces that are larger than it is")
    if not shapes:
        raise ValueError("it has no arrays")
    return shapes


def _saved_identity(checkpoint: Path) -> np.ndarray:
    """The digest of the identity that a checkpoint was saved with: `[32]` uint8."""
    kvstore = _store(checkpoint).spec().to_json()
    array = tensorstore.open(
        {"driver": "zarr", "kvstore": {**kvstore, "path": f"{IDENTITY}/"}},
        dtype=tensorstore.uint8, shape=identity_digest("").shape, open=True,
    )  # fmt: skip
    return array.result().read().result()


def _shapes(tree: PyTree) -> Shapes:
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    # Orbax keeps named tuples and lists as dictionaries: compare the names alone.
    return {
        "/".join(
            str(getattr(k, "key", getattr(k, "idx", getattr(k, "name", k)))) for k in path
        ): tuple(leaf.shape)
        for path, leaf in leaves
    }


def _check_shapes(found: Shapes, like: PyTree, checkpoint: Path) -> None:
    expected = _shapes(like)
    for name in sorted(expected.keys() | found.keys()):
        if found.get(name) != expected.get(name):
            raise UserError(
                f"the checkpoint {checkpoint} does not fit its configuration: {name} is "
                f"{found.get(name, 'missing')}, expected {expected.get(name, 'nothing')}; it was "
                "made by another version: remove it, or use another --runs folder"
            )
