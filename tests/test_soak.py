"""Long work in one process: memory, compilations and open files do not grow."""

import gc
import os
from pathlib import Path

import jax
import jax.numpy as jnp

from leapjax import batching, planners, rollouts, sharding, training
from leapjax.agents import leap
from leapjax.agents.base import Setup, TrainingConfig
from leapjax.checkpoints import Checkpoints
from leapjax.data import windows
from leapjax.domains.babyai.domain import BABYAI
from leapjax.domains.babyai.settings import Settings
from leapjax.models.config import ModelConfig
from leapjax.running import results
from tests.programs import only_long, toy_row

CYCLES = 300
DOMAIN = BABYAI.make("GoToLocalS7N5", Settings(channels=4, rounds=1, sweeps=2, fields=2))


class ResourceMonitor:
    """Samples the open files and memory of the process, and counts compilations in between."""

    def __init__(self):
        self.files, self.memory, self.compiled, self._count = [], [], [], 0
        jax.monitoring.register_event_duration_secs_listener(self._listen)

    def _listen(self, name, seconds, **_):
        self._count += name == "/jax/core/compile/backend_compile_duration"

    def sample(self):
        gc.collect()
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        self.files.append(len(list(Path("/proc/self/fd").iterdir())))
        self.memory.append(pages * os.sysconf("SC_PAGE_SIZE") / 2**20)
        self.compiled.append(self._count)
        self._count = 0


@only_long
def test_repeated_training_planning_and_evaluation_do_not_leak(tmp_path):
    model, learning = ModelConfig(layers=1, heads=2, width=16), TrainingConfig(steps=10, batch=4)
    mesh = sharding.make_mesh(learning.batch)
    agent = leap.make_agent(Setup(DOMAIN, 1, 4, model, learning, leap.Settings()), mesh)
    begin = training.make_begin(agent, mesh)
    step = training.make_train_step(agent, mesh)
    plan = batching.compile_planner(agent.energy, planners.GibbsConfig(4, 4))
    demonstrations = DOMAIN.demonstrations.collect(5, 0, lambda done: None).demonstrations
    data = sharding.replicate(
        windows.concatenate(demonstrations, DOMAIN.augmentations.extras), mesh
    )
    monitor = ResourceMonitor()
    for cycle in range(CYCLES):
        state, key = begin(cycle)
        checkpoints = Checkpoints(tmp_path / f"{cycle % 3}" / f"{cycle}")
        state = training.train(
            step, state, lambda done: data, key, 10, lambda done, now, means: None
        )
        checkpoints.save(state)
        restored = checkpoints.restore(state)
        checkpoints.close()
        params = jax.tree.map(jnp.asarray, sharding.to_host(restored.params))
        episodes = rollouts.evaluate(
            DOMAIN.make_adapter, [100 * cycle + i for i in range(3)], plan, params,
            context=1, seed=cycle, progress=lambda over, good: None,
        )  # fmt: skip
        assert len(episodes.successes) == 3
        results.record(tmp_path / "rows.jsonl", toy_row(hash=str(cycle % 7)))
        monitor.sample()
    # Episodes leave a batch one by one, so early cycles may still compile a chunk of another size.
    # Compiled programs are no leak, so memory counts only after compilation has ended.
    settled = CYCLES // 4
    assert sum(monitor.compiled[settled:]) == 0
    assert max(monitor.files[1:]) <= monitor.files[1] + 2
    # Orbax keeps some 0.2 MiB of every manager that saved and restored; leapjax keeps no memory.
    assert monitor.memory[-1] < monitor.memory[settled] + 10 + 0.3 * (CYCLES - settled)
    assert len(results.read(tmp_path / "rows.jsonl")) == min(CYCLES, 7)
