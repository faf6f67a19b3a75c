"""The real program in processes of its own, at toy size: started, watched, compared."""

import os
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest

from experiments import results
from leapjax import checkpoints

ROOT = Path(__file__).parent.parent
LONG = os.environ.get("LEAPJAX_TEST_LONG") == "1"  # `make test-long`: minutes to an hour
only_long = pytest.mark.skipif(not LONG, reason="make test-long runs it")
COMMAND = (
    "-m experiments.babyai --demos 6 --episodes 3 --batch 4 --width 16 --heads 2 --layers 1 "
    "--channels 4 --rounds 1 --fields 2 --sweeps 2 --iterations 2 --no-pictures "
    "--checkpoint-seconds 0.1"
).split()


class Place:
    """A folder to run in, with its own data sets and compilation cache."""

    def __init__(self, folder, steps):
        self.folder, self.steps = folder, steps

    def start(self, runs, *options, devices=2):
        """Starts a run whose results go to the folder `runs`."""
        environment = {
            **os.environ,
            "PYTHONPATH": str(ROOT),
            "MINARI_DATASETS_PATH": str(self.folder / "datasets"),
            "LEAPJAX_COMPILATION_CACHE": str(self.folder / "cache"),
            "JAX_NUM_CPU_DEVICES": str(devices),
        }
        return subprocess.Popen(
            [sys.executable, *COMMAND, "--steps", str(self.steps), "--runs", runs, *options],
            cwd=self.folder, env=environment, text=True,
            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
        )  # fmt: skip

    def finish(self, run):
        """Waits for a run that must succeed."""
        assert run.wait(300) == 0, run.stderr.read()

    def steps_saved(self, runs):
        """Of which steps there are checkpoints."""
        folder = (self.folder / runs).glob("*/checkpoints/*")
        return sorted(int(path.name) for path in folder if path.name.isdecimal())

    def wait_for_checkpoint(self, run, runs, after=0):
        """Until there is a checkpoint later than a step, and training goes on."""
        deadline = time.monotonic() + 120
        while not any(after < step < self.steps for step in self.steps_saved(runs)):
            assert run.poll() is None, f"the run ended too soon: {run.stderr.read()}"
            assert time.monotonic() < deadline
            time.sleep(0.005)

    def parameters(self, runs):
        """The final parameters of the only run in a folder."""
        (path,) = (self.folder / runs).glob(f"*/checkpoints/{self.steps}/default")
        with checkpoints.ocp.PyTreeCheckpointer() as checkpointer:
            return checkpointer.restore(path.absolute())["params"]

    def check_same_end(self, runs, tolerance=0.0, expected="whole"):
        """A run ended exactly as another one, or nearly, and left one row."""
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=tolerance),
            self.parameters(runs),
            self.parameters(expected),
        )
        (row,) = results.read(self.folder / runs / "babyai.jsonl")
        (other,) = results.read(self.folder / expected / "babyai.jsonl")
        for name in ("hash", "successes", "mean_length", "plans"):
            assert row[name] == other[name]
