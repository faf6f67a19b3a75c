"""The steps of one run: demonstrations, training, evaluation, pictures.

All experiments share them, whatever the domain and the method. With several processes all of
them go through all steps; the first one writes.
"""

import concurrent.futures
import contextlib
import csv
import dataclasses
import json
import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh
from rich.console import Console

from experiments.common import loggers, memory, plots
from experiments.common.config import PLANS_TOGETHER, AnyConfig, resolved
from experiments.common.interruption import Interruption
from experiments.common.loggers import About, Log
from experiments.common.progress import Meter
from leapjax import files, pretrained, processes, rollouts, sharding, training
from leapjax.agents import learning
from leapjax.batching import CompiledPlanner, compile_planner
from leapjax.checkpoints import Checkpoints, read_json
from leapjax.data import storage, windows
from leapjax.data.storage import reasons
from leapjax.domain import Domain, Source, apply_statistics
from leapjax.energy import compose
from leapjax.environments import judge_episode
from leapjax.errors import UserError, first_line
from leapjax.methods import find_method
from leapjax.pretrained import Pretrained, Specification
from leapjax.rollouts import Episodes
from leapjax.training import TrainStep
from leapjax.types import Agent, Demonstration, Energy, Params, TrainState

Metrics = list[dict[str, float]]
Watch = Callable[[Energy, Params], dict[str, float]]
CHUNK_SIZES = (PLANS_TOGETHER,)
REPORT_SECONDS = 5.0  # where steps are slow: between them nothing is saved, and no signal heard
DATA = "data.json"  # in the folder of a run: the demonstrations that it learns from


def chunk_sizes(config: AnyConfig) -> tuple[int, ...]:
    """Of planning: as large as there are episodes, up to the usual."""
    return tuple(min(size, 1 << (config.episodes - 1).bit_length()) for size in CHUNK_SIZES)


@dataclasses.dataclass(frozen=True)
class Run:
    """What every step of a run needs."""

    config: AnyConfig
    domain: Domain
    specification: Specification
    folder: Path
    console: Console
    interruption: Interruption
    log: Log = loggers.nowhere
    # Where the time went, filled in by each step.
    seconds: dict[str, float] = dataclasses.field(
        default_factory=lambda: {"demos": 0.0, "compile": 0.0, "train": 0.0, "eval": 0.0}
    )

    @property
    def seed(self) -> int:
        """The training seed."""
        return self.specification.origin.seed


def with_loggers(run: Run, name: str, stack: contextlib.ExitStack) -> Run:
    """A run whose measurements go to the loggers that are asked for, until a stack is closed."""

    def about() -> About:
        files.check_writable(run.folder)
        run.folder.mkdir(parents=True, exist_ok=True)
        before = read_metrics(run.folder)
        done = int(before[-1]["step"]) if before else 0
        return About(run.folder, name, resolved(run.config, run.seed), done)

    log = stack.enter_context(loggers.opened(run.config.loggers, about))
    return dataclasses.replace(run, log=log)


class Programs(NamedTuple):
    """What is compiled for a run."""

    agent: Agent
    begin: Callable[[int], tuple[TrainState, jax.Array]]
    step: TrainStep
    plan: CompiledPlanner


def compile_ahead(run: Run, mesh: Mesh, plays: bool = True) -> Callable[[], Programs]:
    """Begins to compile, in the background; what is returned waits for the end of it.

    Args:
        run: to compile for.
        mesh: to train on.
        plays: whether the planner will be needed; if not, it compiles at its first use.
    """
    config, domain = run.config, run.domain
    plays = plays and not config.rules  # with rules another planner plays: see `with_rules`
    agent = pretrained.make_agent(run.specification, domain, mesh)
    plan = compile_planner(
        agent.energy, config.planner, chunk_sizes(config), encode_next=agent.encode_next
    )
    like = learning.blank_steps(domain) if config.demos else ()
    state = jax.eval_shape(agent.init, jax.random.key(0))
    memory.check_state(state)

    def training_programs() -> tuple[Any, TrainStep]:
        if config.training.steps:
            begin, step = training.compile_ahead(agent, mesh, like)
            memory.check_program(step.update)
            return begin, step
        return training.make_begin(agent, mesh), training.make_train_step(agent, mesh)

    def warm_planner() -> None:
        params = jax.tree.map(lambda x: jax.numpy.zeros(x.shape, x.dtype), state.params)
        blank = Pretrained(run.specification, agent.energy, params, plan)
        warm_up(blank, domain, config.episodes, config.executed)

    pool = concurrent.futures.ThreadPoolExecutor(2)
    compiled = pool.submit(training_programs)
    warm = pool.submit(warm_planner) if plays else None
    pool.shutdown(wait=False)

    def wait() -> Programs:
        begun = time.perf_counter()
        begin, step = compiled.result()
        if warm is not None:
            warm.result()
        run.seconds["compile"] += time.perf_counter() - begun
        return Programs(agent, begin, step, plan)

    return wait


def source_of(run: Run) -> Source:
    """Where the demonstrations come from that the domain makes."""
    return run.domain.source or storage.source(run.domain, run.config.demos, run.seed)


def dataset(run: Run) -> str:
    """The id of the demonstrations to train on, or where they are."""
    return run.config.demonstrations or source_of(run).default


def must_collect(run: Run) -> bool:
    """Whether the demonstrations to train on do not exist yet."""
    wanted = run.config.demos and run.config.demonstrations is None
    return bool(wanted) and processes.first_does(lambda: not source_of(run).exists(dataset(run)))


def collect(run: Run) -> None:
    """Makes the demonstrations to train on."""

    def make() -> None:
        source = source_of(run)
        with Meter(run.console, source.unit, source.amount) as meter:
            summary = source.make(dataset(run), meter.update)
        run.console.print(summary)

    begun = time.perf_counter()
    processes.first_does(make)
    run.seconds["demos"] += time.perf_counter() - begun


def load(run: Run) -> list[Demonstration]:
    """The demonstrations to train on: the user's, or those that were collected.

    Raises:
        UserError: they cannot be read, are fewer than asked for, or hold no rewards where the
            method learns from them.
    """
    config, name = run.config, dataset(run)
    if not config.demos:
        return []
    begun = time.perf_counter()
    # Each process reads for itself: the data need not be on one shared disk.
    loaded = processes.together(lambda: source_of(run).load(name, run.seed))
    data, dropped = loaded.demonstrations[: config.demos], reasons(loaded)
    run.seconds["demos"] += time.perf_counter() - begun
    if dropped:
        run.console.print(f"{len(data)} episodes of {name}; dropped: {dropped}", highlight=False)
    asked = find_method(config.method).rewards or getattr(config.method_settings, "returns", False)
    if asked and not any(d.rewards.any() for d in data):
        raise UserError(
            f"{name} holds no rewards, from which --method {config.method} learns: give it data "
            "with rewards, or another method"
        )
    return data


def measured(run: Run, data: Sequence[Demonstration]) -> Run:
    """A run whose network knows the statistics of what it learns from, if it needs any."""
    statistics = run.domain.measure(data)
    return dataclasses.replace(
        run,
        domain=apply_statistics(run.domain, statistics),
        specification=dataclasses.replace(run.specification, statistics=statistics),
    )


def fit(
    run: Run,
    data: Sequence[Demonstration],
    mesh: Mesh,
    programs: Callable[[], Programs],
    watch: Watch | None = None,
) -> tuple[Pretrained, Metrics]:
    """Trains, or continues; what was learned and how it went.

    Args:
        run: to do.
        data: to train on.
        mesh: to train on.
        programs: makes them, or waits for them.
        watch: measures more of what is being learned, whenever its progress is reported.
    """
    config, folder, console, total = run.config, run.folder, run.console, run.config.training.steps
    # Of Atari, as large as all frames: one copy on the host, until devices have theirs.
    steps: Any = windows.concatenate(data, run.domain.extras, padded=True) if data else ()
    named = windows.fingerprint(windows.unpadded(steps) if data else ())
    check_data(folder, named, [each.seed for each in data], judge_data(data, run.domain))
    agent, begin, step, plan = programs()
    state, key = begin(run.seed)
    steps = sharding.replicate(steps, mesh)
    compiling = time.perf_counter()
    if total:  # the one program that depends on how many demonstrations there are
        jax.block_until_ready(step.draw(key, state.step, steps))
    run.seconds["compile"] += time.perf_counter() - compiling
    size = sum(leaf.nbytes for leaf in jax.tree.leaves(state) if hasattr(leaf, "nbytes"))
    processes.first_does(lambda: files.check_room(folder, 3 * size))  # two and the next
    saved = Checkpoints(folder / pretrained.CHECKPOINTS, pretrained.identity(run.specification))
    restored = saved.restore(state, skipped=lambda line: print(line, file=sys.stderr))
    # Not before: what does not fit the run that is there leaves it as it is.
    processes.first_does(lambda: pretrained.save_specification(folder, run.specification))
    metrics: Metrics = []
    if restored is not None:
        state = restored
        metrics = [m for m in read_metrics(folder) if m["step"] <= int(state.step)]
        console.print(f"continuing at step {int(state.step)} of {total}")
    if not total and restored is None:
        saved.save(state)  # there is nothing to learn: what a method begins with is all of it

    before = metrics[-1]["seconds"] if metrics else 0.0
    begun = last_saved = time.perf_counter()
    with (
        run.interruption.deferred(),
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
            # Processes have their own clocks and signals, and must agree on what to do.
            signals, dues = zip(*processes.gather([run.interruption.requested, due]), strict=True)
            for number in filter(None, signals):
                run.interruption.adopt(number)
            if done == total or any(signals) or any(dues):
                processes.first_does(lambda: write_metrics(folder, metrics))
                saved.save(now)
                last_saved = time.perf_counter()
            return any(signals)

        often = REPORT_SECONDS if jax.process_count() == 1 else math.inf
        state = training.train(step, state, steps, key, total, report, report_seconds=often)
    run.seconds["train"] = metrics[-1]["seconds"] if metrics else 0.0
    # Planning is each process's own business, on its own devices.
    params = jax.tree.map(jax.numpy.asarray, sharding.to_host(state.params))
    return Pretrained(run.specification, agent.energy, params, plan), metrics


def training_mesh(config: AnyConfig) -> Mesh:
    """The devices that a run trains on, those of all processes included.

    Raises:
        UserError: they cannot share the batch.
    """
    try:
        examples = config.training.batch // config.training.run
        return sharding.make_mesh(examples, jax.devices(), config.cluster.fsdp)
    except ValueError as error:
        raise UserError(f"--batch, --fsdp: {error}") from None


def judge_data(data: Sequence[Demonstration], domain: Domain) -> dict[str, Any] | None:
    """How well demonstrations do, by the criterion that played episodes are judged by.

    None where the environment has a measure of its own, which demonstrations do not keep.
    """
    criterion = domain.criterion
    if criterion is None or not data:
        return None
    totals = [float(np.sum(d.rewards, dtype=np.float64)) for d in data]
    successes = [
        judge_episode(criterion, total, float(d.rewards[-1]), d.terminated, d.truncated)
        for total, d in zip(totals, data, strict=True)
    ]
    return {"success": float(np.mean(successes)), "return": float(np.mean(totals))}


def read_outcome(folder: Path) -> tuple[float, float] | None:
    """Success rate and mean return of the data that a run learned from, where it noted them."""
    found = noted_of(folder).get("outcome") if (folder / DATA).exists() else None
    values = [found.get(name) for name in ("success", "return")] if isinstance(found, dict) else []
    numbers = [float(each) for each in values if isinstance(each, float) and math.isfinite(each)]
    return (numbers[0], numbers[1]) if len(numbers) == 2 else None


def check_data(
    folder: Path,
    fingerprint: str,
    level_seeds: Sequence[int],
    outcome: Mapping[str, Any] | None = None,
) -> None:
    """Refuses to train, or to continue a run, on demonstrations that are not the same ones.

    Notes what they are, their level seeds for `demonstrated`, and their outcome for
    `read_outcome`.

    Raises:
        UserError: the run was begun on others, or processes have read different ones.
    """
    if len(set(processes.gather(fingerprint))) > 1:
        raise UserError(
            "the processes have different demonstrations: copy one data set to all machines, or "
            "put MINARI_DATASETS_PATH on a shared disk"
        )

    def check() -> None:
        if not (folder / DATA).exists():
            noted: dict[str, Any] = {"fingerprint": fingerprint, "seeds": list(level_seeds)}
            noted |= {} if outcome is None else {"outcome": outcome}
            return files.write_text(folder / DATA, json.dumps(noted))
        before = noted_of(folder).get("fingerprint")
        if before != fingerprint:
            raise UserError(
                f"{folder} was begun on other demonstrations ({before}, now {fingerprint}): "
                "remove it to begin again, or give this run another --runs folder"
            )
        return None

    processes.first_does(check)


def demonstrated(folder: Path) -> list[int]:
    """Level seeds of the demonstrations that a run learned from, where its folder says so."""
    found = noted_of(folder).get("seeds") if (folder / DATA).exists() else None
    return [seed for seed in found if isinstance(seed, int)] if isinstance(found, list) else []


def noted_of(folder: Path) -> dict[str, Any]:
    """What `check_data` has noted of a run's demonstrations; nothing, where it is no object."""
    values = read_json(folder / DATA)
    return values if isinstance(values, dict) else {}


def reuse(run: Run, checkpoint: Path) -> Pretrained:
    """The planner of an earlier run, refused where something else is asked for.

    Raises:
        UserError: says what the run has, and what it was asked for; or a row is to be recorded of a
            run that has not come to its end.
    """
    trained = pretrained.read_specification(checkpoint)
    wanted, found = (_training_settings(s) for s in (run.specification, trained))
    for name in wanted:
        if wanted[name] != found.get(name):
            label = name.rsplit(".", 1)[-1]
            raise UserError(
                f"the checkpoint {checkpoint} does not fit: {label} is {found.get(name)}, "
                f"not {wanted[name]}"
            )
    target, known = (
        getattr(s.method_settings, "target_return", None) for s in (run.specification, trained)
    )
    return pretrained.load(
        checkpoint, run.config.planner, chunk_sizes(run.config), run.config.play,
        None if target == known else target, finished=run.config.record,
    )  # fmt: skip


def _training_settings(specification: Specification) -> dict[str, Any]:
    """What a trained planner cannot be asked to change: all but how it searches, and for what."""

    def flat(values: dict[str, Any], prefix: str) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for name, value in values.items():
            nested = isinstance(value, dict)
            found |= flat(value, f"{prefix}{name}.") if nested else {f"{prefix}{name}": value}
        return found

    settings = flat(dataclasses.asdict(specification), "")
    asked = {"method_settings.target_return", "statistics"} | {
        name for name in settings if name.startswith(("planner.", "signature."))
    }
    return {
        name: value
        for name, value in settings.items()
        if name not in asked or name == "planner.horizon"
    }


def with_rules(planner: Pretrained, run: Run) -> Pretrained:
    """A planner that minimises the domain's rules too, where that is asked for."""
    weight, rules = run.config.rules, run.domain.rules
    if not weight or rules is None:
        return planner
    energy = compose([planner.energy, rules], [1.0, weight])
    plan = compile_planner(energy, run.config.planner, chunk_sizes(run.config))
    return Pretrained(planner.specification, energy, (planner.params, ()), plan)


def measure(planner: Pretrained, run: Run, episode_seeds: range) -> Episodes:
    """Plays the held-out episodes, each process its share; compilation is counted apart."""
    play = player(planner, run)
    index, count = jax.process_index(), jax.process_count()
    # Contiguous shares, so that the parts make the whole again, in order.
    bounds = [len(episode_seeds) * n // count for n in range(count + 1)]
    mine = episode_seeds[bounds[index] : bounds[index + 1]]
    begun = time.perf_counter()
    warm_up(planner, run.domain, len(mine), run.config.executed)
    run.seconds["compile"] += time.perf_counter() - begun
    with Meter(run.console, "evaluation", len(mine)) as meter:

        def progress(over: int, good: int) -> None:
            run.interruption.check()
            meter.update(over, f"success {good}/{over}")

        part = processes.together(lambda: play(mine, progress=progress))
    arrays = [x.tolist() for x in part[:4]]
    parts = [
        Episodes(*(np.array(x) for x in lists), *counts)  # type: ignore[arg-type]
        for lists, counts in processes.gather([arrays, part[4:]])
    ]
    episodes = rollouts.join(parts)
    run.seconds["eval"] = episodes.seconds
    return episodes


def player(planner: Pretrained, run: Run) -> Callable[..., Episodes]:
    """`rollouts.evaluate` with all that a run fixes."""

    def play(episode_seeds: Sequence[int], **options: Any) -> Episodes:
        return rollouts.evaluate(
            run.domain.make_adapter, episode_seeds, planner.plan, planner.params,
            context=run.config.context, seed=run.seed, executed=run.config.executed, **options,
        )  # fmt: skip

    return play


def warm_up(planner: Pretrained, domain: Domain, batch: int, executed: int | None) -> None:
    """Compiles every chunk size that a batch of that many and fewer plans can need.

    Args:
        planner: that will plan.
        domain: of its contexts.
        batch: episodes that are played together, at most.
        executed: actions of each plan; None for all.
    """
    blank = rollouts.History(domain.blank, planner.specification.context, domain.num_actions)
    for size in planner.plan.sizes_up_to(batch):
        keys, caches = jax.random.split(jax.random.key(0), size), [None] * size
        for _ in range(2):  # the first plans of episodes, and the next
            _, caches = rollouts.plan_episodes(
                planner.plan, planner.params, keys, [blank] * size, caches, executed
            )


def draw(planner: Pretrained, run: Run, episode_seeds: range | None, metrics: Metrics) -> None:
    """The training curve; and success against iterations, where there are episodes to play."""
    config, folder = run.config, run.folder
    folder.mkdir(parents=True, exist_ok=True)
    if metrics:
        plots.training_curve(metrics, folder / "loss.png")
    if episode_seeds is None:
        return
    play = player(planner, run)
    some = episode_seeds[:100]
    iterations = sorted({1, 2, 3, 5, *np.linspace(1, config.planner.iterations, 5).astype(int)})
    iterations = [int(n) for n in iterations if n <= config.planner.iterations]
    outcomes = [play(some, iteration=n) for n in iterations]
    plots.success_by_iteration(
        iterations, [(int(o.successes.sum()), len(some)) for o in outcomes],
        f"{config.level}, {config.method}, preset {config.preset}", folder / "iterations.png",
    )  # fmt: skip


def write_metrics(folder: Path, metrics: Metrics) -> None:
    """The training curve as CSV."""
    lines = [",".join(metrics[0])]
    lines += [",".join(repr(value) for value in entry.values()) for entry in metrics]
    files.write_text(folder / "metrics.csv", "\n".join(lines) + "\n")


def read_metrics(folder: Path) -> Metrics:
    """The training curve so far.

    Raises:
        UserError: the file is damaged.
    """
    path = folder / "metrics.csv"
    if not path.exists():
        return []
    lines = files.read_text(path).splitlines()
    try:
        metrics = [{k: float(v) for k, v in entry.items()} for entry in csv.DictReader(lines)]
        if any(not entry.keys() >= {"step", "seconds", "loss"} for entry in metrics):
            raise ValueError("a column is missing")
        if not all(math.isfinite(e["step"]) and math.isfinite(e["seconds"]) for e in metrics):
            raise ValueError("a step or a time is not a number")
    except (TypeError, ValueError, csv.Error) as error:
        raise UserError(
            f"{path} is damaged ({first_line(error)}): remove it, and the run goes on with a "
            "training curve that begins here"
        ) from None
    return metrics
