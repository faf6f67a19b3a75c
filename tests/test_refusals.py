"""What a careless or hostile user does: refused in one line, before any work, and nothing lost."""

import dataclasses
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import experiments.__main__ as everything
import leapjax as leap
from experiments import (
    accuracy,
    atari,
    atari_energy,
    babyai,
    failures,
    gymnasium,
    landscape,
    properties,
    publish,
    qualitative,
    report,
)
from experiments.common import experiment, plots, program, results, run, runtime
from experiments.common.config import configuration_hash, parse
from leapjax import checkpoints, files, pretrained
from leapjax.babyai import demonstrations, levels
from leapjax.checkpoints import Checkpoints
from leapjax.errors import UserError
from leapjax.types import TrainState
from tests.programs import ROOT, TOY_RUN, only_long


@pytest.fixture(autouse=True)
def workplace(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def one_line(capsys, *arguments) -> str:
    """The line with which a command is refused."""
    assert babyai.main([*TOY_RUN, *map(str, arguments)]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and error.count("\n") == 1
    return error


# An empty value, as a variable that is not set leaves it.

EVERYWHERE = (
    "--level --method --preset --demonstrations --checkpoint --runs --play --loggers "
    "--coordinator --masking --seeds --demos"
).split()
EMPTY = [
    *((babyai.main, [option, ""], option) for option in EVERYWHERE),
    *((babyai.main, [f"{option}="], option) for option in EVERYWHERE),
    (babyai.main, ["--runs", "  "], "--runs"),
    (babyai.main, ["--level", "PickUpLoc", "--seeds", "0", ""], "--seeds"),
    (babyai.main, [""], "an argument"),
    (gymnasium.main, ["--env", ""], "--env"),
    (gymnasium.main, ["--dataset="], "--dataset"),
    (gymnasium.main, ["--arguments", ""], "--arguments"),
    (atari.main, ["--game", ""], "--game"),
    (atari.main, ["collect", "--folder="], "--folder"),
    (properties.main, ["--only", ""], "--only"),
    (accuracy.main, [""], "an argument"),
    (accuracy.main, ["runs/a", ""], "an argument"),
    (publish.main, [""], "an argument"),
    (failures.main, ["--gallery", "", "runs/a"], "--gallery"),
    (landscape.main, ["--presets", "paper", ""], "--presets"),
    (qualitative.main, ["--runs", ""], "--runs"),
    (atari_energy.main, ["--checkpoint", ""], "--checkpoint"),
    (everything.main, ["babyai", "--level="], "--level"),
    (everything.main, [""], "an argument"),
]


@pytest.mark.parametrize(("main", "arguments", "option"), EMPTY)
def test_an_empty_value_is_refused(workplace, capsys, main, arguments, option):
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    assert stopped.value.code == 2
    said = capsys.readouterr().err
    assert said == f"error: {option} is empty: give it a value, or leave it out\n"
    assert not list(workplace.iterdir())


def test_a_value_may_have_any_other_shape():
    program.check_values(["--arguments", '{"a": ""}', "--runs==", "--runs", "=", "--runs=a=", "-x"])
    with pytest.raises(UserError, match="--level is empty"):
        parse("babyai", ["--level", ""])


# Checkpoints.


def test_a_folder_in_which_checkpoints_would_be_lost(workplace, capsys):
    assert "because of '[' in its name" in one_line(capsys, "--runs", "out/run[1]")
    assert not (workplace / "out").exists()
    for folder in (workplace / "a[1]", workplace / "b*", workplace / "gs:/c"):
        with pytest.raises(UserError, match="cannot hold checkpoints"):
            Checkpoints(folder)
        with pytest.raises(UserError, match="cannot hold checkpoints"):
            checkpoints.restore_params(folder, {})
    (workplace / "file").write_text("")
    with pytest.raises(UserError, match="cannot write to"):
        Checkpoints(workplace / "file")


def small(value: float) -> TrainState:
    return TrainState({"w": jnp.full(3, value)}, (), jnp.int32(1))


def test_a_checkpoint_belongs_to_its_configuration(workplace):
    saved = Checkpoints(workplace / "a", identity="mine")
    saved.save(small(1.0))
    saved.close()
    shutil.copytree(workplace / "a", workplace / "b")
    for identity in ("yours", ""):
        with pytest.raises(UserError, match="another configuration"):
            checkpoints.restore_params(workplace / "b", small(0.0).params, identity)
        other = Checkpoints(workplace / "b", identity)
        with pytest.raises(UserError, match="another configuration"):
            other.restore(small(0.0))
        other.close()
    assert (workplace / "b" / "1").is_dir()  # whole, so it is not set aside as damaged
    mine = checkpoints.restore_params(workplace / "b", small(0.0).params, "mine")
    np.testing.assert_array_equal(mine["w"], 1.0)


@pytest.mark.parametrize(
    ("group", "name", "value"),
    [
        ("model", "heads", 1),
        ("domain_settings", "sweeps", 7),
        ("domain_settings", "sweeps", 0),
        ("domain_settings", "radius", 3),  # the default, which may be left out
        ("planner", "temperature", 0.25),
        ("origin", "seed", 5),
    ],
)
def test_a_specification_that_was_edited(toy_run, workplace, group, name, value):
    copy = workplace / "copy"
    shutil.copytree(toy_run, copy)
    specification = json.loads((copy / "specification.json").read_text())
    same = specification[group][name] == value
    specification[group][name] = value
    (copy / "specification.json").write_text(json.dumps(specification))
    if same:
        leap.load(copy)
        return
    with pytest.raises(UserError, match="must be at least" if not value else "another config"):
        leap.load(copy)


def test_a_specification_of_sizes_that_nothing_has(toy_run, workplace):
    for name, value in {"context": -1, "planner": {"horizon": 0}}.items():
        copy = workplace / name
        shutil.copytree(toy_run, copy)
        specification = json.loads((copy / "specification.json").read_text())
        specification[name] = value
        (copy / "specification.json").write_text(json.dumps(specification))
        with pytest.raises(UserError, match="must be at least"):
            leap.load(copy)


def test_a_setting_that_an_old_specification_lacks_has_its_default(toy_run, workplace):
    copy = workplace / "copy"
    shutil.copytree(toy_run, copy)
    specification = json.loads((copy / "specification.json").read_text())
    del specification["domain_settings"]["radius"]
    (copy / "specification.json").write_text(json.dumps(specification))
    before, after = (leap.load(path).specification for path in (toy_run, copy))
    assert before == after


# Rows.


def test_to_train_and_to_play_again_are_two_rows(toy_run):
    (config,) = parse("babyai", ["--checkpoint", str(toy_run)])
    again, trained = config, dataclasses.replace(config, checkpoint=None)
    assert configuration_hash(again, 0) != configuration_hash(trained, 0)


def test_a_damaged_file_of_rows_is_found_before_the_run(workplace, capsys, monkeypatch):
    monkeypatch.setattr(run, "collect", lambda *rest: pytest.fail("the run began"))
    (workplace / "runs").mkdir()
    for line in ("{oops", json.dumps({"successes": 10**400})):
        (workplace / "runs" / "babyai.jsonl").write_text(line + "\n")
        assert "babyai.jsonl, line 1" in one_line(capsys)


def test_a_number_that_no_run_could_give(workplace):
    row = {n: "x" if k is str else k(1) for n, k in results.FIELDS.items()}
    path = workplace / "rows.jsonl"
    for value in (10**400, float("nan"), float("inf")):
        path.write_text(json.dumps({**row, "mean_length": value}) + "\n")
        with pytest.raises(UserError, match="line 1: mean_length is"):
            results.read(path)


def test_a_level_that_fails_does_not_end_the_others(workplace, capsys, monkeypatch):
    played = []

    def run_one(which, config, seed, *rest):
        played.append((config.level, seed))
        if config.level == "GoToLocalS8N7":
            raise UserError("something is wrong with it")
        return {
            **{n: "x" if k is str else k(1) for n, k in results.FIELDS.items()},
            "level": config.level,
        }

    monkeypatch.setattr(experiment, "run_one", run_one)
    assert babyai.main(["--level", "all", "--seeds", "0", "1", "--no-pictures"]) == 2
    assert played == [(level, seed) for level in levels.LEVELS for seed in (0, 1)]
    said = capsys.readouterr()
    assert said.err == "error: something is wrong with it\n"
    assert "GoToLocalS8N7, seed 1, failed" in said.out and "GoToSeqS5R2" in said.out


@pytest.mark.parametrize("record", [True, False])
@pytest.mark.parametrize("trained", [True, False])
def test_where_nothing_can_be_written_nothing_is_done(
    toy_run, workplace, capsys, monkeypatch, record, trained
):
    (workplace / ("results" if record else "runs")).write_text("")
    for name in ("collect", "load", "measure"):
        monkeypatch.setattr(run, name, lambda *given: pytest.fail("work was done"))
    more = ["--checkpoint", toy_run] if trained else []
    said = one_line(capsys, *more, *["--record"] * record)
    # A file that is a folder of rows is found when it is read.
    assert "cannot write to" in said or "cannot read" in said


def test_a_run_that_has_not_come_to_its_end(toy_run, workplace, capsys):
    stopped = workplace / "stopped"
    shutil.copytree(toy_run, stopped)
    (stopped / "checkpoints" / "4").rename(stopped / "checkpoints" / "3")
    said = "ends at step 3 of 4: start the run's command again"
    assert said in one_line(capsys, "--checkpoint", stopped, "--record")
    assert not list(workplace.rglob("*.jsonl"))
    with pytest.raises(UserError, match=said):
        pretrained.publish(stopped, workplace / "published")
    with pytest.warns(UserWarning, match="ends at step 3 of 4"):
        leap.load(stopped)
    with pytest.raises(UserError, match=said):
        leap.load(stopped, finished=True)
    leap.load(toy_run, finished=True)


def test_a_level_that_was_learned_is_not_played_where_it_was_learned(toy_run, workplace, capsys):
    run_folder = workplace / "run"
    shutil.copytree(toy_run, run_folder)
    data = run_folder / "data.json"
    values = json.loads(data.read_text())
    values["seeds"][0] = 10_000_000
    data.write_text(json.dumps(values))
    for more in ([], ["--play", "GoToLocalS7N5"]):
        said = one_line(capsys, "--checkpoint", run_folder, *more)
        assert "10000000 is both a demonstration and a test episode" in said


def test_a_training_curve_of_no_numbers(workplace):
    (workplace / "metrics.csv").write_text("step,seconds,loss\nnan,1.0,2.0\n")
    with pytest.raises(UserError, match="damaged"):
        run.read_metrics(workplace)


def test_the_report_where_there_are_no_rows(workplace, capsys):
    assert report.main() == 2
    assert capsys.readouterr().err.startswith("error: cannot read")


# The machine.


@pytest.mark.parametrize(
    "options",
    ["--iterations 1000000000", "--restarts 100000000", "--batch 100000000", "--width 200000"],
)
def test_more_than_the_machine_has(options, capsys):
    assert "GiB of memory would be needed" in one_line(capsys, *options.split())


@pytest.mark.parametrize("temperature", ["1e39", "nan", "-1"])
def test_a_temperature_at_which_noise_is_no_number(temperature, capsys):
    assert "temperature must be" in one_line(capsys, "--temperature", temperature)


def test_numbers_of_64_bits_are_refused():
    with (
        jax.enable_x64(True),
        pytest.raises(UserError, match="unset JAX_ENABLE_X64"),
    ):
        runtime.start()


@pytest.mark.parametrize("count", ["", " ", "many"])
def test_a_launcher_that_says_nothing(count, monkeypatch):
    monkeypatch.setenv("OMPI_COMM_WORLD_SIZE", count)
    monkeypatch.setattr(
        runtime.jax.distributed, "initialize", lambda *rest, **more: pytest.fail("joined")
    )
    runtime.connect(runtime.Cluster())


def test_what_is_written_is_on_the_disk(workplace, monkeypatch):
    """The file before it has its name, the folder after."""
    flushed = []
    real = os.fsync

    def fsync(descriptor):
        flushed.append(Path(f"/proc/self/fd/{descriptor}").readlink())
        real(descriptor)

    monkeypatch.setattr(os, "fsync", fsync)
    files.write_text(workplace / "row.json", "new")
    assert [flushed[0].parent, flushed[1]] == [workplace, workplace]
    assert flushed[0].name != "row.json"


def test_a_picture_is_whole_or_not_there(workplace, monkeypatch):
    path = workplace / "plot.png"
    metrics = [{"step": 1.0, "seconds": 0.1, "loss": 1.0}]
    plots.training_curve(metrics, path)
    before = path.read_bytes()

    def full(figure, target, **options):
        target.write_bytes(b"half a pic")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(plots.Figure, "savefig", full)
    with pytest.raises(UserError, match=r"cannot write .*plot.png.*No space left"):
        plots.training_curve(metrics, path)
    assert path.read_bytes() == before
    assert [p.name for p in workplace.iterdir()] == ["plot.png"]


def test_a_disk_without_room_is_refused_before_anything_is_written(workplace, monkeypatch):
    saved = Checkpoints(workplace / "a")
    monkeypatch.setattr(files, "SPARE", 2**60)
    with pytest.raises(UserError, match="MiB are free in .* may be needed"):
        saved.save(small(1.0))
    saved.close()
    assert list((workplace / "a").iterdir()) == []


def test_a_folder_of_data_sets_that_cannot_be_written_to(capsys, monkeypatch):
    monkeypatch.setattr(demonstrations, "collect", lambda *rest: pytest.fail("collected"))
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    assert "name another folder in MINARI_DATASETS_PATH" in one_line(capsys, "--demos", "7")


@only_long
def test_output_that_nobody_reads_any_more_is_one_line():
    """As in `--help | head -1`."""
    code = """
from experiments.common import program
raise SystemExit(program.guarded("m", [], lambda: print("much to say " * 10_000)))
"""
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, cwd=ROOT, check=False)
    os.close(writer)
    assert done.returncode == 1
    assert done.stderr == b"stopped: nobody reads the output any more\n"


def test_a_home_that_cannot_be_written_to_has_no_compilation_cache(workplace, monkeypatch):
    before = jax.config.jax_compilation_cache_dir
    (workplace / "home").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(workplace / "home"))
    monkeypatch.delenv("LEAPJAX_COMPILATION_CACHE", raising=False)
    runtime.use_compilation_cache()
    assert jax.config.jax_compilation_cache_dir == before


def test_a_link_to_no_folder_of_checkpoints(workplace):
    (workplace / "checkpoints").symlink_to(workplace / "nowhere")
    with pytest.raises(UserError, match="cannot write to"):
        Checkpoints(workplace / "checkpoints")
    with pytest.raises(UserError, match="no checkpoint"):
        checkpoints.restore_params(workplace / "checkpoints", small(0.0).params)


# The bot.


def test_a_bot_that_never_decides_is_a_failed_demonstration():
    """MiniGrid's bot goes round in circles on one in six of these levels."""
    level = levels.find_level("BabyAI-UnlockToUnlock-v0")
    collected = demonstrations.collect(level, 5, seed=0)
    assert len(collected.demonstrations) == 5
    assert collected.dropped[demonstrations.FAILED] > 0


def test_a_level_that_the_bot_never_solves_is_refused():
    with pytest.raises(UserError, match="101 of 101 demonstrations .* were dropped"):
        demonstrations.collect(levels.find_level("BabyAI-KeyInBox-v0"), 1000, seed=0)
