"""Trains the network of a run, or resumes its training."""

import contextlib
import dataclasses
import math
import sys
import time
from collections.abc import Callable, Sequence

import jax

from leapjax import files, pretrained, processes, sharding, training
from leapjax.agents.batches import join_demonstrations
from leapjax.agents.measured import MEASURED, measure_settings
from leapjax.agents.value_range import judge_values
from leapjax.checkpoints import Checkpoints
from leapjax.data import windows
from leapjax.domain import apply_statistics, measure_statistics
from leapjax.pretrained import Pretrained
from leapjax.running.data import check_data, judge_data
from leapjax.running.metrics import resume_metrics, write_metrics
from leapjax.running.programs import make_mesh
from leapjax.running.progress import Meter
from leapjax.running.run import Run
from leapjax.types import Demonstration, Energy, Params, TrainState

Watch = Callable[[Energy, Params], dict[str, float]]
REPORT_SECONDS = 5.0  # at most between reports, which save checkpoints and handle signals


def train(run: Run, data: Sequence[Demonstration], watch: Watch | None = None) -> Pretrained:
    """Trains the network of a run, or resumes its training; writes the training curve.

    Args:
        run: run to train; its folder is locked until the run is closed.
        data: demonstrations to train on.
        watch: (energy, parameters) -> further measurements for each report of progress.

    Raises:
        UserError: the folder belongs to another run or to other data, or another process works in
            it.
        Interrupted: the run was asked to stop; its newest state is saved.
    """
    run = learn_from_data(run, data)
    processes.run_on_first(lambda: run.opened.enter_context(files.lock_folder(run.folder)))
    config, folder, console, total = run.config, run.folder, run.console, run.config.training.steps
    # In Atari these are all frames: the host keeps one copy until the devices have theirs.
    parts = join_demonstrations(run.domain, data)
    named = windows.fingerprint([windows.unpadded(part) for part in parts])
    check_data(folder, named, [each.seed for each in data], judge_data(data, run.domain))
    agent, begin, step, plan = run.programs.take(run)
    state, key = begin(run.seed)
    parts = sharding.replicate(parts, make_mesh(config))
    compiling = time.perf_counter()
    if total:  # the only program that depends on the number of demonstrations
        for part in parts:
            jax.block_until_ready(step.draw(key, state.step, part))
    run.seconds["compile"] += time.perf_counter() - compiling
    size = sum(leaf.nbytes for leaf in jax.tree.leaves(state) if hasattr(leaf, "nbytes"))
    # Room for two checkpoints and the next.
    processes.run_on_first(lambda: files.check_room(folder, 3 * size))
    saved = Checkpoints(
        folder / pretrained.CHECKPOINTS, pretrained.describe_identity(run.specification)
    )
    restored = saved.restore(state, skipped=lambda line: print(line, file=sys.stderr))
    # Only now: a run that does not fit the checkpoints in the folder must not change it.
    processes.run_on_first(lambda: pretrained.save_specification(folder, run.specification))
    state = state if restored is None else restored
    metrics = processes.run_on_first(lambda: resume_metrics(folder, int(state.step)))
    if restored is not None:
        console.print(f"continuing at step {int(state.step)} of {total}")
    if not total and restored is None:
        saved.save(state)  # the method does not learn: its first state is its last

    before = metrics[-1]["seconds"] if metrics else 0.0
    begun = last_saved = time.perf_counter()
    with (
        run.interruption.defer_signals(),
        contextlib.closing(saved),
        Meter(console, "training", total, int(state.step)) as meter,
    ):

        def report(done: int, now: TrainState, means: dict[str, float]) -> bool:
            nonlocal last_saved
            elapsed = time.perf_counter() - begun
            seen = watch(agent.energy, now.params) if watch else {}
            metrics.append({"step": done, "seconds": before + elapsed, **means, **seen})
            run.log(done, {f"training/{name}": value for name, value in (means | seen).items()})
            meter.update(done, " ".join(f"{name} {mean:.3g}" for name, mean in means.items()))
            due = time.perf_counter() - last_saved > config.checkpoint_seconds
            # Each process has its own clock and signals; all must agree whether to save and stop.
            signals, dues = zip(*processes.gather([run.interruption.requested, due]), strict=True)
            for number in filter(None, signals):
                run.interruption.adopt(number)
            if done == total or any(signals) or any(dues):
                processes.run_on_first(lambda: write_metrics(folder, metrics))
                saved.save(now)
                last_saved = time.perf_counter()
            return any(signals)

        often = REPORT_SECONDS if jax.process_count() == 1 else math.inf
        choose = windows.take_turns(parts, config.training.windows)
        state = training.train(step, state, choose, key, total, report, report_seconds=often)
    settings = run.specification.method_settings
    if metrics and (warning := judge_values(settings, data, metrics[-1])):
        console.print(f"warning: {warning}", highlight=False)
    run.seconds["train"] = metrics[-1]["seconds"] if metrics else 0.0
    # Each process plans for itself, on its own devices.
    params = jax.tree.map(jax.numpy.asarray, sharding.to_host(state.params))
    return Pretrained(run.specification, agent.energy, params, plan, run.domain)


def learn_from_data(run: Run, data: Sequence[Demonstration]) -> Run:
    """Returns a run with the statistics and settings that it takes from its data."""
    statistics, given = measure_statistics(run.domain, data), run.specification.method_settings
    settings = measure_settings(given, data)
    for name in MEASURED:
        value = getattr(settings, name, None)
        if value != getattr(given, name, None):
            run.console.print(f"{name.replace('_', ' ')}: {value:g}, from the demonstrations")
    return dataclasses.replace(
        run,
        domain=apply_statistics(run.domain, statistics),
        specification=dataclasses.replace(
            run.specification, method_settings=settings, statistics=statistics
        ),
    )
