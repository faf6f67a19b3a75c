"""Benchmarks count FLOPs, measure programs, and write rows."""

import functools
import json
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import pytest

from benchmarks import atari, methods, planning, quality, scaling, training
from benchmarks.flops import matmul_flops
from leapjax import pretrained, sharding
from leapjax.configuration import make_domain, specify
from leapjax.domain import blank_context
from leapjax.presets import find_preset
from leapjax.running.jax_setup import Cluster
from tests.programs import only_long, with_options

HORIZON = 5
SMALL = {"width": 16, "heads": 2, "layers": 1, "features": 2}  # the network for games


@pytest.fixture(autouse=True)
def restore_cache():
    """Restores the compilation cache, which benchmarks turn off for the whole process."""
    before = jax.config.jax_enable_compilation_cache
    yield
    jax.config.update("jax_enable_compilation_cache", before)


def find_tiny_preset(*names):
    """Returns a preset with a network and batches that compute quickly."""
    small = {"width": 16, "heads": 2, "layers": 1, "batch": 4}
    simple = {"channels": 4, "rounds": 1, "fields": 0, "augment": False, "clutter": 0.0}
    return with_options(find_preset(*names), {**small, **simple})


@pytest.mark.parametrize("name", ["paper", "leapjax"])
def test_flops_match_the_count_of_xla(name):
    config = find_preset("babyai", "GoToLocalS7N5", "leap", name)
    domain = make_domain(config)
    agent = pretrained.make_agent(specify(config, 0, domain), domain)
    energy = agent.energy
    params = jax.eval_shape(agent.init, jax.random.key(0)).params
    memory = jax.eval_shape(energy.encode, params, blank_context(domain, 0))
    arguments = params, memory, jnp.zeros(HORIZON, jnp.int32), jnp.arange(HORIZON)
    counted = jax.jit(energy.conditional).lower(*arguments).compile().cost_analysis()["flops"]
    needed = matmul_flops(energy.conditional, *arguments)
    # XLA also counts norms, softmax and activations.
    assert needed < counted < 1.15 * needed


def test_flops_include_loops_vmap_shards_and_convolutions():
    square, image = jnp.ones((4, 4)), jnp.ones((1, 3, 8, 8))

    def power(x):
        return jax.lax.fori_loop(0, 5, lambda _, y: jax.jit(jnp.dot)(y, x), x)

    assert matmul_flops(power, square) == 5 * 2 * 4**3
    assert matmul_flops(jax.vmap(power), jnp.ones((7, 4, 4))) == 7 * 5 * 2 * 4**3
    split = sharding.split_batches(lambda _, x, rows: rows @ x, sharding.make_mesh(8))
    assert matmul_flops(split, None, square, jnp.ones((8, 4))) == 2 * 8 * 4**2
    convolve = functools.partial(jax.lax.conv, window_strides=(1, 1), padding="VALID")
    assert matmul_flops(convolve, image, jnp.ones((2, 3, 3, 3))) == 2 * (2 * 6 * 6) * (3 * 3 * 3)


def test_planning_benchmark_writes_rows_and_a_plot(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(planning, "find_preset", find_tiny_preset)
    monkeypatch.setattr(planning, "COMPARED", ("leapjax",))
    monkeypatch.setattr(planning, "LEVELS", ("GoToLocalS7N5",))
    monkeypatch.setattr(planning, "make_energy", functools.cache(planning.make_energy))
    rows, plot = tmp_path / "rows.json", tmp_path / "plot.png"
    options = ["--json", str(rows), "--plot", str(plot), "--batches", "1", "2", "--chunks", "1"]
    assert planning.main([*options, "--seconds", "0.01", "--large", "2"]) == 0
    assert "2 plans of (5, 10)" in capsys.readouterr().out
    written = json.loads(rows.read_text())
    assert [(row["batch"], row["chunk"]) for row in written] == [(1, 1), (2, 1)]
    # A batch of 2 reuses the program compiled for a batch of 1.
    assert written[0]["compile_seconds"] > 0 == written[1]["compile_seconds"]
    measured = ("plans_per_second", "gflops", "peak_gflops", "fraction_of_peak")
    assert all(row[field] > 0 for row in written for field in measured)
    assert plot.stat().st_size > 1000


@only_long
def test_training_benchmark_measures_steps_and_their_parts(tmp_path, monkeypatch, quick_begin):
    monkeypatch.setattr(training, "find_preset", find_tiny_preset)
    monkeypatch.setattr(training, "matmul_peak", lambda *rest: 100.0)  # tested with planning
    rows = tmp_path / "rows.json"
    arguments = ["--levels", "GoToLocalS7N5", "--presets", "leapjax", "--seconds", "0.01"]
    assert training.main([*arguments, "--json", str(rows)]) == 0
    (row,) = json.loads(rows.read_text())
    assert row["training_seconds"] == pytest.approx(row["steps"] / row["steps_per_second"])
    assert len(row["parts"]) == 4 and all(part["ms"] > 0 for part in row["parts"])
    # Encoder and transformer compute all matrix products of a step, values and gradients.
    products = 1e9 * sum(part["gflop"] for part in row["parts"])
    assert 0.9 * products < row["flops_per_step"] < 1.1 * products


@only_long
def test_atari_benchmark_times_planning_encoding_and_playing(tmp_path, monkeypatch):
    monkeypatch.setattr(
        atari, "find_preset", lambda *names: with_options(find_preset(*names), SMALL)
    )
    rows = tmp_path / "rows.json"
    arguments = ["--presets", "leapjax", "--batches", "2", "--no-training", "--seconds", "0.01"]
    assert atari.main([*arguments, "--json", str(rows)]) == 0
    (row,) = json.loads(rows.read_text())
    assert all(row[f"{part}_seconds"] > 0 for part in ("planning", "encoding", "playing"))
    # The convolutions alone: 20 * 20, 9 * 9 and 7 * 7 positions, with 2, 4 and 4 features.
    products = 400 * 64 * 2 + 81 * 32 * 4 + 49 * 36 * 4
    assert row["encoding_flops"] > 2 * 2 * products


@pytest.mark.parametrize(
    ("program", "arguments", "message"),
    [
        (training, ["--json", "file/rows.json"], "cannot write to file"),
        (quality, ["GoToLocalS7N5", "--batch", "0"], "--batch 0"),
        (planning, ["--batches", "4", "0"], "--batches 4 0: expected positive numbers"),
        (planning, ["--plot", "plot.foo"], "a figure can be"),
        (atari, ["--no-training", "--training-json", "rows.json"], "--no-training"),
        (scaling, ["--level", "GoToLocal"], "unknown level"),
    ],
)
def test_invalid_options_stop_benchmarks_before_they_measure(
    program, arguments, message, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    monkeypatch.setattr(program, "measure", lambda *given: pytest.fail("measured"))
    assert program.main(arguments) == 2
    assert message in capsys.readouterr().err


def test_scaling_benchmark_measures_steps_and_gradient_exchange(monkeypatch):
    made = []

    class Stepper:
        """Training steps without computation."""

        def __init__(self, config, mesh):
            made.append((config.training.batch, dict(mesh.shape)))
            self.state = SimpleNamespace(params={"large": jnp.ones((64, 64)), "small": jnp.ones(3)})

        def __call__(self):
            return jnp.zeros(())

    monkeypatch.setattr(scaling, "Stepper", Stepper)
    row = scaling.measure(scaling.Options(per_device=3, seconds=0.01, cluster=Cluster(fsdp=4)))
    assert made == [(24, {"data": 2, "fsdp": 4})]
    assert (row["processes"], row["devices"], row["fsdp"]) == (1, 8, 4)
    assert row["examples_per_second"] == pytest.approx(24 / row["seconds_per_step"])
    assert row["exchange_seconds"] > 0 and row["parameters"] == 64 * 64 + 3


def test_benchmarks_write_a_row_per_method_and_per_setting(tmp_path, monkeypatch):
    def launch(arguments, count, devices, fsdp):
        measured = {"seconds_per_step": 0.1, "examples_per_second": 10.0, "exchange_seconds": 0.01}
        return {"processes": count, "devices": count * devices, "fsdp": fsdp, **measured}

    def run_benchmark(program, *options):
        assert program.main([*options, "--json", str(tmp_path / "rows.json")]) == 0
        return json.loads((tmp_path / "rows.json").read_text())

    calls = []
    monkeypatch.setattr(methods, "make_call", lambda *given: lambda: calls.append(given))
    options = "--batch 2 --rounds 2 --seconds 0 --level PickUpLoc".split()
    assert [row["method"] for row in run_benchmark(methods, *options)] == list(methods.METHODS)
    assert calls == [("PickUpLoc", method, 2) for method in methods.METHODS] * 2  # interleaved
    monkeypatch.setattr(scaling, "launch", launch)
    settings = [(row["processes"], row["devices"], row["fsdp"]) for row in run_benchmark(scaling)]
    assert settings == [(count, count * each, fsdp) for count, each, fsdp in scaling.SETTINGS]
