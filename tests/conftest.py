"""Fixtures and hooks that several test files share."""

import gc
import shutil
from pathlib import Path

import jax
import pytest

from experiments import babyai
from leapjax import training
from leapjax.domains.babyai import demonstrations, levels
from leapjax.files import lock_folder
from leapjax.types import Demonstration
from tests import OURS, parameters
from tests.programs import TOY_RUN, find_shared_folder

# Tracing makes many objects, few of them garbage, and JAX also cleans up at each collection.
gc.set_threshold(100_000, 20, 20)

# The longest files first, so that two workers end together. (test_processes and test_interruption
# share a run: they start apart, so that the second need not wait until the first has made it.)
FIRST = ["babyai", "training", "processes", "benchmarks", "interruption", "planners", "models"]


def pytest_collection_modifyitems(items):
    names = [f"test_{name}.py" for name in FIRST]
    items.sort(key=lambda item: ([*names, item.path.name]).index(item.path.name))


def pytest_unconfigure():
    """Deletes the compilation cache of the tests when pytest ends."""
    if OURS:
        shutil.rmtree(OURS, ignore_errors=True)


@pytest.fixture(autouse=True)
def minari_folder(tmp_path, monkeypatch):
    """Gives each test an empty Minari folder, so that no test touches the user's."""
    folder = tmp_path / "minari"
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder))
    return folder


@pytest.fixture
def quick_begin(monkeypatch):
    """Starts runs from random parameters, without compiling a program to draw them."""
    monkeypatch.setattr(training, "make_begin", parameters.make_begin)


@pytest.fixture(scope="session")
def local_demonstrations() -> list[Demonstration]:
    """Five demonstrations of GoToLocalS7N5; tests must not change them."""
    level = levels.find_level("GoToLocalS7N5")
    collected = demonstrations.collect(level, 5, seed=0).demonstrations
    for leaf in jax.tree.leaves([(d.observations, d.actions, d.rewards) for d in collected]):
        leaf.setflags(write=False)
    return collected


@pytest.fixture(scope="session")
def toy_run(tmp_path_factory) -> Path:
    """The folder of a run of four steps; tests must not change it."""
    folder = find_shared_folder(tmp_path_factory) / "toy"
    with lock_folder(folder, wait=True), pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("MINARI_DATASETS_PATH", str(folder / "minari"))
        if not (folder / "runs" / "babyai.jsonl").exists():
            assert babyai.main(TOY_RUN) == 0
    (run,) = (path for path in (folder / "runs").iterdir() if path.is_dir())
    return run
