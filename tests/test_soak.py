"""Long work in one process: memory, compilation and open files stay what they were."""

import gc
import os
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from experiments import babyai, results
from experiments.common.config import Config
from leapjax import batching, planners, pretrained, rollouts, sharding, training
from leapjax.agents import leap
from leapjax.checkpoints import Checkpoints
from leapjax.data import windows
from leapjax.babyai import levels
from leapjax.babyai.adapter import BabyAIAdapter
from tests.programs import LONG, only_long
from tests.test_training import MODEL, TRAINING

CYCLES, RUNS = 300 if LONG else 8, 20
LEVEL = levels.find_level("GoToLocalS7N5")


def open_files():
    return len(list(Path("/proc/self/fd").iterdir()))


def resident_mebibytes():
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


class Watch:
    """What a process holds, again and again; what it compiled in between."""

    def __init__(self):
        self.files, self.memory, self.compiled = [], [], []
        self._compilations = 0
        jax.monitoring.register_event_duration_secs_listener(self._listen)

    def _listen(self, name, seconds, **_):
        self._compilations += name == "/jax/core/compile/backend_compile_duration"

    def look(self):
        self.files.append(open_files())
        self.memory.append(resident_mebibytes())
        self.compiled.append(self._compilations)
        self._compilations = 0

    def report(self):
        warm = self.memory[len(self.memory) // 5]
        return (
            f"{len(self.files)} rounds: {warm:.0f} MiB after a fifth, {self.memory[-1]:.0f} at the "
            f"end; {self.files[1]} open files in round 2, {self.files[-1]} at the end; "
            f"{self.compiled[0]} compilations in round 1, {sum(self.compiled[1:])} later"
        )


def test_train_plan_evaluate_over_and_over(local_demonstrations, tmp_path, capsys):
    config = Config(training=TRAINING, model=MODEL, planner=planners.GibbsConfig(4, 4))
    sizes = pretrained.sizes_for(LEVEL, config.context, config.planner.horizon)
    mesh = sharding.make_mesh(TRAINING.batch)
    agent = leap.make_agent(MODEL, TRAINING, config.planner, sizes, LEVEL.words, mesh)
    begin = training.make_begin(agent, mesh)
    step = training.make_train_step(agent, lambda k, d: leap.make_batch(k, d, TRAINING, sizes))
    plan = batching.compile_planner(agent.energy, config.planner)
    data = sharding.replicate(windows.concatenate(local_demonstrations), mesh)
    watch = Watch()
    for cycle in range(CYCLES):
        state, key = begin(cycle)
        saved = Checkpoints(tmp_path / f"{cycle % 3}" / f"{cycle}")
        state = training.train(step, state, data, key, 10, lambda done, now, means: None)
        saved.save(state)
        restored = saved.restore(state)
        saved.close()
        params = jax.tree.map(jnp.asarray, sharding.to_host(restored.params))
        episodes = rollouts.evaluate(
            lambda: BabyAIAdapter(LEVEL), [100 * cycle + i for i in range(3)], plan, params,
            context=0, seed=cycle, progress=lambda over, good: None,
        )  # fmt: skip
        assert len(episodes.successes) == 3
        row = {
            **{name: "x" if kind is str else 1 for name, kind in results.FIELDS.items()},
            "hash": str(cycle % 7), "successes": int(episodes.successes.sum()), "episodes": 3,
        }  # fmt: skip
        results.record(tmp_path / "rows.jsonl", row)
        watch.look()
    with capsys.disabled():
        print("\nsoak, library:", watch.report())
    # Episodes leave a batch one by one, so a chunk of another size may still be compiled; what
    # that takes is no leak, so memory counts from where nothing is compiled any more.
    settled = CYCLES // 4
    assert sum(watch.compiled[settled:]) == 0
    assert max(watch.files[1:]) <= watch.files[1] + 2
    # Orbax keeps some 0.2 MiB of every manager that has saved and restored; ours is nothing.
    assert watch.memory[-1] < watch.memory[settled] + 10 + 0.3 * (CYCLES - settled)
    assert len(results.read(tmp_path / "rows.jsonl")) == min(CYCLES, 7)


@only_long
def test_one_run_after_another(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("LEAPJAX_COMPILATION_CACHE", "off")
    toy = (
        "--demos 6 --episodes 5 --steps 4 --batch 4 --width 16 --heads 2 --layers 1 --channels 4 "
        "--rounds 1 --fields 2 --sweeps 2 --iterations 3 --no-pictures --seeds"
    ).split()
    watch = Watch()
    for seed in range(RUNS):
        assert babyai.main([*toy, str(seed)]) == 0
        watch.look()
    with capsys.disabled():
        print("\nsoak, program:", watch.report())
    # Every run is a program of its own and compiles it; what it leaves behind is bounded.
    assert max(watch.files[1:]) <= watch.files[1] + 2
    assert np.ptp(watch.compiled[1:]) <= 2
    assert watch.memory[-1] < watch.memory[RUNS // 5] + 40 * (RUNS - RUNS // 5)
