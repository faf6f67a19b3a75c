"""The `main` of BabyAI, end to end at toy size, and its errors for wrong input."""

import json
import shutil

import numpy as np
import pytest
from PIL import Image

from benchmarks import quality
from experiments import babyai, noise
from leapjax import UserError, load, plan_keys, pretrained, rollouts
from leapjax.data import seeds, storage
from leapjax.domains.babyai.adapter import BabyAIAdapter
from leapjax.domains.babyai.domain import BABYAI
from leapjax.domains.babyai.levels import LEVELS
from leapjax.domains.babyai.settings import Settings
from leapjax.planners import GibbsConfig
from leapjax.running import results
from leapjax.running.command_line import parse
from leapjax.running.data import find_demonstrated
from leapjax.running.metrics import read_metrics
from tests.programs import LONG, RANDOM, TOY_RUN, damage, only_long, untrained_run

LEVEL = "GoToLocalS7N5"
DOMAIN = BABYAI.make(LEVEL, Settings())
DATASET = storage.name_dataset(DOMAIN, 6, 0)
SIMPLE = "--batch 1 --no-augment --clutter 0".split()  # one device: compiles faster


@pytest.fixture(scope="module")
def workplace(toy_run, tmp_path_factory):
    """A folder with a finished toy run and its Minari data sets."""
    folder = tmp_path_factory.mktemp("workplace")
    shutil.copytree(toy_run.parent.parent, folder, dirs_exist_ok=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        yield folder


@pytest.fixture(autouse=True)
def minari_folder(workplace, monkeypatch):
    """All tests here share the data sets of the toy run."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(workplace / "minari"))


def run_folder(workplace):
    return only_folder(workplace / "runs")


def only_folder(runs):
    (folder,) = (path for path in runs.iterdir() if path.is_dir())
    return folder


def test_a_run_writes_a_row_metrics_and_checkpoints(workplace):
    (row,) = results.read(workplace / "runs" / "babyai.jsonl")
    assert (row["domain"], row["level"], row["method"]) == ("babyai", LEVEL, "leap")
    assert row["preset"] == "leapjax" and row["demos"] == 6
    assert row["episodes"] == 3 and 0 <= row["mean_return"] <= row["success"] <= 1
    assert row["success"] == row["successes"] / 3
    assert row["iterations"] == 3 and row["horizon"] == 5 and row["train_steps"] == 4
    assert row["configuration"]["training"]["batch"] == 4
    assert not (workplace / "results").exists()
    folder = run_folder(workplace)
    metrics = read_metrics(folder)
    assert metrics[-1]["step"] == 4 and np.isfinite(metrics[-1]["loss"])
    assert [path.name for path in (folder / "checkpoints").iterdir()] == ["4"]
    assert not (folder / "plan.gif").exists()  # without --pictures


def test_evaluating_a_checkpoint_repeats_the_result_without_other_options(workplace):
    arguments = (
        f"--checkpoint {run_folder(workplace)} --episodes 3 --no-pictures --runs again".split()
    )
    assert babyai.main(arguments) == 0
    (before,) = results.read(workplace / "runs" / "babyai.jsonl")
    (after,) = results.read(workplace / "again" / "babyai.jsonl")
    assert after["train_steps"] == 0 and after["train_seconds"] == 0
    for name in ("successes", "mean_length", "mean_return", "demos", "configuration"):
        assert after[name] == before[name], name
    assert after["hash"] != before["hash"]  # training and evaluation have separate rows
    assert parse("babyai", [*TOY_RUN, *arguments]) == parse("babyai", arguments)
    outputs = only_folder(workplace / "again" / "evaluations")
    assert [path.name for path in outputs.iterdir()] == ["episodes.csv"]  # no training


def test_evaluating_a_checkpoint_on_training_levels_raises_an_error(workplace, tmp_path, capsys):
    folder = tmp_path / "learned"
    shutil.copytree(run_folder(workplace), folder)
    note = json.loads((folder / "data.json").read_text())
    (folder / "data.json").write_text(json.dumps({**note, "seeds": [*note["seeds"], 7]}))
    arguments = ["--checkpoint", str(folder), "--episodes", "3", "--no-pictures"]
    assert len(note["seeds"]) > 3
    assert babyai.main([*arguments, "--test-seed", "5"]) == 2
    assert "level seed 7 is both a demonstration and a test episode" in capsys.readouterr().err
    (folder / "data.json").write_text('{"fingerprint": "0"}')  # as earlier versions wrote it
    assert find_demonstrated(folder) == []


def test_evaluating_a_checkpoint_keeps_its_seed_and_writes_pictures(workplace, tmp_path, capsys):
    folder = untrained_run(tmp_path / "random", "--method", "random", "--seeds", "2")
    arguments = ["--checkpoint", str(folder), "--episodes", "1", "--runs", str(tmp_path / "again")]
    assert babyai.main(arguments) == 0
    (row,) = results.read(tmp_path / "again" / "babyai.jsonl")
    assert row["seed"] == row["configuration"]["seed"] == 2 and row["method"] == "random"
    pictures = only_folder(tmp_path / "again" / "evaluations")
    names = {path.name for path in pictures.iterdir()}
    assert names == {"iterations.png", "plan.gif", "episodes.csv"}
    assert Image.open(pictures / "iterations.png").size[0] > 300
    assert Image.open(pictures / "plan.gif").n_frames > 1
    capsys.readouterr()
    assert babyai.main([*arguments, "--seeds", "0"]) == 2
    assert "does not fit: seed is 2, not 0" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("--level", "GoToLocalS8N7", f"level is {LEVEL}, not GoToLocalS8N7"),
        ("--horizon", "4", "horizon is 5, not 4"),
        ("--channels", "8", "channels is 4, not 8"),
        ("--method", "iql", "method is leap, not iql"),
    ],
)
def test_options_that_contradict_a_checkpoint_raise_an_error(
    workplace, tmp_path, capsys, option, value, message
):
    checkpoint = ["--checkpoint", str(run_folder(workplace)), "--runs", str(tmp_path / "runs")]
    assert babyai.main([*checkpoint, option, value]) == 2
    error = capsys.readouterr().err
    assert f"does not fit: {message}" in error and error.count("\n") == 1
    assert not (tmp_path / "runs").exists()


def test_a_loaded_planner_keeps_the_horizon_and_observation_shapes_of_training(workplace):
    planner, adapter = load(run_folder(workplace)), BabyAIAdapter(LEVELS[LEVEL])
    histories = [rollouts.History(adapter.reset(s), 0, adapter.num_actions) for s in range(3)]
    plan = planner(plan_keys(0, np.arange(3), np.zeros(3)), rollouts.stack_contexts(histories))
    actions = np.asarray(plan.actions)
    assert actions.shape == (3, 5) and plan.trace.shape == (3, 3, 5)
    assert actions.min() >= 0 and actions.max() < 7
    assert (actions[:, 0] != 6).all()  # a plan never begins with the end action
    with pytest.raises(UserError, match="plans 5 actions, not 4: its horizon"):
        load(run_folder(workplace), GibbsConfig(horizon=4))
    larger = LEVELS["GoToLocalS8N7"]
    with pytest.raises(UserError, match=r"grid has shape \(8, 8, 3\), but .* \(7, 7, 3\)"):
        rollouts.evaluate(
            lambda: BabyAIAdapter(larger), [0], planner.plan, planner.params, context=0
        )


def test_recording_skips_recorded_runs_unless_forced(workplace, capsys):
    arguments = [*RANDOM, "--record", "--runs", "recorded"]
    assert babyai.main(arguments) == 0
    path = workplace / "results" / "babyai.jsonl"
    first = path.read_text()
    assert babyai.main(arguments) == 0
    assert "recorded already" in capsys.readouterr().out
    assert path.read_text() == first
    path.write_text(first.replace('"checkpoint": null', '"checkpoint": "other"'))
    assert babyai.main(arguments) == 2  # a row of another network
    assert "is of the checkpoint other" in capsys.readouterr().err
    assert babyai.main([*arguments, "--force"]) == 0
    assert len(results.read(path)) == 1
    shutil.rmtree(workplace / "results")


# BabyAI-PutNextS4N1-v0 is a level by id, with a grid that is not square.
@pytest.mark.parametrize(
    ("name", "level"),
    [
        ("paper", "BabyAI-PutNextS4N1-v0"),
        pytest.param("paper", "GoToSeqS5R2", marks=only_long),
        pytest.param("leapjax", "BabyAI-PutNextS4N1-v0", marks=only_long),
    ],
)
def test_both_presets_run_on_any_level_with_context(workplace, name, level, quick_begin):
    runs = f"{name} {level}"
    arguments = ["--preset", name, "--level", level, "--context", "2", "--runs", runs]
    arguments += [] if LONG else ["--steps", "0"]  # the gradient takes long to compile
    assert babyai.main([*TOY_RUN, *SIMPLE, *arguments]) == 0
    (row,) = results.read(workplace / runs / "babyai.jsonl")
    assert (row["preset"], row["level"]) == (name, level)
    assert row["configuration"]["context"] == 2
    assert (row["paper_success"] is None) == level.startswith("BabyAI-")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--demos", "0"], "--demos must be at least 1"),
        (["--horizon", "50", "--resampled", "1"], "longer than any episode"),
        (["--executed", "6"], "--executed 6 is not in 1 .. 5"),
        (["--target-return", "2"], "--method leap is told of returns with --returns only"),
        (["--test-seed", "99999999", "--episodes", "2"], "test seeds"),
        (["--demonstrations", DATASET, "--demos", "7"], "fewer than 7: ask for 6"),
    ],
)
def test_wrong_input_prints_one_line_and_exits_with_code_2(workplace, capsys, arguments, message):
    assert babyai.main([*TOY_RUN, *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1 and error.startswith("error: ")


def test_a_run_restarts_if_its_only_checkpoint_is_damaged(workplace, tmp_path, capsys):
    runs = tmp_path / "runs"
    arguments = [*RANDOM, "--steps", "4", "--demos", "1", "--runs", str(runs)]

    assert babyai.main(arguments) == 0
    (before,) = results.read(runs / "babyai.jsonl")
    damage(only_folder(runs) / "checkpoints" / "4")
    assert babyai.main(arguments) == 0
    error = capsys.readouterr().err
    assert "checkpoints/4 is damaged" in error and "there is none before it" in error
    (after,) = results.read(runs / "babyai.jsonl")
    assert after["successes"] == before["successes"]
    damage(only_folder(runs) / "checkpoints" / "4")
    with pytest.raises(UserError, match="cannot be read"):
        load(only_folder(runs))


def test_resuming_a_run_on_other_demonstrations_raises_an_error(workplace, tmp_path, capsys):
    folder = tmp_path / "runs" / run_folder(workplace).name
    shutil.copytree(run_folder(workplace), folder)
    (folder / "data.json").write_text('{"fingerprint": "0123456789abcdef"}')
    assert babyai.main([*TOY_RUN, "--runs", str(tmp_path / "runs")]) == 2
    assert "was begun on other demonstrations (0123456789abcdef" in capsys.readouterr().err


def test_a_run_does_not_overwrite_a_run_of_another_configuration(tmp_path, monkeypatch, capsys):
    """Another version of the library may name its parameters differently."""
    arguments = [*RANDOM, "--steps", "4", "--demos", "1", "--runs", str(tmp_path / "runs")]
    assert babyai.main(arguments) == 0
    specification = only_folder(tmp_path / "runs") / "specification.json"
    specification.write_text(before := specification.read_text() + "\n")
    monkeypatch.setattr(pretrained, "describe_identity", lambda specification: "of another version")
    assert babyai.main(arguments) == 2
    assert "is of another configuration" in capsys.readouterr().err
    assert specification.read_text() == before


def test_search_settings_are_compared_on_validation_levels(workplace, tmp_path, monkeypatch):
    searches = {"one": GibbsConfig(1, 1), "two": GibbsConfig(1, 2)}
    monkeypatch.setattr(quality, "variants", lambda trained, most: searches)
    played, evaluate = [], rollouts.evaluate

    def record(make_adapter, episode_seeds, *rest, **options):
        played.append(list(episode_seeds))
        return evaluate(make_adapter, episode_seeds, *rest, **options)

    monkeypatch.setattr(rollouts, "evaluate", record)
    folder = untrained_run(tmp_path / "run", "--method", "random")
    options = f"--episodes 3 --batch 4 --seconds 0.01 --plot {tmp_path}/plot.png --json"
    assert quality.main([str(folder), *options.split(), str(tmp_path / "rows.json")]) == 0
    written = json.loads((tmp_path / "rows.json").read_text())
    assert [(row["variant"], row["iterations"]) for row in written] == [("one", 1), ("two", 2)]
    assert all(row["plans_per_second"] > 0 and row["successes"] <= 3 for row in written)
    assert played == [list(seeds.validation_seeds(0, 3))] * 2
    assert (tmp_path / "plot.png").stat().st_size > 1000


def test_noise_plays_validation_levels_at_every_temperature(workplace, tmp_path, monkeypatch):
    """PlaTe uses a single beam at temperatures above 0."""
    (plate,) = parse("babyai", ["--method", "plate", "--preset", "paper"])
    beams = {each.planner.temperature: each.planner.beams for each in noise.try_temperatures(plate)}
    assert set(beams.values()) == {1} and set(beams) == {*noise.TEMPERATURES} - {0.0}
    temperatures = (0.0, 0.5) if LONG else (0.5,)  # each compiles a program
    monkeypatch.setattr(noise, "TEMPERATURES", temperatures)
    folder = str(tmp_path)
    arguments = [*TOY_RUN, *"--method leap --level GoToLocalS7N5 --steps 0 --episodes 2".split()]
    assert noise.main([*arguments, "--runs", folder]) == 0
    rows = results.read(tmp_path / "noise.jsonl")
    tried = [row["configuration"]["planner"]["temperature"] for row in rows]
    assert sorted(tried) == sorted(noise.TEMPERATURES)
    assert all(row["validation"] for row in rows)
