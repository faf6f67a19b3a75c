"""The programs of the paper's analyses: end-to-end runs at toy size, and their errors."""

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

TOY = {  # without training steps, because gradients take long to compile
    "demos": 6, "steps": 0, "batch": 4, "width": 16, "heads": 2, "layers": 1, "channels": 4,
    "rounds": 1, "fields": 0, "sweeps": 2, "horizon": 3, "iterations": 2,
}  # fmt: skip
ALL = (properties, stochastic, suboptimal, ablation)
SHORT = ["--episodes", "2"]


@pytest.fixture
def cwd(tmp_path, monkeypatch, quick_begin):
    """Changes to an empty working directory with its own data sets."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def read_rows(cwd, name, folder="runs"):
    return results.read(cwd / folder / f"{name}.jsonl")


def shrink(config, **options):
    """Shrinks a configuration to toy size."""
    return with_options(config, {**TOY, **options})


shrink_to_one_action = functools.partial(shrink, horizon=1)


def make_small_analysis(case, *ways):
    """Makes an analysis of some ways of one case, at toy size."""
    selected = [way for way in case.ways if way.name in ways]
    assert len(selected) == len(ways)
    return Analysis("properties", [case._replace(ways=selected)], change=shrink)


def find_case(name):
    return next(case for case in properties.CASES if case.name == name)


def test_violations_are_penalised_and_counted(cwd, capsys):
    analysis = make_small_analysis(find_case("adaptation-medium"), "whole plan")
    assert cases.main(analysis, [*SHORT, "--record"]) == 0
    (row,) = read_rows(cwd, "properties", "results")
    assert (row["case"], row["way"], row["method"]) == ("adaptation-medium", "whole plan", "leap")
    assert row["violations"] == 0  # the penalty keeps even an untrained model off lava
    assert row["planner"]["fill"] == "sequential" and row["paper_success"] is None
    assert 0 <= row["first_pass_successes"] <= row["episodes"] == 2
    assert cases.main(analysis, [*SHORT, "--record"]) == 0
    assert "recorded already" in capsys.readouterr().out
    assert read_rows(cwd, "properties", "results") == [row]


def test_two_models_are_composed(cwd):
    analysis = make_small_analysis(find_case("composition-medium"), "dt")
    assert cases.main(analysis._replace(change=shrink_to_one_action), SHORT) == 0
    (row,) = read_rows(cwd, "properties")
    assert row["level"] == "PickUpObjMazeS4" and len(set(row["trained"])) == 2
    assert row["train_seconds"] == 0  # without training steps


@only_long
@pytest.mark.parametrize("program", ALL, ids=lambda program: program.ANALYSIS.name)
def test_every_way_of_every_program_runs(cwd, monkeypatch, program):
    """Runs the first case of each program, with one method at a time."""
    analysis = program.ANALYSIS
    case = analysis.cases[0]
    for method in cases.list_methods(case):
        plans = {} if method in ("leap", "classifier") else {"horizon": 1}
        small_analysis = analysis._replace(cases=[case], change=functools.partial(shrink, **plans))
        monkeypatch.setattr(program, "ANALYSIS", small_analysis)
        assert program.main(["--methods", method, *SHORT]) == 0
    assert {row["way"] for row in read_rows(cwd, analysis.name)} == {way.name for way in case.ways}


def test_every_case_is_valid():
    """Names are unique, levels exist, and settings are valid with either preset."""
    for program in ALL:
        analysis = program.ANALYSIS
        names = [case.name for case in analysis.cases]
        assert len(set(names)) == len(names)
        for preset in ("leapjax", "paper"):
            selection = cases.choose_cases(analysis, Options(preset=preset))
            assert [case.name for case in selection] == names
        for case in analysis.cases:
            find_level(case.level)
            names = [way.name for way in case.ways]
            assert len(set(names)) == len(names)


def test_options_choose_ways_and_methods():
    def choose_ways(**options):
        options = Options(only=("composition-easy", "adaptation-hard"), **options)
        found = cases.choose_cases(properties.ANALYSIS, options)
        return {case.name: [way.name for way in case.ways] for case in found if case.ways}

    assert choose_ways(ways=("sum", "whole plan")) == {
        "adaptation-hard": ["whole plan"], "composition-easy": ["sum"],
    }  # fmt: skip
    dt_ways = ["dt", "dt, with more noise", "dt, exploring"]
    assert choose_ways(methods=("dt",)) == {"adaptation-hard": dt_ways, "composition-easy": dt_ways}


def test_the_hash_of_a_row_covers_every_setting_that_affects_it():
    case, analysis = find_case("adaptation-medium"), properties.ANALYSIS

    def name(seed=0, case=case, way=case.ways[1], **options):
        options = Options(**options)
        settings = [
            cases.make_training_config(analysis, m, way.method, seed, options) for m in case.models
        ]
        return cases.hash_row(analysis, case, way, settings, seed, options)

    def name_with(**changes):
        return name(way=case.ways[1]._replace(**changes))

    others = [
        name(way=case.ways[0]), name(seed=1), name(episodes=100), name(preset="paper"),
        name(validation=True), name_with(executed=1), name_with(search=lambda given: given),
        name_with(minimise=cases.alone), name_with(remembers=True),
        name_with(minimise=properties.penalise_unseen(constraints.lava, weight=1.0)),
        name_with(minimise=properties.penalise_unseen(constraints.left_turns)),
        name(case=case._replace(adapter=None)),
    ]  # fmt: skip
    assert len({name(), *others}) == 13
    assert name(force=True, record=True) == name()
    same = properties.penalise_unseen(constraints.lava, weight=properties.WEIGHT)
    assert name_with(minimise=same) == name()


def test_runs_with_augmented_data_have_their_own_folders():
    model = find_case("generalization-easy").models[0]

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
def test_invalid_options_are_reported_in_one_line(arguments, message, cwd, monkeypatch, capsys):
    monkeypatch.setattr(cases, "load_demonstrations", lambda run: pytest.fail("work was done"))
    (cwd / "file").write_text("")
    assert properties.main(arguments) == 2
    error = capsys.readouterr().err
    assert message in error and len(error.strip().splitlines()) == 1


def test_tables_show_current_rows_beside_the_papers_numbers():
    analysis = ablation.ANALYSIS
    case, way = analysis.cases[0], analysis.cases[0].ways[2]
    settings = [cases.make_training_config(analysis, m, "leap", 0, Options()) for m in case.models]
    row = {
        "experiment": "ablation", "case": case.name, "way": way.name, "method": "leap",
        "preset": "leapjax", "seed": 0, "episodes": 200, "successes": 150,
        "first_pass_successes": 100, "violations": None, "mean_length": 9.0,
        "first_episode_seed": 10_000_000,
        "train_seconds": 300.0, "compile_seconds": 20.0, "eval_seconds": 40.0,
        "versions": {"machine": "x86_64"},
        "hash": cases.hash_row(analysis, case, way, settings, 0, Options()),
    }  # fmt: skip
    stale = {**row, "successes": 0, "hash": "of another"}
    table = analyses.compare_ways(analysis, [row, stale], ways=[way.name], cases=["masked"])
    (line,) = (line for line in table.splitlines() if "Gibbs" in line)
    assert "| 62.5% | - | 75.0%" in line
    assert "Gibbs" not in analyses.compare_ways(analysis, [row], cases=["classifier"])
    assert report.is_used(row) and not report.is_used(stale)


@only_long
def test_the_landscape_is_measured_during_training_and_planning(cwd, monkeypatch):
    def toy_preset(domain, level, method, name):
        return shrink(find_preset(domain, level, method, name), steps=40)

    monkeypatch.setattr(landscape, "find_preset", toy_preset)
    arguments = ["--presets", "leapjax", "--trajectories", "8"]
    assert landscape.main(arguments) == 0
    path = cwd / "runs" / "landscape.json"
    (found,) = json.loads(path.read_text())
    assert [entry["step"] for entry in found["training"]] == [20, 40]
    assert len(found["planning"]["mean"]) == 10 and 0 < len(found["planning"]["single"]) <= 8
    assert (cwd / "runs" / "landscape.png").stat().st_size > 10_000
    for wrong in (["--trajectories", "0"], ["--record", "--steps", "3"]):
        assert landscape.main([*arguments, *wrong]) == 2
    landscape.keep_measurements(path, [{**found, "preset": "paper"}, found])
    assert [each["preset"] for each in json.loads(path.read_text())] == ["leapjax", "paper"]


def test_corruption_draws_a_share_of_actions_from_all_but_the_end():
    actions = jnp.full(7000, 2)
    for share in (0.0, 0.25, 1.0):
        found = np.asarray(landscape.corrupt_actions(jax.random.key(1), actions, share, end=6))
        counts = np.bincount(found, minlength=7)
        assert counts[6] == 0
        assert counts[[0, 1, 3, 4, 5]] == pytest.approx(share * 7000 / 6, abs=120)  # 4 sigma
    assert (landscape.corrupt_actions(jax.random.key(1), actions, 0.0, end=6) == actions).all()
