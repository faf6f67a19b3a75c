"""Runs survive signals, kills and unreadable checkpoints."""

import errno
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import babyai
from leapjax.checkpoints import Checkpoints, restore_params
from leapjax.errors import UserError
from leapjax.files import lock_folder
from leapjax.running import jax_setup, results
from leapjax.running import train as running_train
from leapjax.running.interruption import SIGNALS, Interrupted, catch_signals
from leapjax.running.metrics import read_metrics
from leapjax.running.progress import Meter
from leapjax.types import TrainState
from tests.programs import (
    RANDOM,
    ROOT,
    STEPS,
    Place,
    damage,
    only_long,
    place_with_a_run,
    run_python,
)

place = pytest.fixture(place_with_a_run, scope="module")


@only_long
def test_killed_run_ends_like_an_uninterrupted_run(place):
    rng = np.random.default_rng(0)
    for _ in range(10):
        before = max(place.steps_saved("killed"), default=0)
        run = place.start("killed")
        place.wait_for_checkpoint(run, "killed", before if before < STEPS // 2 else 0)
        time.sleep(rng.uniform(0, 0.2))
        run.kill()
        run.wait()
    place.finish(place.start("killed"))
    place.check_same_end("killed")


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 0), (signal.SIGINT, 130)])
def test_stopped_run_saves_and_prints_the_command_to_continue(
    tmp_path, monkeypatch, capsys, number, code
):
    class StoppedMeter(Meter):
        """Sends the signal at step 20 of the training."""

        def update(self, done, note=""):
            if done == 20:
                os.kill(os.getpid(), number)
            super().update(done, note)

    options = [*RANDOM, "--demos", "1", "--steps", "60", "--runs", str(tmp_path / "runs")]
    with monkeypatch.context() as patch, pytest.raises(SystemExit, match=str(code)):
        patch.setattr(running_train, "Meter", StoppedMeter)
        patch.setattr(jax_setup, "exit_at_once", sys.exit)
        babyai.main(options)
    stopped = f"stopped by {signal.Signals(number).name}; continue with: python -m"
    messages = capsys.readouterr().err
    assert messages == f"{stopped} experiments.babyai {' '.join(options)}\n"
    (folder,) = (path for path in (tmp_path / "runs").iterdir() if path.is_dir())
    assert [path.name for path in (folder / "checkpoints").iterdir()] == ["20"]
    assert babyai.main(options) == 0
    assert "continuing at step 20 of 60" in capsys.readouterr().out
    assert [m["step"] for m in read_metrics(folder)] == [20, 40, 60]
    assert len(results.read(tmp_path / "runs" / "babyai.jsonl")) == 1


@only_long
@pytest.mark.parametrize("trial", range(100))
def test_signal_at_any_moment_stops_the_run(tmp_path, trial):
    """No compiled program is cached, so the compiler runs most of the time."""
    rng = np.random.default_rng(trial)
    number, code = ((signal.SIGTERM, 0), (signal.SIGINT, 130))[trial % 2]
    run = Place(tmp_path).start("runs", cache="off")
    while not (tmp_path / "datasets").exists():  # still importing: Python would handle it
        assert run.poll() is None, run.stderr.read()[-2000:]
        time.sleep(0.01)
    time.sleep(rng.uniform(0, 15))
    finished = run.poll() is not None
    run.send_signal(number)
    assert run.wait(60) == (0 if finished else code), run.stderr.read()[-2000:]


def catches_signals(process):
    """Returns whether a process handles SIGTERM; Python itself does not."""
    status = Path(f"/proc/{process.pid}/status").read_text()
    (caught,) = (line.split()[1] for line in status.splitlines() if line.startswith("SigCgt"))
    return bool(int(caught, 16) >> (signal.SIGTERM - 1) & 1)


@only_long
@pytest.mark.parametrize("trial", range(14))
def test_signal_during_imports_stops_the_program(tmp_path, trial):
    rng = np.random.default_rng(trial)
    number, code = ((signal.SIGINT, 130), (signal.SIGTERM, 0))[trial % 2]
    installed = (
        "import sys; sys.argv[0] = 'bin/leapjax'; from leapjax.__main__ import main; "
        "main(['stars', *sys.argv[1:]])"
    )
    program = (
        ["-m", "experiments.stars", *RANDOM], ["-m", "benchmarks.methods"],
        ["-c", installed, *RANDOM],
    )[trial % 3]  # fmt: skip
    run = subprocess.Popen(
        [sys.executable, *program], cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT)},
        text=True, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
    )  # fmt: skip
    while not catches_signals(run):
        assert run.poll() is None, run.stderr.read()
        time.sleep(0.001)
    time.sleep(rng.uniform(0, 3))
    run.send_signal(number)
    assert run.wait(60) == code
    (line,) = run.stderr.read().splitlines()
    assert line.startswith(f"stopped by {signal.Signals(number).name}")


def test_library_installs_no_handlers():
    """`experiments` installs handlers only as the main program."""
    check = (
        "import signal, sys, experiments, leapjax.checkpoints\n"
        "leapjax.checkpoints.hush_orbax()\n"
        "assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL\n"
        "assert sys.unraisablehook is sys.__unraisablehook__"
    )
    assert run_python("-c", check).returncode == 0


def test_dropped_signal_is_raised_at_the_next_check():
    with catch_signals() as interruption:
        for action in (lambda: os.kill(os.getpid(), signal.SIGTERM), interruption.check):
            with pytest.raises(Interrupted, match="SIGTERM"):
                action()
        with pytest.raises(Interrupted, match="SIGTERM"), interruption.defer_signals():
            pytest.fail("long work began")


def test_second_signal_interrupts_a_deferral():
    expects_error = pytest.raises(Interrupted, match="SIGINT")
    with catch_signals() as interruption, expects_error, interruption.defer_signals():
        os.kill(os.getpid(), signal.SIGINT)
        assert interruption.requested == signal.SIGINT
    with catch_signals() as interruption, pytest.raises(Interrupted), interruption.defer_signals():
        os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGTERM)
        pytest.fail("the second waited")


@pytest.mark.parametrize("number", SIGNALS)
def test_swallowed_signal_ends_the_program_unless_it_is_deferred(monkeypatch, number):
    monkeypatch.setattr("leapjax.running.interruption.GRACE", 0.05)
    ended = []
    with catch_signals(ended.append) as interruption:
        with pytest.raises(Interrupted), interruption.defer_signals():
            os.kill(os.getpid(), number)
            time.sleep(0.2)
        assert not ended
    with catch_signals(ended.append), pytest.raises(Interrupted):
        os.kill(os.getpid(), number)
    assert not ended  # the signal ended the block in time
    with catch_signals(ended.append):
        with pytest.raises(Interrupted):  # swallowed here, as in a compiler
            os.kill(os.getpid(), number)
        deadline = time.monotonic() + 20
        while not ended and time.monotonic() < deadline:
            time.sleep(0.01)
    assert [str(stopped) for stopped in ended] == [signal.Signals(number).name]


def make_state(step):
    return TrainState({"w": jnp.full((50, 50), float(step))}, (), jnp.int32(step))


def test_damaged_checkpoint_is_set_aside_and_the_previous_checkpoint_restored(tmp_path):
    checkpoints, messages = Checkpoints(tmp_path), []
    for step in (1, 2, 3):
        checkpoints.save(make_state(step))
    checkpoints.close()
    damage(tmp_path / "3")
    checkpoints = Checkpoints(tmp_path)
    restored = checkpoints.restore(make_state(0), skipped=messages.append)
    assert int(restored.step) == 2
    np.testing.assert_array_equal(restored.params["w"], 2.0)
    assert not (tmp_path / "1").exists()  # the oldest go
    assert len(messages) == 1 and re.search("3 is damaged.*the one before is used", messages[0])
    checkpoints.save(make_state(3))  # replaces the damaged step
    checkpoints.close()
    assert int(Checkpoints(tmp_path).restore(make_state(0)).step) == 3
    assert (tmp_path / "3.damaged").is_dir()


@pytest.mark.parametrize(
    "error",
    [
        OSError(errno.EMFILE, "Too many open files"),
        ValueError("RESOURCE_EXHAUSTED: Too many open files [os_error_code='24']"),  # TensorStore
    ],
)
def test_temporarily_unreadable_checkpoint_is_not_treated_as_damaged(tmp_path, monkeypatch, error):
    def fail_to_open(*arguments, **more):
        raise error

    checkpoints = Checkpoints(tmp_path / "checkpoints")
    checkpoints.save(make_state(1))
    with monkeypatch.context() as patch:
        patch.setattr(checkpoints._manager, "restore", fail_to_open)
        with pytest.raises(UserError, match="now .*Too many open files.* it is left as it is"):
            checkpoints.restore(make_state(0))
    assert int(checkpoints.restore(make_state(0)).step) == 1
    checkpoints.close()


def test_checkpoint_of_another_configuration_raises_an_error_and_stays(tmp_path):
    (tmp_path / "below").mkdir()
    folder = tmp_path / "below" / ".." / "checkpoints"  # another path of the folder
    checkpoints = Checkpoints(folder)
    checkpoints.save(make_state(1))
    checkpoints.close()
    weights, step = restore_params(folder, jax.eval_shape(lambda: make_state(0)).params)
    np.testing.assert_array_equal(weights["w"], 1.0)
    assert step == 1
    other = TrainState({"w": jnp.zeros((3, 3))}, (), jnp.int32(0))
    with pytest.raises(UserError, match=r"params/w is \(50, 50\), expected \(3, 3\)"):
        Checkpoints(folder).restore(other)
    assert (folder / "1").is_dir()


def test_locking_a_folder_twice_raises_an_error(tmp_path):
    expects_error = pytest.raises(UserError, match=rf"in use by another process \({os.getpid()}\)")
    with lock_folder(tmp_path / "run"), expects_error, lock_folder(tmp_path / "run"):
        pass
