"""What a careless or hostile user does: refused in one line, before any work, and nothing lost."""

import contextlib
import dataclasses
import gc
import grp
import json
import os
import pwd
import resource
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

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
    properties,
)
from experiments.common import cases
from leapjax import checkpoints, files, pretrained
from leapjax.checkpoints import Checkpoints, states
from leapjax.configuration import make_domain, specify
from leapjax.data import storage
from leapjax.domains.babyai import demonstrations, levels
from leapjax.errors import UserError
from leapjax.running import jax_setup, plots, results, shell, startup
from leapjax.running import main as running
from leapjax.running.command_line import parse
from leapjax.types import TrainState
from tests.programs import LONG, ROOT, TOY_RUN, only_long, seal, untrained_run


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
    (babyai.main, ["--level="], "--level"),
    (babyai.main, ["--runs", "  "], "--runs"),
    (babyai.main, ["--level", "PickUpLoc", "--seeds", "0", ""], "--seeds"),
    (babyai.main, [""], "an argument"),
    (gymnasium.main, ["--dataset="], "--dataset"),
    (atari.main, ["collect", "--folder="], "--folder"),
    (properties.main, ["--only", ""], "--only"),
    (accuracy.main, ["runs/a", ""], "an argument"),
    (failures.main, ["--gallery", "", "runs/a"], "--gallery"),
    (atari_energy.main, ["--checkpoint", ""], "--checkpoint"),
    (everything.main, ["babyai", "--level="], "--level"),
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
    shell.check_values(["--arguments", '{"a": ""}', "--runs==", "--runs", "=", "--runs=a=", "-x"])
    with pytest.raises(UserError, match="--level is empty"):
        parse("babyai", ["--level", ""])


# Checkpoints.


@pytest.mark.parametrize("name", ["a\\b", "run[1]", "gs:/c", "\udc80"])
def test_a_folder_in_which_checkpoints_would_be_lost(name, workplace):
    for use in (Checkpoints, lambda folder: checkpoints.restore_params(folder, {})):
        with pytest.raises(UserError, match="cannot hold checkpoints"):
            use(workplace / name)
    assert list(workplace.iterdir()) == []
    (workplace / "file").write_text("")
    (workplace / "link").symlink_to(workplace / "nowhere")
    for folder in ("file", "link"):
        with pytest.raises(UserError, match="cannot write to"):
            Checkpoints(workplace / folder)


ODD = [
    "a b", " a ", "a#b", "a%41b", "ü日本", "a\nb", "~a", "a.", "...", "a:b", "-a", "a'b\"c",
    "$HOME", "{a}", "7", "1.orbax-checkpoint-tmp", "x" * 255,
]  # fmt: skip


@pytest.mark.parametrize("name", ODD if LONG else ["a #%41ü\n:.{7}'$HOME"])
def test_an_odd_name_holds_checkpoints(name, workplace):
    saved = Checkpoints(workplace / name)
    saved.save(small(3.0))
    saved.close()
    again = Checkpoints(workplace / name)
    restored = again.restore(small(0.0), skipped=pytest.fail)
    again.close()
    np.testing.assert_array_equal(restored.params["w"], 3.0)
    found = checkpoints.restore_params(workplace / name, small(0.0).params)
    np.testing.assert_array_equal(found["w"], 3.0)


def test_a_checkpoint_that_is_written_somewhere_else(workplace, monkeypatch):
    """Whatever the reason: it is found out after the first, not by the next start."""
    monkeypatch.setattr(states, "check_path", lambda folder: None)
    saved = Checkpoints(workplace / "a\\b")
    saved.save(small(1.0))
    with pytest.raises(UserError, match="was written, but is not found in"):
        saved.save(small(2.0)._replace(step=jnp.int32(2)))
    saved.close()


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


def edit(folder, change):
    """Changes the values of a specification."""
    values = json.loads((folder / "specification.json").read_text())
    change(values)
    (folder / "specification.json").write_text(json.dumps(values))


OTHER, TOO_SMALL = "another configuration", "must be at least"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda values: values["model"].update(heads=1), OTHER),
        (lambda values: values["domain_settings"].update(sweeps=7), OTHER),
        (lambda values: values["planner"].update(temperature=0.25), OTHER),
        (lambda values: values["origin"].update(seed=5), OTHER),
        (lambda values: values["domain_settings"].update(sweeps=0), TOO_SMALL),
        (lambda values: values.update(context=-1), TOO_SMALL),
        (lambda values: values["planner"].update(horizon=0), TOO_SMALL),
        # What is its default may be left out, as old ones do.
        (lambda values: values["domain_settings"].pop("radius"), None),
    ],
)
def test_a_specification_that_was_edited(toy_run, workplace, change, message):
    copy = workplace / "copy"
    shutil.copytree(toy_run, copy)
    edit(copy, change)
    if message is None:
        assert leap.load(copy).specification == leap.load(toy_run).specification
        return
    with pytest.raises(UserError, match=message):
        leap.load(copy)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda values: values["model"].update(layers=150), "of at most 900 numbers were saved"),
        (lambda values: values["model"].update(width=2**30), "of at most 900 numbers were saved"),
        (lambda values: values.update(context=2**31 - 1), "cannot be built"),
    ],
)
def test_a_specification_of_a_network_that_nothing_can_build(
    workplace, monkeypatch, change, message
):
    """With parameters of another network: the seal is compared first. With its own: the sizes."""
    folder = untrained_run(workplace / "run")
    edit(folder, change)
    with monkeypatch.context() as patch:
        patch.setattr(pretrained, "make_domain", lambda *given: pytest.fail("built"))
        with pytest.raises(UserError, match=OTHER):
            leap.load(folder)
    seal(folder)
    with pytest.raises(UserError, match=message):
        leap.load(folder)


def sealed(folder, **changes) -> Path:
    """A run of nothing, whoever made it: its specification and parameters agree."""
    (chosen,) = parse("gymnasium", ["--level", "CartPole-v1", "--method", "random"])
    made = specify(chosen, 0, make_domain(chosen))
    pretrained.save_specification(folder, dataclasses.replace(made, **changes))
    seal(folder)
    return folder


@pytest.fixture
def trap(workplace, monkeypatch):
    """A module whose import leaves a file behind."""
    (workplace / "evilmod.py").write_text(
        "import pathlib\nimport gymnasium as gym\npathlib.Path('trap').touch()\n"
        "gym.register('Evil-v0', 'gymnasium.envs.classic_control:CartPoleEnv',"
        " max_episode_steps=500)\n"
    )
    monkeypatch.syspath_prepend(workplace)
    yield workplace / "trap"
    sys.modules.pop("evilmod", None)


def test_code_that_a_checkpoint_names(workplace, trap):
    copy = sealed(workplace / "copy")
    edit(copy, lambda values: values.update(level="evilmod:Evil-v0"))
    for level in (None, "CartPole-v1"):
        with pytest.raises(UserError, match="another configuration"):
            leap.load(copy, level=level)
    whole = sealed(workplace / "whole", level="evilmod:Evil-v0")
    read = pretrained.read_specification(whole)
    for load in (
        lambda: leap.load(whole),
        lambda: leap.load(whole, level="CartPole-v1"),
        lambda: pretrained.make_domain(read),
        lambda: parse("gymnasium", ["--checkpoint", str(whole)]),
    ):
        with pytest.raises(UserError, match="would run the module evilmod: if you trust it"):
            load()
    assert not trap.exists()
    loaded = leap.load(whole, level="evilmod:Evil-v0")  # as the caller asks for
    assert loaded.specification.level == "evilmod:Evil-v0" and trap.exists()
    options = ["--checkpoint", str(whole), "--level", "evilmod:Evil-v0"]
    (asked,) = parse("gymnasium", options)
    assert asked.level == "evilmod:Evil-v0"


def test_code_that_data_name(trap, monkeypatch):
    described = storage.Described("evilmod:Evil-v0", 3)
    monkeypatch.setattr(storage, "described", lambda name: described)
    with pytest.raises(UserError, match="mine/data-v0 names the level evilmod:Evil-v0"):
        parse("gymnasium", ["--demonstrations", "mine/data-v0"])
    assert not trap.exists()


# Paths and files.


@pytest.mark.parametrize("name", ["x" * 5000, "a\0b", "folder/" + "x" * 300, 7])
def test_a_path_that_the_system_cannot_look_for(name, workplace):
    (workplace / "folder").mkdir()
    uses = [leap.load, pretrained.read_specification, pretrained.find, checkpoints.newest]
    uses += [checkpoints.check_path, Checkpoints, files.check_path]
    uses += [lambda path: checkpoints.restore_params(path, {})]
    uses += [lambda path: checkpoints.check_identity(path, "")]
    for use in uses:
        with pytest.raises(UserError, match="cannot look for|expected a path") as raised:
            use(name if not isinstance(name, str) else Path(name))
        assert len(str(raised.value)) < 200
    (workplace / "loop").symlink_to("loop")
    for nowhere in ("nothing", "loop", ""):
        with pytest.raises(UserError, match="not a checkpoint|symbolic links"):
            leap.load(nowhere)


def test_files_of_text_that_have_no_end(workplace):
    os.mkfifo(workplace / "pipe")
    (workplace / "large").write_text("x" * 101)
    for path in (workplace / "pipe", Path("/dev/zero"), workplace):
        with pytest.raises(UserError, match="not a file"):
            files.read_text(path)
    with pytest.raises(UserError, match="larger than"):
        files.read_text(workplace / "large", 100)
    assert files.read_text(workplace / "large", 101) == "x" * 101
    specification = workplace / "specification.json"
    specification.write_text(" " * pretrained.LARGEST_SPECIFICATION + "{}")
    with pytest.raises(UserError, match="larger than 1 MiB"):
        leap.load(workplace)


def test_links_that_were_planted_in_a_shared_folder(workplace):
    mine, shared = workplace / "mine", workplace / "shared"
    shared.mkdir()
    mine.write_text("precious")
    (shared / f".{os.getpid()}.row.json").symlink_to(mine)
    (shared / ".lock").symlink_to(mine)
    files.write_text(shared / "row.json", "new")
    assert files.read_text(shared / "row.json") == "new"
    with (
        pytest.raises(UserError, match="cannot write to .*shared.*symbolic links"),
        files.only_process_in(shared),
    ):
        pass
    assert mine.read_text() == "precious"


def test_a_folder_that_nobody_else_can_write_to(workplace):
    made = workplace / "a" / "b"
    files.make_private(made)
    files.make_private(made)
    assert made.stat().st_mode & 0o777 == made.parent.stat().st_mode & 0o777 == 0o700
    for folder in (made, made.parent):
        folder.chmod(0o777)
        with pytest.raises(UserError, match=f"others can write to {folder}: "):
            files.make_private(made)
        folder.chmod(0o755)
    made.parent.chmod(0o1777)  # as /tmp is
    files.make_private(made)
    made.parent.chmod(0o755)
    (workplace / "link").symlink_to(made)
    files.make_private(workplace / "link")
    made.chmod(0o777)
    with pytest.raises(UserError, match="others can write to"):
        files.make_private(workplace / "link")
    (workplace / "file").write_text("")
    with pytest.raises(UserError, match="cannot write to"):
        files.make_private(workplace / "file")


@pytest.mark.skipif(os.getuid() != 0, reason="only root gives files away")
def test_a_folder_to_which_the_group_of_its_user_can_write(workplace, monkeypatch):
    """As umask 002 makes them: the group has the user's name, not always the number."""
    made = workplace / "made"
    made.mkdir()
    os.chown(made, 0, 4321)
    made.chmod(0o775)
    mine = pwd.getpwuid(0).pw_name
    for name, members, private in (
        (mine, [], True), (mine, [mine], True), (mine, ["other"], False), ("users", [], False),
    ):  # fmt: skip
        group = SimpleNamespace(gr_name=name, gr_mem=members)
        monkeypatch.setattr(grp, "getgrgid", lambda number, group=group: group)
        with contextlib.nullcontext() if private else pytest.raises(UserError, match="others can"):
            files.make_private(made)
    monkeypatch.undo()
    with pytest.raises(UserError, match="others can write"):  # a group that has no name
        files.make_private(made)
    os.chown(made, 1234, -1)
    with pytest.raises(UserError, match=f"{made} belongs to another user"):
        files.make_private(made)


# Before any work.


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--runs", "C:\\Users\\me\\My Runs"], "/C:/Users/me/My Runs"),
        (["--runs", "run[1]"], "takes it for a pattern, with '*', '?' or '['"),
        (["--runs", "file"], "cannot write to"),
        (["--runs", "rows"], "babyai.jsonl, line 1"),
        (["--runs", "file", "--record"], "cannot write to"),
        (["--seeds", "1", "0", "1"], "--seeds names 1 twice: both would be one run"),
        (["--iterations", "1000000000"], "GiB of memory would be needed"),
        (["--batch", "100000000"], "GiB of memory would be needed"),
        (["--width", "200000"], "GiB of memory would be needed"),
        (["--temperature", "1e39"], "temperature must be"),
    ],
)
@pytest.mark.parametrize("trained", [False, True])
def test_where_a_run_is_impossible_nothing_is_done(
    toy_run, workplace, capsys, monkeypatch, arguments, message, trained
):
    (workplace / "file").write_text("")
    (workplace / "rows").mkdir()
    (workplace / "rows" / "babyai.jsonl").write_text('{"successes": NaN}\n')
    for name in ("load_demonstrations", "load_trained", "evaluate"):
        monkeypatch.setattr(running, name, lambda *given: pytest.fail("work was done"))
    if trained and "--runs" in arguments:
        arguments = [*arguments, "--checkpoint", toy_run]
    assert message in one_line(capsys, *arguments)


def test_an_analysis_that_cannot_be_written(workplace, capsys, monkeypatch):
    monkeypatch.setattr(cases, "load_demonstrations", lambda run: pytest.fail("work was done"))
    (workplace / "file").write_text("")
    assert properties.main(["--runs", "file/runs"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: cannot") and said.count("\n") == 1


def test_a_folder_of_data_sets_that_cannot_be_written_to(capsys, monkeypatch):
    monkeypatch.setattr(demonstrations, "collect", lambda *rest: pytest.fail("collected"))
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    assert "name another folder in MINARI_DATASETS_PATH" in one_line(capsys, "--demos", "7")


# Rows.


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

    monkeypatch.setattr(running, "finish", run_one)
    assert babyai.main(["--level", "all", "--seeds", "0", "1", "--no-pictures"]) == 2
    assert played == [(level, seed) for level in levels.LEVELS for seed in (0, 1)]
    said = capsys.readouterr()
    assert said.err == "error: something is wrong with it\n"
    assert "GoToLocalS8N7, seed 1, failed" in said.out and "GoToSeqS5R2" in said.out


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


# The machine.


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("jax_enable_x64", True),
        ("jax_default_prng_impl", "rbg"),
        ("jax_threefry_partitionable", False),
        ("jax_default_matmul_precision", "bfloat16"),
        ("jax_disable_jit", True),
        ("jax_no_execution", True),
        ("jax_numpy_dtype_promotion", "strict"),
        ("jax_debug_infs", True),
        ("jax_default_device", "cpu"),
        ("jax_transfer_guard_host_to_device", "disallow"),
    ],
)
def test_a_setting_of_jax_that_breaks_a_promise(setting, value, monkeypatch):
    monkeypatch.setattr(jax_setup, "connect", lambda cluster: pytest.fail("went on"))
    before = getattr(jax.config, setting)
    jax.config.update(setting, value)
    try:
        with pytest.raises(UserError, match=f"{setting} is .*unset {setting.upper()}, or use"):
            jax_setup.start()
    finally:
        jax.config.update(setting, before)


def test_settings_of_jax_that_break_nothing(monkeypatch):
    monkeypatch.setenv("LEAPJAX_COMPILATION_CACHE", "off")
    with jax.debug_nans(True), jax.numpy_rank_promotion("warn"), jax.log_compiles(True):
        jax_setup.start()


@pytest.mark.parametrize("count", [0, -2, 10**6])
def test_a_number_of_devices_that_cannot_be_made(count, monkeypatch):
    monkeypatch.setattr(
        jax_setup, "jax", SimpleNamespace(config=SimpleNamespace(jax_num_cpu_devices=count))
    )
    with pytest.raises(UserError, match=f"JAX_NUM_CPU_DEVICES is {count}: expected a number in 1"):
        jax_setup.use_every_core()


def test_no_device_is_one_line(monkeypatch):
    def fail():
        raise AssertionError  # as JAX does where JAX_PLATFORMS is cuda and no plugin is installed

    monkeypatch.setattr(jax_setup.jax, "devices", fail)
    monkeypatch.setenv("JAX_PLATFORMS", "cuda")
    with pytest.raises(
        UserError, match=r"no device with .*JAX_PLATFORMS=cuda.* \(AssertionError\)"
    ):
        jax_setup.check_devices()


@only_long
@pytest.mark.parametrize(
    ("setting", "value"),
    [("JAX_NUM_CPU_DEVICES", "abc"), ("JAX_ENABLE_X64", "maybe"), ("JAX_DEFAULT_DEVICE", "cuda")],
)
@pytest.mark.parametrize("program", ["experiments", "experiments.stars", "benchmarks.planning"])
def test_a_setting_that_jax_refuses_is_one_line(program, setting, value):
    done = subprocess.run(
        [sys.executable, "-m", program, "--help"], capture_output=True, text=True, cwd=ROOT,
        env={**os.environ, setting: value}, check=False,
    )  # fmt: skip
    (line,) = done.stderr.splitlines()
    assert done.returncode == 2 and line.startswith("error: cannot import JAX with ")
    assert f"{setting}={value}" in line


@only_long
def test_a_terminal_of_ascii_shows_what_it_can():
    done = subprocess.run(
        [sys.executable, "-m", "experiments.stars", "--level", "St\u00e4r \u00b1"],
        capture_output=True, cwd=ROOT, env={**os.environ, "PYTHONIOENCODING": "ascii"},
        check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert done.stderr.startswith(b"error: unknown level 'St?r ?': expected")


@pytest.mark.parametrize("count", ["", " ", "many"])
def test_a_launcher_that_says_nothing(count, monkeypatch):
    monkeypatch.setenv("OMPI_COMM_WORLD_SIZE", count)
    monkeypatch.setattr(
        jax_setup.jax.distributed, "initialize", lambda *rest, **more: pytest.fail("joined")
    )
    jax_setup.connect(jax_setup.Cluster())


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


@only_long
def test_a_disk_that_fills_while_a_checkpoint_is_written(workplace, capfd, caplog, monkeypatch):
    """One line says so; the threads of Orbax, asyncio and TensorStore say nothing."""
    monkeypatch.setattr(sys, "unraisablehook", startup.print_unraisable)
    saved = Checkpoints(workplace / "a")
    saved.save(small(1.0))
    arrays = {str(i): jax.random.normal(jax.random.key(i), (200, 200)) for i in range(8)}
    state = TrainState(arrays, (), jnp.int32(2))
    _, most = resource.getrlimit(resource.RLIMIT_FSIZE)
    with pytest.raises(UserError, match=r"cannot write a checkpoint to .*/a \(File too large\)"):
        saved.close()  # the first
        saved = Checkpoints(workplace / "a")
        resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, most))
        try:
            saved.save(state)
            saved.close()
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))
    gc.collect()
    said = capfd.readouterr()
    assert (said.out, said.err, caplog.text) == ("", "", "")
    found = checkpoints.restore_params(workplace / "a", small(0.0).params)
    np.testing.assert_array_equal(found["w"], 1.0)


# The bot.


def test_a_bot_that_never_decides_is_a_failed_demonstration():
    """MiniGrid's bot goes round in circles on one in six of these levels."""
    level = levels.find_level("BabyAI-UnlockToUnlock-v0")
    collected = demonstrations.collect(level, 5, seed=0)
    assert len(collected.demonstrations) == 5
    assert collected.dropped[demonstrations.FAILED] > 0


@only_long
def test_a_level_that_the_bot_never_solves_is_refused():
    with pytest.raises(UserError, match="101 of 101 demonstrations .* were dropped"):
        demonstrations.collect(levels.find_level("BabyAI-KeyInBox-v0"), 1000, seed=0)


def test_a_working_folder_that_was_removed_is_one_line(capsys):
    def work():
        raise FileNotFoundError(2, "No such file or directory")  # as `Path.cwd` does there

    assert shell.guarded("experiments.babyai", [], work) == 2
    assert capsys.readouterr().err == "error: No such file or directory: the working folder\n"
