"""Toy runs of the real program: their folders, and processes that tests watch and compare."""

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
import pytest

from leapjax import domains, pretrained
from leapjax.checkpoints import Checkpoints
from leapjax.configuration import change, make_domain, specify
from leapjax.files import lock_folder
from leapjax.presets import PRESETS
from leapjax.running import command_line, results
from leapjax.running import main as running
from leapjax.running.run import Experiment
from leapjax.types import TrainState
from tests import frozen_lake
from tests.parameters import random_parameters

ROOT = Path(__file__).parent.parent
LONG = os.environ.get("LEAPJAX_TEST_LONG") == "1"  # `make test-long`: minutes to an hour
only_long = pytest.mark.skipif(not LONG, reason="make test-long runs it")

SINGLE = "--episodes 3 --batch 4 --width 16 --heads 2 --layers 1 --no-pictures".split()
SMALL = [*SINGLE, "--iterations", "2"]
TOY = [*SMALL, *"--demos 6 --channels 4 --rounds 1 --fields 2 --sweeps 2".split()]
TOY_RUN = [*TOY, "--steps", "4", "--iterations", "3"]  # the run that most tests inspect
RANDOM = "--method random --episodes 3 --no-pictures".split()  # compiles only the planner

# Separate processes run a method of single actions, which compiles quickly.
LAKE = Experiment("lake", "frozen_lake")
COMMAND = ["-m", "tests.programs", *SINGLE, "--method", "bc", "--demos", "6"]
STEPS = 200


def main():
    """Runs an experiment in FrozenLake: `python -m tests.programs`."""
    domains.DOMAINS[LAKE.domain] = frozen_lake.FROZEN_LAKE
    PRESETS[LAKE.domain] = {"leapjax": frozen_lake.preset}
    return running.main(LAKE)


def toy_row(**values):
    """Returns a row of results with every field."""
    row = {name: "x" if kind is str else kind(1) for name, kind in results.FIELDS.items()}
    return {**row, "success": 1.0, **values}


def with_options(config, options):
    """Changes options of the command line, in whichever part of a configuration holds them."""
    changes = {}
    for option, value in options.items():
        parts = (part for part in pretrained.GROUPS if hasattr(getattr(config, part), option))
        changes.setdefault(next(parts, ""), {})[option] = value
    return change(config, **changes.pop("", {}), **changes)


def untrained_run(folder, *options):
    """Saves a run with random parameters, without compiling a program; returns its folder."""
    (chosen,) = command_line.parse("babyai", [*TOY, *options])
    domain = make_domain(chosen)
    specification = specify(chosen, chosen.seeds[0], domain)
    pretrained.save_specification(folder, specification)
    seal(folder, random_parameters(pretrained.make_agent(specification, domain), 0.1))
    return folder


def seal(folder, params=None):
    """Saves `params`, or else one parameter, as the only checkpoint of a folder."""
    shutil.rmtree(folder / pretrained.CHECKPOINTS, ignore_errors=True)
    specification = pretrained.parse_specification(folder)
    checkpoints = Checkpoints(
        folder / pretrained.CHECKPOINTS, pretrained.describe_identity(specification)
    )
    if params is None:
        params = {"w": jnp.ones((30, 30))} if specification.method != "random" else {}
    checkpoints.save(TrainState(params, (), jnp.int32(specification.training.steps)))
    checkpoints.close()


def damage(checkpoint):
    """Cuts every file of a checkpoint's arrays in half."""
    for file in (checkpoint / "default").rglob("*"):
        if file.is_file():
            file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def run_python(*arguments, stdout=subprocess.PIPE, **environment):
    """Runs Python in the folder of the repository; returns the completed process."""
    return subprocess.run(
        [sys.executable, *arguments], cwd=ROOT, env={**os.environ, **environment},
        stdout=stdout, stderr=subprocess.PIPE, text=True, check=False,
    )  # fmt: skip


class Place:
    """A working folder of runs, with its own data sets."""

    def __init__(self, folder):
        self.folder = folder

    def start(self, runs, *options, devices=2, cache=None):
        """Starts a run that writes to the folder `runs`; `cache`: folder of programs, or "off"."""
        environment = {
            **os.environ,
            "PYTHONPATH": str(ROOT),
            "MINARI_DATASETS_PATH": str(self.folder / "datasets"),
            "JAX_NUM_CPU_DEVICES": str(devices),
        }
        if cache is not None:
            environment["LEAPJAX_COMPILATION_CACHE"] = cache
        schedule = ["--steps", str(STEPS), "--checkpoint-seconds", "0"]
        return subprocess.Popen(
            [sys.executable, *COMMAND, *schedule, "--runs", runs, *options],
            cwd=self.folder, env=environment, text=True,
            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
        )  # fmt: skip

    def finish(self, run):
        """Waits for a run that must succeed."""
        assert run.wait(300) == 0, run.stderr.read()

    def steps_saved(self, runs):
        """Returns the steps of the checkpoints, sorted."""
        folder = (self.folder / runs).glob("*/checkpoints/*")
        return sorted(int(path.name) for path in folder if path.name.isdecimal())

    def wait_for_checkpoint(self, run, runs, after=0):
        """Waits for a checkpoint later than step `after`, before the last step."""
        deadline = time.monotonic() + 120
        while not any(after < step < STEPS for step in self.steps_saved(runs)):
            assert run.poll() is None, f"the run ended too soon: {run.stderr.read()}"
            assert time.monotonic() < deadline
            time.sleep(0.005)

    def rows(self, runs):
        """Returns the result rows of the runs in a folder."""
        return results.read(self.folder / runs / f"{LAKE.name}.jsonl")

    def parameters(self, runs):
        """Returns the final parameters of the only run in a folder."""
        (path,) = (self.folder / runs).glob(f"*/checkpoints/{STEPS}/default")
        with ocp.PyTreeCheckpointer() as checkpointer:
            return checkpointer.restore(path.absolute())["params"]

    def check_same_end(self, runs, tolerance=0.0):
        """Compares a run's parameters, with `tolerance`, and its row to the uninterrupted run."""
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=tolerance),
            self.parameters(runs),
            self.parameters("whole"),
        )
        (row,), (other,) = self.rows(runs), self.rows("whole")
        for name in ("hash", "successes", "mean_length", "plans"):
            assert row[name] == other[name]


def find_shared_folder(tmp_path_factory) -> Path:
    """Returns a folder that the workers of a test session share."""
    folder = tmp_path_factory.getbasetemp()
    return folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder


def place_with_a_run(tmp_path_factory):
    """Finishes a run on two devices, once per test session, and returns its place."""
    place = Place(find_shared_folder(tmp_path_factory) / "programs")
    with lock_folder(place.folder, wait=True):
        if not place.rows("whole"):
            place.finish(place.start("whole"))
    return place


if __name__ == "__main__":
    sys.exit(main())
