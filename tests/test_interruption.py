"""Runs that are stopped, killed or out of disk: what is lost, what is said, how they go on."""

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
from tests.programs import RANDOM, ROOT, STEPS, Place, only_long, place_with_a_run

place = pytest.fixture(place_with_a_run, scope="module")


@only_long
def test_a_run_that_is_killed_goes_on_as_if_it_had_not_been(place):
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
def test_a_run_that_is_asked_to_stop_saves_and_says_how_to_go_on(
    tmp_path, monkeypatch, capsys, number, code
):
    class Stopped(Meter):
        """The signal comes at step 20 of the training."""

        def update(self, done, note=""):
            if done == 20:
                os.kill(os.getpid(), number)
            super().update(done, note)

    options = [*RANDOM, "--demos", "1", "--steps", "60", "--runs", str(tmp_path / "runs")]
    with monkeypatch.context() as patch, pytest.raises(SystemExit, match=str(code)):
        patch.setattr(running_train, "Meter", Stopped)
        patch.setattr(jax_setup, "exit_at_once", sys.exit)
        babyai.main(options)
    stopped = f"stopped by {signal.Signals(number).name}; continue with: python -m"
    said = capsys.readouterr().err
    assert said == f"{stopped} experiments.babyai {' '.join(options)}\n"
    (folder,) = (path for path in (tmp_path / "runs").iterdir() if path.is_dir())
    assert [path.name for path in (folder / "checkpoints").iterdir()] == ["20"]
    assert babyai.main(options) == 0
    assert "continuing at step 20 of 60" in capsys.readouterr().out
    assert [m["step"] for m in read_metrics(folder)] == [20, 40, 60]
    assert len(results.read(tmp_path / "runs" / "babyai.jsonl")) == 1


@only_long
@pytest.mark.parametrize("trial", range(100))
def test_a_signal_at_any_moment(tmp_path, trial):
    """Nothing is compiled yet, so that most of the time a compiler runs."""
    rng = np.random.default_rng(trial)
    number, code = ((signal.SIGTERM, 0), (signal.SIGINT, 130))[trial % 2]
    run = Place(tmp_path).start("runs", cache="off")
    while not (tmp_path / "datasets").exists():  # still importing: Python itself would answer
        assert run.poll() is None, run.stderr.read()[-2000:]
        time.sleep(0.01)
    time.sleep(rng.uniform(0, 15))
    over = run.poll() is not None
    run.send_signal(number)
    assert run.wait(60) == (0 if over else code), run.stderr.read()[-2000:]


def catches_signals(process):
    """Whether a process has a handler of SIGTERM, which Python itself has not."""
    status = Path(f"/proc/{process.pid}/status").read_text()
    (caught,) = (line.split()[1] for line in status.splitlines() if line.startswith("SigCgt"))
    return bool(int(caught, 16) >> (signal.SIGTERM - 1) & 1)


@only_long
@pytest.mark.parametrize("trial", range(14))
def test_a_signal_while_a_program_is_imported(tmp_path, trial):
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


def test_a_library_has_no_handlers():
    """`experiments` changes nothing unless it is the program."""
    check = (
        "import signal, sys, experiments, leapjax.checkpoints\n"
        "leapjax.checkpoints.hush_orbax()\n"
        "assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL\n"
        "assert sys.unraisablehook is sys.__unraisablehook__"
    )
    subprocess.run([sys.executable, "-c", check], cwd=ROOT, check=True)


def test_a_signal_that_python_dropped_is_noticed_at_the_next_look():
    with catch_signals() as interruption:
        for look in (lambda: os.kill(os.getpid(), signal.SIGTERM), interruption.check):
            with pytest.raises(Interrupted, match="SIGTERM"):
                look()
        with pytest.raises(Interrupted, match="SIGTERM"), interruption.defer_signals():
            pytest.fail("long work began")


def test_a_deferred_signal_waits_and_a_second_one_does_not():
    refused = pytest.raises(Interrupted, match="SIGINT")
    with catch_signals() as interruption, refused, interruption.defer_signals():
        os.kill(os.getpid(), signal.SIGINT)
        assert interruption.requested == signal.SIGINT
    with catch_signals() as interruption, pytest.raises(Interrupted), interruption.defer_signals():
        os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGTERM)
        pytest.fail("the second waited")


@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_without_effect_ends_the_program_unless_it_waits(monkeypatch, number):
    monkeypatch.setattr("leapjax.running.interruption.GRACE", 0.05)
    ended = []
    with catch_signals(ended.append) as interruption:
        with pytest.raises(Interrupted), interruption.defer_signals():
            os.kill(os.getpid(), number)
            time.sleep(0.2)
        assert not ended
    with catch_signals(ended.append), pytest.raises(Interrupted):
        os.kill(os.getpid(), number)
    assert not ended  # it had its effect in time
    with catch_signals(ended.append):
        with pytest.raises(Interrupted):  # and here, as in a compiler, it has none
            os.kill(os.getpid(), number)
        deadline = time.monotonic() + 20
        while not ended and time.monotonic() < deadline:
            time.sleep(0.01)
    assert [str(stopped) for stopped in ended] == [signal.Signals(number).name]


def state(step):
    return TrainState({"w": jnp.full((50, 50), float(step))}, (), jnp.int32(step))


def test_a_damaged_checkpoint_is_set_aside_and_the_one_before_is_used(tmp_path):
    saved, said = Checkpoints(tmp_path), []
    for step in (1, 2, 3):
        saved.save(state(step))
    saved.close()
    for file in (tmp_path / "3" / "default").rglob("*"):
        if file.is_file():
            file.write_bytes(file.read_bytes()[:20])
    saved = Checkpoints(tmp_path)
    restored = saved.restore(state(0), skipped=said.append)
    assert int(restored.step) == 2
    np.testing.assert_array_equal(restored.params["w"], 2.0)
    assert len(said) == 1 and re.search("3 is damaged.*the one before is used", said[0])
    saved.save(state(3))  # the step that was damaged
    saved.close()
    assert int(Checkpoints(tmp_path).restore(state(0)).step) == 3
    assert (tmp_path / "3.damaged").is_dir()


def test_a_checkpoint_that_cannot_be_read_now_is_not_taken_for_a_damaged_one(tmp_path, monkeypatch):
    def busy(*arguments, **more):
        raise OSError(errno.EMFILE, "Too many open files")

    saved = Checkpoints(tmp_path / "checkpoints")
    saved.save(state(1))
    with monkeypatch.context() as patch:
        patch.setattr(saved._manager, "restore", busy)
        with pytest.raises(UserError, match="now .*Too many open files.* it is left as it is"):
            saved.restore(state(0))
    assert int(saved.restore(state(0)).step) == 1
    saved.close()


def test_a_checkpoint_of_another_configuration_is_refused_and_stays(tmp_path):
    (tmp_path / "below").mkdir()
    folder = tmp_path / "below" / ".." / "checkpoints"  # which leads to the same
    saved = Checkpoints(folder)
    saved.save(state(1))
    saved.close()
    found = restore_params(folder, jax.eval_shape(lambda: state(0)).params)
    np.testing.assert_array_equal(found["w"], 1.0)
    other = TrainState({"w": jnp.zeros((3, 3))}, (), jnp.int32(0))
    with pytest.raises(UserError, match=r"params/w is \(50, 50\), expected \(3, 3\)"):
        Checkpoints(folder).restore(other)
    assert (folder / "1").is_dir()


def test_a_folder_in_use_is_refused_until_its_lock_is_let_go_of(tmp_path):
    refused = pytest.raises(UserError, match=rf"in use by another process \({os.getpid()}\)")
    with lock_folder(tmp_path / "run"), refused, lock_folder(tmp_path / "run"):
        pass
