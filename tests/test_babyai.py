"""The real `main`, end to end at toy size, and what it says to wrong input."""

import json
import os
import shutil

import jax
import numpy as np
import pytest
from PIL import Image

from benchmarks import quality
from experiments import babyai, pipeline, results
from experiments.config import PRESETS, preset
from leapjax import UserError, files, load, plan_keys, rollouts
from leapjax.data import seeds, storage
from leapjax.envs.adapter import BabyAIAdapter
from leapjax.envs.levels import LEVELS
from leapjax.planners import GibbsConfig

LEVEL = "GoToLocalS7N5"
TOY = (
    "--demos 6 --episodes 5 --steps 4 --batch 4 --width 16 --heads 2 --layers 1 --channels 4 "
    "--rounds 1 --fields 2 --sweeps 2 --iterations 3"
).split()
FIELDS = (
    "experiment level method preset seed demos episodes successes mean_length horizon "
    "iterations executed train_steps train_seconds eval_seconds plans_per_second params "
    "versions date hash"
).split()


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    """An empty folder with its own Minari data sets, where one toy run has finished."""
    folder = tmp_path_factory.mktemp("workplace")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("MINARI_DATASETS_PATH", str(folder / "datasets"))
        patch.setenv("LEAPJAX_COMPILATION_CACHE", str(folder / "cache"))
        assert babyai.main(TOY) == 0
        yield folder


@pytest.fixture(autouse=True)
def minari_folder(workplace, monkeypatch):
    """All tests here share the data sets of the toy run."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(workplace / "datasets"))


def run_folder(workplace):
    (folder,) = (p for p in (workplace / "runs").iterdir() if p.is_dir() and "leapjax" in p.name)
    return folder


def test_a_run_leaves_a_row_with_every_field(workplace):
    (row,) = results.read(workplace / "runs" / "babyai.jsonl")
    assert set(FIELDS) <= row.keys()
    assert row["level"] == LEVEL and row["preset"] == "leapjax" and row["demos"] == 6
    assert row["episodes"] == 5 and 0 <= row["successes"] <= 5
    assert row["iterations"] == 3 and row["horizon"] == 5 and row["train_steps"] == 4
    assert row["configuration"]["training"]["batch"] == 4
    assert not (workplace / "results").exists()


def test_a_run_leaves_pictures_metrics_and_a_checkpoint(workplace):
    folder = run_folder(workplace)
    for name in ("loss.png", "iterations.png"):
        assert Image.open(folder / name).size[0] > 300
    assert getattr(Image.open(folder / "plan.gif"), "n_frames", 1) > 3
    metrics = pipeline.read_metrics(folder)
    assert metrics[-1]["step"] == 4 and np.isfinite(metrics[-1]["loss"])


def test_the_checkpoint_evaluates_again_without_training(workplace, capsys):
    (before,) = results.read(workplace / "runs" / "babyai.jsonl")
    arguments = ["--checkpoint", str(run_folder(workplace)), "--runs", "again", "--no-pictures"]
    assert babyai.main([*TOY, *arguments]) == 0
    (after,) = results.read(workplace / "again" / "babyai.jsonl")
    assert after["train_steps"] == 0 and after["train_seconds"] == 0
    assert (after["successes"], after["mean_length"]) == (
        before["successes"],
        before["mean_length"],
    )


def test_a_checkpoint_needs_no_other_setting(workplace):
    arguments = ["--checkpoint", str(run_folder(workplace)), "--episodes", "5", "--no-pictures"]
    assert babyai.main([*arguments, "--runs", "alone"]) == 0
    (before,) = results.read(workplace / "runs" / "babyai.jsonl")
    (after,) = results.read(workplace / "alone" / "babyai.jsonl")
    assert after["successes"] == before["successes"]
    assert after["configuration"]["model"] == before["configuration"]["model"]
    assert after["demos"] == before["demos"] == 6


def test_a_row_of_a_checkpoint_has_the_seed_that_it_was_trained_with(workplace, tmp_path, capsys):
    copy = tmp_path / "copy"
    shutil.copytree(run_folder(workplace), copy)
    settings = json.loads((copy / "config.json").read_text())
    (copy / "config.json").write_text(json.dumps({**settings, "seed": 2}))
    arguments = ["--checkpoint", str(copy), "--no-pictures", "--runs", str(tmp_path / "again")]
    assert babyai.main([*arguments, "--episodes", "1"]) == 0
    (row,) = results.read(tmp_path / "again" / "babyai.jsonl")
    assert row["seed"] == row["configuration"]["seed"] == 2
    capsys.readouterr()
    assert babyai.main([*arguments, "--seeds", "0"]) == 2
    assert "does not fit: seed is 2, not 0" in capsys.readouterr().err
    assert babyai.main([*arguments, "--demos", "5"]) == 2
    assert "does not fit: demos is 6, not 5" in capsys.readouterr().err


def test_the_same_configuration_continues_and_keeps_one_row(workplace, capsys):
    assert babyai.main([*TOY, "--no-pictures"]) == 0
    assert "continuing at step 4 of 4" in capsys.readouterr().out
    assert len(results.read(workplace / "runs" / "babyai.jsonl")) == 1


def test_a_loaded_planner_plans(workplace):
    planner = load(run_folder(workplace))
    adapter = BabyAIAdapter(LEVELS[LEVEL])
    histories = [rollouts.History(adapter.reset(s), 0, adapter.num_actions) for s in range(3)]
    plan = planner(plan_keys(0, np.arange(3), np.zeros(3)), rollouts.stack_contexts(histories))
    actions = np.asarray(plan.actions)
    assert actions.shape == (3, 5) and plan.trace.shape == (3, 3, 5)
    assert actions.min() >= 0 and actions.max() < 7
    assert (actions[:, 0] != 6).all()  # end is never first


def test_a_planner_of_a_smaller_grid_is_refused_a_larger_level(workplace):
    planner = load(run_folder(workplace))
    large = LEVELS["GoToLocalS8N7"]
    with pytest.raises(UserError, match=r"grid has shape \(8, 8, 3\), but .* \(7, 7, 3\)"):
        rollouts.evaluate(
            lambda: BabyAIAdapter(large), [0], planner.plan, planner.params, context=0
        )
    with pytest.raises(UserError, match=r"past actions has shape \(2,\), but .* \(0,\)"):
        rollouts.evaluate(
            lambda: BabyAIAdapter(LEVELS[LEVEL]), [0], planner.plan, planner.params, context=2
        )


def test_recording_skips_what_is_recorded_unless_forced(workplace, capsys):
    arguments = [*TOY, "--record", "--no-pictures"]
    assert babyai.main(arguments) == 0
    path = workplace / "results" / "babyai.jsonl"
    first = path.read_text()
    assert babyai.main(arguments) == 0
    assert "recorded already" in capsys.readouterr().out
    assert path.read_text() == first
    assert babyai.main([*arguments, "--force"]) == 0
    assert len(results.read(path)) == 1
    shutil.rmtree(workplace / "results")


def test_the_paper_preset_and_a_level_with_context_run(workplace):
    arguments = ["--preset", "paper", "--level", "GoToSeqS5R2", "--context", "2"]
    assert babyai.main([*TOY, *arguments, "--no-pictures", "--runs", "paper"]) == 0
    (row,) = results.read(workplace / "paper" / "babyai.jsonl")
    assert row["preset"] == "paper" and row["level"] == "GoToSeqS5R2"
    assert row["configuration"]["context"] == 2


def test_a_level_by_its_id_that_is_not_square(workplace):
    arguments = ["--level", "BabyAI-PutNextS4N1-v0", "--no-pictures", "--runs", "id"]
    assert babyai.main([*TOY, *arguments]) == 0
    (row,) = results.read(workplace / "id" / "babyai.jsonl")
    assert row["level"] == "BabyAI-PutNextS4N1-v0" and row["paper_success"] is None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--level", "GoToLocalS7N6"], "did you mean GoToLocalS7N5"),
        (["--preset", "papr"], "unknown preset 'papr'"),
        (["--demos", "0"], "--demos must be at least 1"),
        (["--episodes", "0"], "--episodes must be at least 1"),
        (["--horizon", "50", "--resampled", "1"], "longer than an episode"),
        (["--horizon", "0"], "horizon must be at least 1"),
        (["--executed", "6"], "--executed 6 is not in 1 .. 5"),
        (["--masking", "some"], "unknown masking 'some'"),
        (["--test-seed", "99999999", "--episodes", "2"], "test seeds"),
        (["--seeds", "-1"], "a training seed must be in"),
        (["--demonstrations", "nobody/nothing-v0"], "no Minari data set"),
        (["--checkpoint", "nowhere"], "nowhere is not a checkpoint"),
    ],
)
def test_wrong_input_is_one_line_and_exit_code_2(workplace, capsys, arguments, message):
    assert babyai.main([*TOY, *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1 and error.startswith("error: ")


def test_a_checkpoint_of_another_level_or_shape_is_refused(workplace, capsys):
    checkpoint = ["--checkpoint", str(run_folder(workplace))]
    assert babyai.main([*TOY, *checkpoint, "--level", "GoToLocalS8N7"]) == 2
    assert "level is GoToLocalS7N5, not GoToLocalS8N7" in capsys.readouterr().err
    assert babyai.main([*TOY, *checkpoint, "--horizon", "4"]) == 2
    assert "horizon is 5, not 4" in capsys.readouterr().err


def test_a_damaged_checkpoint_is_refused(workplace, tmp_path, capsys):
    copy = tmp_path / "copy"
    shutil.copytree(run_folder(workplace), copy)
    specification = json.loads((copy / "specification.json").read_text())
    specification["model"]["width"] = 32
    (copy / "specification.json").write_text(json.dumps(specification))
    with pytest.raises(UserError, match="does not fit its configuration"):
        load(copy)
    (copy / "specification.json").write_text("{")
    with pytest.raises(UserError, match="not valid JSON"):
        load(copy)


def test_a_run_whose_only_training_state_is_damaged_begins_again(workplace, tmp_path, capsys):
    folder = tmp_path / "runs" / run_folder(workplace).name
    shutil.copytree(run_folder(workplace), folder)
    damage(folder / "checkpoints" / "4")
    assert babyai.main([*TOY, "--runs", str(tmp_path / "runs"), "--no-pictures"]) == 0
    error = capsys.readouterr().err
    assert "checkpoints/4 is damaged" in error and "there is none before it" in error
    (before,) = results.read(workplace / "runs" / "babyai.jsonl")
    (after,) = results.read(tmp_path / "runs" / "babyai.jsonl")
    assert after["successes"] == before["successes"]
    with pytest.raises(UserError, match="cannot be read"):
        damage(folder / "checkpoints" / "4")
        load(folder)


def damage(checkpoint):
    """Cuts every file of a checkpoint's arrays in half."""
    for file in (checkpoint / "default").rglob("*"):
        if file.is_file():
            file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def test_a_run_that_was_begun_on_other_demonstrations_is_refused(workplace, tmp_path, capsys):
    folder = tmp_path / "runs" / run_folder(workplace).name
    shutil.copytree(run_folder(workplace), folder)
    (folder / "data.json").write_text('{"fingerprint": "0123456789abcdef"}')
    assert babyai.main([*TOY, "--runs", str(tmp_path / "runs")]) == 2
    assert "was begun on other demonstrations (0123456789abcdef" in capsys.readouterr().err


def test_a_folder_in_use_is_refused(workplace, capsys):
    with files.only_process_in(run_folder(workplace)):
        assert babyai.main(TOY) == 2
    error = capsys.readouterr().err
    assert f"in use by another process ({os.getpid()})" in error and error.count("\n") == 1
    assert babyai.main([*TOY, "--no-pictures"]) == 0


def test_a_data_set_of_the_users_own_is_trained_on(workplace):
    mine = storage.dataset_id(LEVELS[LEVEL], 6, 0)
    arguments = ["--demonstrations", mine, "--runs", "mine", "--no-pictures"]
    assert babyai.main([*TOY, *arguments]) == 0
    (row,) = results.read(workplace / "mine" / "babyai.jsonl")
    (original,) = results.read(workplace / "runs" / "babyai.jsonl")
    assert row["successes"] == original["successes"]


def test_too_few_demonstrations_in_a_data_set(workplace, capsys):
    mine = storage.dataset_id(LEVELS[LEVEL], 6, 0)
    assert babyai.main([*TOY, "--demonstrations", mine, "--demos", "7"]) == 2
    assert "fewer than --demos 7" in capsys.readouterr().err


def test_evaluation_does_not_depend_on_the_batch(workplace):
    planner = load(run_folder(workplace))
    level = LEVELS[LEVEL]

    def play(seeds):
        return rollouts.evaluate(
            lambda: BabyAIAdapter(level), seeds, planner.plan, planner.params, context=0
        )

    together, alone = play(range(9)), play([4])
    assert together.lengths[4] == alone.lengths[0]
    assert together.successes[4] == alone.successes[0]


def test_rows_refuse_damage_by_line_number(tmp_path):
    path = tmp_path / "rows.jsonl"
    row = {n: "x" if k is str else k(1) for n, k in results.FIELDS.items()}
    path.write_text(json.dumps(row) + "\n{oops\n")
    with pytest.raises(UserError, match="line 2: not JSON"):
        results.read(path)
    path.write_text("[]\n")
    with pytest.raises(UserError, match="line 1: expected a JSON object, got list"):
        results.read(path)


def test_parameters_are_plain_arrays(workplace):
    assert all(
        isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(load(run_folder(workplace)).params)
    )


def test_search_settings_are_compared_on_validation_levels(workplace, tmp_path, monkeypatch):
    monkeypatch.setattr(
        quality, "variants", lambda trained, most: {"trained": trained, "one": GibbsConfig(5, 1)}
    )
    played = []
    evaluate = rollouts.evaluate

    def record(make_adapter, episode_seeds, *rest, **options):
        played.append(list(episode_seeds))
        return evaluate(make_adapter, episode_seeds, *rest, **options)

    monkeypatch.setattr(rollouts, "evaluate", record)
    rows, plot = tmp_path / "rows.json", tmp_path / "plot.png"
    arguments = "--episodes 3 --batch 4 --seconds 0.01 --json".split()
    folder = str(run_folder(workplace))
    assert quality.main([folder, *arguments, str(rows), "--plot", str(plot)]) == 0
    written = json.loads(rows.read_text())
    assert [row["variant"] for row in written] == ["trained", "one"]
    assert [row["iterations"] for row in written] == [3, 1]
    assert all(row["plans_per_second"] > 0 and row["successes"] <= 3 for row in written)
    assert played == [list(seeds.validation_seeds(0, 3))] * 2
    assert plot.stat().st_size > 1000


def test_every_search_setting_can_be_made():
    for level in LEVELS.values():
        for name in PRESETS:
            variants = quality.variants(preset(level, name).planner, level.iterations)
            assert len(variants) > 10
            assert max(config.iterations for config in variants.values()) == level.iterations


def test_quality_without_a_run_is_one_line(tmp_path, capsys):
    assert quality.main([str(tmp_path)]) == 2
    assert "is not a checkpoint" in capsys.readouterr().err
