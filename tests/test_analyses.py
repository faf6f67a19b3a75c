"""The programs of the paper's analyses, end to end at toy size, and what they refuse."""

import functools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments import ablation, landscape, properties, report, stochastic, suboptimal
from experiments.common import cases
from experiments.common.cases import Analysis, Options
from experiments.tables import analyses
from leapjax.domains.babyai import constraints
from leapjax.domains.babyai.levels import find_level
from leapjax.presets import find_preset
from leapjax.running import results
from tests.programs import only_long, with_options

TOY = {  # nothing is learned: gradients take long to compile
    "demos": 6, "steps": 0, "batch": 4, "width": 16, "heads": 2, "layers": 1, "channels": 4,
    "rounds": 1, "fields": 0, "sweeps": 2, "horizon": 3, "iterations": 2,
}  # fmt: skip
ALL = (properties, stochastic, suboptimal, ablation)
SHORT = ["--episodes", "2"]


@pytest.fixture
def place(tmp_path, monkeypatch, quick_begin):
    """A folder to run in, with its own data sets."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def rows(place, name, folder="runs"):
    return results.read(place / folder / f"{name}.jsonl")


def toy(config, **options):
    """A configuration at toy size."""
    return with_options(config, {**TOY, **options})


one_action = functools.partial(toy, horizon=1)


def small(case, *ways):
    """An analysis of one case, at toy size, with some of its ways."""
    kept = [way for way in case.ways if way.name in ways]
    assert len(kept) == len(ways)
    return Analysis("properties", [case._replace(ways=kept)], change=toy)


def case_of(name):
    return next(case for case in properties.CASES if case.name == name)


def test_a_constraint_is_asked_for_and_counted(place, capsys):
    of = small(case_of("adaptation-medium"), "whole plan")
    assert cases.main(of, [*SHORT, "--record"]) == 0
    (row,) = rows(place, "properties", "results")
    assert (row["case"], row["way"], row["method"]) == ("adaptation-medium", "whole plan", "leap")
    assert row["violations"] == 0  # an untrained model, and no step onto lava all the same
    assert row["planner"]["fill"] == "sequential" and row["paper_success"] == 64.5
    assert 0 <= row["first_pass_successes"] <= row["episodes"] == 2
    assert cases.main(of, [*SHORT, "--record"]) == 0
    assert "recorded already" in capsys.readouterr().out
    assert rows(place, "properties", "results") == [row]


def test_two_models_are_composed(place):
    of = small(case_of("composition-medium"), "dt")
    assert cases.main(of._replace(change=one_action), SHORT) == 0
    (row,) = rows(place, "properties")
    assert row["level"] == "PickUpObjMazeS4" and len(set(row["trained"])) == 2
    assert row["train_seconds"] == 0  # for no step


@only_long
@pytest.mark.parametrize("program", ALL, ids=lambda program: program.ANALYSIS.name)
def test_every_way_of_every_program_runs(place, monkeypatch, program):
    """Of its first case; every method of its own."""
    of = program.ANALYSIS
    case = of.cases[0]
    for method in cases.list_methods(case):
        plans = {} if method in ("leap", "classifier") else {"horizon": 1}
        small_one = of._replace(cases=[case], change=functools.partial(toy, **plans))
        monkeypatch.setattr(program, "ANALYSIS", small_one)
        assert program.main(["--methods", method, *SHORT]) == 0
    assert {row["way"] for row in rows(place, of.name)} == {way.name for way in case.ways}


def test_every_case_can_be_made():
    """Its levels exist, and nothing of its settings is refused, with either preset."""
    for program in ALL:
        of = program.ANALYSIS
        names = [case.name for case in of.cases]
        assert len(set(names)) == len(names)
        for preset in ("leapjax", "paper"):
            wanted = cases.choose_cases(of, Options(preset=preset))
            assert [case.name for case in wanted] == names
        for case in of.cases:
            find_level(case.level)
            names = [way.name for way in case.ways]
            assert len(set(names)) == len(names)


def test_ways_and_methods_can_be_chosen():
    def chosen(**options):
        options = Options(only=("composition-easy", "adaptation-hard"), **options)
        found = cases.choose_cases(properties.ANALYSIS, options)
        return {case.name: [way.name for way in case.ways] for case in found if case.ways}

    assert chosen(ways=("sum", "whole plan")) == {
        "adaptation-hard": ["whole plan"], "composition-easy": ["sum"],
    }  # fmt: skip
    of_dt = ["dt", "dt, with more noise", "dt, exploring"]
    assert chosen(methods=("dt",)) == {"adaptation-hard": of_dt, "composition-easy": of_dt}


def test_rows_are_named_by_all_that_matters():
    case, of = case_of("adaptation-medium"), properties.ANALYSIS

    def name(seed=0, case=case, way=case.ways[1], **options):
        options = Options(**options)
        settings = [
            cases.make_training_config(of, m, way.method, seed, options) for m in case.models
        ]
        return cases.hash_row(of, case, way, settings, seed, options)

    def changed(**changes):
        return name(way=case.ways[1]._replace(**changes))

    others = [
        name(way=case.ways[0]), name(seed=1), name(episodes=100), name(preset="paper"),
        name(validation=True), changed(executed=1), changed(search=lambda given: given),
        changed(minimise=cases.alone), changed(remembers=True),
        changed(minimise=properties.penalise_unseen(constraints.lava, weight=1.0)),
        changed(minimise=properties.penalise_unseen(constraints.left_turns)),
        name(case=case._replace(adapter=None)),
    ]  # fmt: skip
    assert len({name(), *others}) == 13
    assert name(force=True, record=True) == name()
    same = properties.penalise_unseen(constraints.lava, weight=properties.WEIGHT)
    assert changed(minimise=same) == name()


def test_runs_with_the_augmentation_of_this_experiment_have_other_names():
    model = case_of("generalization-easy").models[0]

    def settings(method, preset="leapjax"):
        options = Options(preset=preset)
        config = cases.make_training_config(properties.ANALYSIS, model, method, 0, options)
        found = config.domain_settings
        folder = cases.find_run_folder(config, 0).name.partition("-")[0]
        return folder, *(getattr(found, name, None) for name in ("detours", "false_starts"))

    assert settings("leap") == ("augmented_babyai", 0.5, 0.6)
    assert settings("dt") == ("augmented_babyai", 0.5, 0.0)
    assert settings("iql") == settings("leap", "paper") == ("babyai", None, None)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--only", "adaptation-esy"], "did you mean adaptation-easy"),
        (["--methods", "bcq"], "expected some of dt, iql, leap"),
        (["--ways", "sums"], "--ways sums: expected some of dt, dt, exploring"),
        (["--ways", "sum", "--methods", "dt"], "none of these ways is of one of these methods"),
        (["--runs", "file/runs"], "cannot"),
    ],
)
def test_what_cannot_be_is_one_line(arguments, message, place, monkeypatch, capsys):
    monkeypatch.setattr(cases, "load_demonstrations", lambda run: pytest.fail("work was done"))
    (place / "file").write_text("")
    assert properties.main(arguments) == 2
    error = capsys.readouterr().err
    assert message in error and len(error.strip().splitlines()) == 1


def test_tables_hold_todays_rows_beside_the_papers_numbers():
    of = ablation.ANALYSIS
    case, way = of.cases[0], of.cases[0].ways[2]
    settings = [cases.make_training_config(of, m, "leap", 0, Options()) for m in case.models]
    row = {
        "experiment": "ablation", "case": case.name, "way": way.name, "method": "leap",
        "preset": "leapjax", "seed": 0, "episodes": 200, "successes": 150,
        "first_pass_successes": 100, "violations": None, "mean_length": 9.0, "plans": 10,
        "plans_per_second": 500.0, "first_episode_seed": 10_000_000,
        "train_seconds": 300.0, "compile_seconds": 20.0, "eval_seconds": 40.0,
        "versions": {"machine": "x86_64"},
        "hash": cases.hash_row(of, case, way, settings, 0, Options()),
    }  # fmt: skip
    stale = {**row, "successes": 0, "hash": "of another"}
    told = analyses.compare_ways(of, [row, stale], ways=[way.name], cases=["masked"])
    (line,) = (line for line in told.splitlines() if "Gibbs" in line)
    assert "| 62.5% | - | 75.0%" in line and "2.0 ms" in line
    assert "Gibbs" not in analyses.compare_ways(of, [row], cases=["classifier"])
    assert report.is_used(row) and not report.is_used(stale)


@only_long
def test_the_landscape_is_watched_while_it_forms(place, monkeypatch):
    def toy_preset(domain, level, method, name):
        return toy(find_preset(domain, level, method, name), steps=40)

    monkeypatch.setattr(landscape, "find_preset", toy_preset)
    arguments = ["--presets", "leapjax", "--trajectories", "8"]
    assert landscape.main(arguments) == 0
    path = place / "runs" / "landscape.json"
    (found,) = json.loads(path.read_text())
    assert [entry["step"] for entry in found["training"]] == [20, 40]
    assert len(found["planning"]["mean"]) == 10 and 0 < len(found["planning"]["single"]) <= 8
    assert (place / "runs" / "landscape.png").stat().st_size > 10_000
    for wrong in (["--trajectories", "0"], ["--record", "--steps", "3"]):
        assert landscape.main([*arguments, *wrong]) == 2
    landscape.keep_measurements(path, [{**found, "preset": "paper"}, found])
    assert [each["preset"] for each in json.loads(path.read_text())] == ["leapjax", "paper"]


def test_a_share_of_actions_is_replaced_by_any_but_the_end():
    actions = jnp.full(7000, 2)
    for share in (0.0, 0.25, 1.0):
        found = np.asarray(landscape.corrupt_actions(jax.random.key(1), actions, share, end=6))
        counts = np.bincount(found, minlength=7)
        assert counts[6] == 0
        assert counts[[0, 1, 3, 4, 5]] == pytest.approx(share * 7000 / 6, abs=120)  # 4 deviations
    assert (landscape.corrupt_actions(jax.random.key(1), actions, 0.0, end=6) == actions).all()
