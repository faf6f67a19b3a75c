"""Two processes train, evaluate, write results and stop as one process does."""

import signal
import socket
import subprocess
import sys

import numpy as np
import pytest

from leapjax.rollouts import Episodes, join
from leapjax.running.jax_setup import Cluster
from tests.programs import ROOT, only_long, place_with_a_run

place = pytest.fixture(place_with_a_run, scope="module")


def find_free_address():
    with socket.socket() as listener:
        listener.bind(("localhost", 0))
        return f"localhost:{listener.getsockname()[1]}"


def start_two(place, runs, *options):
    cluster = ("--coordinator", find_free_address(), "--num-processes", "2", *options)
    return [
        place.start(runs, *cluster, "--process-id", str(index), devices=1) for index in range(2)
    ]


# A sum of two numbers does not depend on their order, so results are bit-identical. Split
# parameters need a different program.
@pytest.mark.parametrize(("fsdp", "tolerance"), [(1, 0.0), pytest.param(2, 1e-6, marks=only_long)])
def test_two_processes_train_and_evaluate_as_one(place, fsdp, tolerance):
    for run in start_two(place, f"two{fsdp}", "--fsdp", str(fsdp)):
        place.finish(run)
    place.check_same_end(f"two{fsdp}", tolerance)


def test_signals_stop_a_process_that_has_joined_a_cluster():
    """JAX takes SIGTERM for itself, so leapjax restores its own handler."""
    program = f"""
import os, signal, time
from leapjax.running import jax_setup
from leapjax.running.interruption import Interrupted, catch_signals
with catch_signals():
    jax_setup.connect(jax_setup.Cluster({find_free_address()!r}, 1, 0))
    try:
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(1)
    except Interrupted as stopped:
        print(stopped)
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, cwd=ROOT, check=True
    )
    assert done.stdout == "SIGTERM\n", done.stderr


@only_long
def test_a_signal_to_one_process_stops_both_resumably(place):
    runs = start_two(place, "one stopped")
    place.wait_for_checkpoint(runs[0], "one stopped")
    runs[1].send_signal(signal.SIGTERM)
    errors = [run.communicate(timeout=100)[1] for run in runs]
    assert [run.returncode for run in runs] == [0, 0], errors
    assert all("stopped by SIGTERM; continue with" in error for error in errors)
    # One process can resume a checkpoint of two.
    place.finish(place.start("one stopped"))
    place.check_same_end("one stopped")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"coordinator": "a:1"}, "are given together"),
        ({"coordinator": "a:1", "process_id": 2, "num_processes": 2}, "expected 0 to 1"),
        ({"coordinator": "a", "process_id": 0, "num_processes": 2}, "expected host:port"),
    ],
)
def test_invalid_clusters_raise_an_error(options, message):
    with pytest.raises(ValueError, match=message):
        Cluster(**options)


def test_episodes_of_processes_are_joined_in_order():
    seeds = np.arange(5)
    whole = Episodes(seeds, seeds % 2 == 0, seeds + 1, seeds / 2, 9, 90, 2.0, 3.0)
    parts = [
        Episodes(*(array[:2] for array in whole[:4]), 4, 40, 1.0, 3.0),
        Episodes(*(array[2:] for array in whole[:4]), 5, 50, 2.0, 2.5),
    ]
    for field, expected in zip(join(parts), whole, strict=True):
        np.testing.assert_array_equal(field, expected)
