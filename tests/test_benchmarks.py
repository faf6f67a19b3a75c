"""The benchmark counts what the program does, and runs."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import pytest

from benchmarks import planning, scaling, training
from experiments.common.config import preset
from leapjax import pretrained
from leapjax.babyai import levels
from leapjax.models import trajectory

HORIZON = 5


def tiny_preset(level, name):
    """The settings of a preset, with a network and batches that take no time."""
    config = preset(level, name)
    small = {"width": 16, "heads": 2, "layers": 1, "channels": 4, "rounds": 1, "sweeps": 2}
    return dataclasses.replace(
        config,
        model=dataclasses.replace(config.model, **small),
        training=dataclasses.replace(config.training, batch=4),
    )


@pytest.mark.parametrize("name", ["paper", "leapjax"])
def test_needed_flops_are_what_xla_counts(name):
    level = levels.find_level("GoToLocalS7N5")
    model = preset(level, name).model
    sizes = pretrained.sizes_for(level, 0, HORIZON)
    module = trajectory.build(model, sizes)
    context = trajectory.blank_context(sizes, level.words)
    actions = jnp.zeros(HORIZON, jnp.int32)

    def everything(module, context):
        return module.logits(module.encode(context), actions, jnp.arange(HORIZON))

    params = jax.eval_shape(
        lambda key: module.init(key, context, method=everything), jax.random.key(0)
    )
    memory = jax.eval_shape(lambda p: module.apply(p, context, method="encode"), params)

    def one_pass(params, memory):
        return module.apply(params, memory, actions, jnp.arange(HORIZON), method="logits")

    counted = jax.jit(one_pass).lower(params, memory).compile().cost_analysis()["flops"]
    needed = planning.needed_flops(model, HORIZON, iterations=1)
    # XLA also counts norms, softmax and activations.
    assert needed < counted < 1.15 * needed


def test_the_benchmark_writes_rows_and_a_plot(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(planning, "preset", tiny_preset)
    monkeypatch.setattr(planning, "COMPARED", ("leapjax",))
    monkeypatch.setattr(planning, "LEVELS", ("GoToLocalS7N5",))
    monkeypatch.setattr(planning, "BATCHES", (1, 9))
    rows, plot = tmp_path / "rows.json", tmp_path / "plot.png"
    written = ["--json", str(rows), "--plot", str(plot)]
    assert planning.main([*written, "--seconds", "0.01", "--large", "20"]) == 0
    assert "20 plans of (5, 10)" in capsys.readouterr().out
    fields = (
        "horizon iterations batch preset compile_seconds plans_per_second gflops peak_gflops "
        "fraction_of_peak"
    ).split()
    written = json.loads(rows.read_text())
    assert [row["batch"] for row in written] == [1, 9]
    assert all(row["versions"]["leapjax"].startswith("0.") for row in written)
    assert all(set(fields) <= row.keys() for row in written)
    assert all(row[field] > 0 for row in written for field in fields[4:])
    assert plot.stat().st_size > 1000


def test_the_training_benchmark_measures_every_preset(tmp_path, monkeypatch):
    monkeypatch.setattr(training, "preset", tiny_preset)
    rows = tmp_path / "rows.json"
    arguments = ["--levels", "GoToLocalS7N5", "--presets", "leapjax", "--seconds", "0.01"]
    assert training.main([*arguments, "--json", str(rows)]) == 0
    (row,) = json.loads(rows.read_text())
    assert row["preset"] == "leapjax" and row["batch"] == row["devices"] == 4
    for field in ("steps_per_second", "flops_per_step", "fraction_of_peak", "training_seconds"):
        assert row[field] > 0
    assert row["training_seconds"] == pytest.approx(row["steps"] / row["steps_per_second"])
    assert row["encoder_share"] > 0


def test_the_training_benchmark_refuses_an_unknown_level(capsys):
    assert training.main(["--levels", "Nowhere"]) == 2
    assert "Nowhere" in capsys.readouterr().err


def test_the_scaling_benchmark_measures_its_settings(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(scaling, "SETTINGS", ((2, 1, 2),))
    rows = tmp_path / "rows.json"
    options = ["--per-device", "1", "--seconds", "0.01", "--json", str(rows)]
    assert scaling.main(options) == 0
    written = json.loads(rows.read_text())
    assert [(row["processes"], row["devices"], row["fsdp"]) for row in written] == [(2, 2, 2)]
    assert all(row["examples_per_second"] > 0 < row["exchange_seconds"] for row in written)
    assert scaling.main(["--level", "GoToLocal"]) == 2
    assert "unknown level" in capsys.readouterr().err
