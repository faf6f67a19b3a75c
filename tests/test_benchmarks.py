"""The benchmark counts what the program does, and runs."""

import json

import jax
import jax.numpy as jnp
import pytest

from benchmarks import planning
from leapjax.envs import vocabulary
from leapjax.models import trajectory
from leapjax.models.trajectory import ModelConfig, Sizes

HORIZON = 5


@pytest.mark.parametrize("name", ["paper", "leapjax"])
def test_needed_flops_are_what_xla_counts(name):
    model = planning.MODELS[name]
    sizes = Sizes(7, vocabulary.SIZE, planning.NUM_ACTIONS, 0, HORIZON, 64)
    module = trajectory.build(model, sizes)
    context = trajectory.blank_context(sizes, planning.WORDS)
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


def test_the_benchmark_writes_rows_and_a_plot(tmp_path, monkeypatch):
    tiny = ModelConfig("leapjax", layers=1, width=16, heads=2, channels=4, rounds=1, sweeps=2)
    monkeypatch.setattr(planning, "MODELS", {"leapjax": tiny})
    monkeypatch.setattr(planning, "SETTINGS", ((2, 3, 5),))
    monkeypatch.setattr(planning, "BATCHES", (1, 9))
    rows, plot = tmp_path / "rows.json", tmp_path / "plot.png"
    assert planning.main(["--json", str(rows), "--plot", str(plot), "--seconds", "0.01"]) == 0
    fields = (
        "horizon iterations batch preset compile_seconds plans_per_second gflops peak_gflops "
        "fraction_of_peak"
    ).split()
    written = json.loads(rows.read_text())
    assert [row["batch"] for row in written] == [1, 9]
    assert all(set(fields) <= row.keys() for row in written)
    assert all(row[field] > 0 for row in written for field in fields[4:])
    assert plot.stat().st_size > 1000
