"""Plays held-out episodes with a planner."""

import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from leapjax import processes, rollouts
from leapjax.pretrained import Pretrained
from leapjax.rollouts import Episodes
from leapjax.running.progress import Meter
from leapjax.running.run import Run


def evaluate(run: Run, planner: Pretrained) -> Episodes:
    """Plays the held-out episodes, a share in each process; times compilation separately."""
    episode_seeds = run.played
    play = make_player(run, planner)
    index, count = jax.process_index(), jax.process_count()
    # Contiguous shares, so that joining them restores the order.
    bounds = [len(episode_seeds) * n // count for n in range(count + 1)]
    mine = episode_seeds[bounds[index] : bounds[index + 1]]
    begun = time.perf_counter()
    planner.compile(len(mine), run.config.executed)
    run.seconds["compile"] += time.perf_counter() - begun
    with Meter(run.console, "evaluation", len(mine)) as meter:

        def progress(over: int, good: int) -> None:
            run.interruption.check()
            meter.update(over, f"success {good}/{over}")

        part = processes.run_together(lambda: play(mine, progress=progress))
    arrays = [x.tolist() for x in part[:4]]
    parts = [
        Episodes(*(np.array(x) for x in lists), *counts)  # type: ignore[arg-type]
        for lists, counts in processes.gather([arrays, part[4:]])
    ]
    episodes = rollouts.join(parts)
    run.seconds["eval"] = episodes.seconds
    return episodes


def make_player(run: Run, planner: Pretrained) -> Callable[..., Episodes]:
    """Returns `rollouts.evaluate` with the arguments that a run fixes."""

    def play(episode_seeds: Sequence[int], **options: Any) -> Episodes:
        return rollouts.evaluate(
            run.domain.make_adapter, episode_seeds, planner.plan, planner.params,
            context=run.config.context, seed=run.seed, executed=run.config.executed, **options,
        )  # fmt: skip

    return play
