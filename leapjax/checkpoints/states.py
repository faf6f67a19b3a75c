"""Saves and restores the training states of a run."""

import contextlib
import errno
import os
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp

from leapjax import files, processes, sharding
from leapjax.checkpoints.contents import check_shapes, make_blank, read_shapes
from leapjax.checkpoints.damage import is_damage, set_aside
from leapjax.checkpoints.logs import hush_orbax
from leapjax.checkpoints.paths import check_path, to_absolute
from leapjax.checkpoints.sealing import seal, unseal
from leapjax.errors import UserError, first_line
from leapjax.types import TrainState

NO_ROOM = [os.strerror(number) for number in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)]


class Checkpoints:
    """Saves and restores the training states of one run in one folder.

    Saving is asynchronous and atomic: a killed program loses only the steps since the last
    checkpoint. A checkpoint holds whole arrays, so a run can resume with another number of
    devices or processes. The first process reads and writes; all processes must call every
    method except `close`.

    Args:
        folder: folder of the checkpoints.
        identity: identity of the configuration; restoring with another identity raises UserError.
        keep: number of checkpoints to keep, the newest.
    """

    def __init__(self, folder: Path, identity: str = "", keep: int = 2) -> None:
        check_path(folder)
        hush_orbax()
        self._folder = to_absolute(folder)
        self._identity = identity
        self._keep = keep
        self._saved: int | None = None  # the last step, until `_finish` finds it on disk
        if processes.is_first():
            self._manager = self._open()

    def _open(self) -> ocp.CheckpointManager:
        alone = ocp.options.MultiprocessingOptions(primary_host=0, active_processes={0})
        # Orbax does not make the folder if only some processes write.
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(f"cannot write to {self._folder}: {first_line(error)}") from None
        options = ocp.CheckpointManagerOptions(
            max_to_keep=self._keep, cleanup_tmp_directories=True, create=False,
            multiprocessing_options=alone,
        )  # fmt: skip
        return ocp.CheckpointManager(self._folder, options=options)

    def save(self, state: TrainState) -> None:
        """Writes a state in the background.

        Raises:
            UserError: this state, or the one before it, cannot be written.
        """
        # Copied: on a CPU the arrays may share the device's buffers, which training reuses.
        values = jax.tree.map(np.array, sharding.to_host(state))

        def write() -> None:
            self._finish()
            files.check_room(self._folder, sum(x.nbytes for x in jax.tree.leaves(values)))
            with self._explain_failure():
                arguments = ocp.args.StandardSave(seal(values._asdict(), self._identity))
                self._manager.save(int(values.step), args=arguments)
            self._saved = int(values.step)

        processes.run_on_first(write)

    def restore(
        self, like: TrainState, skipped: Callable[[str], Any] = warnings.warn
    ) -> TrainState | None:
        """Reads the newest intact state; returns `None` if no state is intact.

        Renames each damaged checkpoint to `<step>.damaged`, and tries the previous checkpoint.

        Args:
            like: state of this configuration, for the structure and the placement on devices.
            skipped: called with one line for each damaged checkpoint.

        Raises:
            UserError: a checkpoint is intact, but belongs to another configuration.
        """
        blank = make_blank(like)
        found: list[TrainState] = []

        def read() -> bool:
            found.extend(self._read(blank, skipped))
            return bool(found)

        if not processes.run_on_first(read):
            return None
        values = processes.broadcast(found[0] if found else blank)
        return sharding.place(values, jax.tree.map(lambda leaf: leaf.sharding, like))

    def _read(self, like: TrainState, skipped: Callable[[str], Any]) -> list[TrainState]:
        """Returns a list with the newest intact state, as NumPy arrays, or an empty list."""
        self._finish()  # the newest state may still be being written
        while (latest := self._manager.latest_step()) is not None:
            path = self._folder / str(latest)
            try:
                target = seal(like._asdict(), self._identity)
                check_shapes(read_shapes(path), target, path)
                arguments = ocp.args.StandardRestore(target)
                restored = self._manager.restore(latest, args=arguments)
                return [TrainState(**unseal(restored, self._identity, path))]
            except UserError:
                raise
            except Exception as error:  # noqa: BLE001  (TensorStore and Orbax raise many kinds)
                if not is_damage(error):
                    raise UserError(
                        f"cannot read {path} now ({first_line(error)}): it is left as it is"
                    ) from None
                aside = set_aside(path)
                self._manager.close()
                self._manager = self._open()
                older = self._manager.latest_step() is not None
                before = "the one before is used" if older else "there is none before it"
                skipped(f"{path} is damaged ({first_line(error)}); it is now {aside}; {before}")
        return []

    def close(self) -> None:
        """Waits until all states are on disk, then closes the folder.

        This is the only method that does not communicate with other processes. So it can also end
        a run that failed in a single process.

        Raises:
            UserError: a state cannot be written, or is not found after writing.
        """
        if processes.is_first():
            self._finish()
            self._manager.close()

    def _finish(self) -> None:
        """Waits until the last state is on disk, and checks that it can be found there."""
        with self._explain_failure():
            self._manager.wait_until_finished()
        if self._saved is None:
            return
        path, self._saved = self._folder / str(self._saved), None
        try:
            read_shapes(path)
        except Exception as error:  # noqa: BLE001  (TensorStore raises many kinds)
            raise UserError(
                f"a checkpoint was written, but is not found in {path} ({first_line(error)}): "
                "choose another folder"
            ) from None

    @contextlib.contextmanager
    def _explain_failure(self) -> Iterator[None]:
        """Turns the exceptions of a failed write into a UserError of one line."""
        try:
            yield
        except Exception as error:  # noqa: BLE001  (TensorStore and Orbax raise many kinds)
            # TensorStore names the cause at the end of a long line.
            cause = next((text for text in NO_ROOM if text in str(error)), first_line(error))
            raise UserError(
                f"cannot write a checkpoint to {self._folder} ({cause}); those written before are "
                "intact: make room, and start the same command again"
            ) from None
