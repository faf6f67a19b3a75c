"""Careless or hostile use raises a one-line error before any work, and loses no files."""

import dataclasses
import gc
import grp
import json
import os
import pwd
import re
import resource
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from minigrid.utils.baby_ai_bot import Subgoal

import experiments.__main__ as all_experiments
import leapjax as leap
from experiments import accuracy, babyai, gymnasium
from leapjax import checkpoints, files, pretrained
from leapjax.checkpoints import Checkpoints, states
from leapjax.checkpoints.paths import find_newest
from leapjax.configuration import make_domain, specify
from leapjax.data import storage
from leapjax.domains.babyai import bot, levels
from leapjax.domains.babyai.adapter import BabyAIAdapter
from leapjax.errors import UserError
from leapjax.running import jax_setup, startup
from leapjax.running import main as running
from leapjax.running.command_line import parse
from leapjax.types import TrainState
from tests.programs import TOY_RUN, damage, only_long, run_python, seal, toy_row, untrained_run

OTHER = "another configuration"


@pytest.fixture(autouse=True)
def workplace(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def get_error_line(capsys, *arguments) -> str:
    """Runs a command that must fail; returns its line of error."""
    assert babyai.main([*TOY_RUN, *map(str, arguments)]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and error.count("\n") == 1
    return error


@pytest.mark.parametrize(
    ("main", "arguments", "option"),
    [
        (babyai.main, ["--level", ""], "--level"),
        (babyai.main, ["--runs", "  "], "--runs"),
        (babyai.main, ["--level", "PickUpLoc", "--seeds", "0", ""], "--seeds"),
        (babyai.main, [""], "an argument"),
        (gymnasium.main, ["--dataset="], "--dataset"),
        (accuracy.main, ["runs/a", ""], "an argument"),
        (all_experiments.main, ["babyai", "--level="], "--level"),
    ],
)
def test_empty_values_from_unset_variables_are_errors(workplace, capsys, main, arguments, option):
    with pytest.raises(SystemExit, match="2"):
        main(arguments)
    printed = capsys.readouterr().err
    assert printed == f"error: {option} is empty: give it a value, or leave it out\n"
    assert not list(workplace.iterdir())


# Checkpoints.


def make_state(value: float, step=1) -> TrainState:
    return TrainState({"w": jnp.full(3, value)}, (), jnp.int32(step))


def save(folder, *values, **options):
    saved = Checkpoints(folder, **options)
    for step, value in enumerate(values, 1):
        saved.save(make_state(value, step))
    saved.close()


def check_params(folder, value, *identity):
    found, _ = checkpoints.restore_params(folder, make_state(0.0).params, *identity)
    np.testing.assert_array_equal(found["w"], value)


@pytest.mark.parametrize("name", ["a\\b", "run[1]", "gs:/c", "\udc80"])
def test_unsafe_folders_cannot_hold_checkpoints(name, workplace):
    for use in (Checkpoints, lambda folder: checkpoints.restore_params(folder, {})):
        with pytest.raises(UserError, match="cannot hold checkpoints"):
            use(workplace / name)


@pytest.mark.parametrize("name", ["a #%41ü\n:.{7}'$HOME", "1.orbax-checkpoint-tmp", "x" * 255])
def test_odd_folder_names_can_hold_checkpoints(name, workplace):
    save(workplace / name, 3.0)
    again = Checkpoints(workplace / name)
    restored = again.restore(make_state(0.0), skipped=pytest.fail)
    again.close()
    np.testing.assert_array_equal(restored.params["w"], 3.0)
    check_params(workplace / name, 3.0)


def test_checkpoint_written_elsewhere_raises_an_error(workplace, monkeypatch):
    """The next save notices it, whatever the cause; otherwise the next start would."""
    monkeypatch.setattr(states, "check_path", lambda folder: None)
    saved = Checkpoints(workplace / "a\\b")
    saved.save(make_state(1.0))
    with pytest.raises(UserError, match="was written, but is not found in"):
        saved.save(make_state(2.0, 2))
    saved.close()


def test_checkpoint_of_another_configuration_raises_an_error(workplace):
    save(workplace / "a", 1.0, identity="mine")
    for identity in ("yours", ""):
        with pytest.raises(UserError, match=OTHER):
            checkpoints.restore_params(workplace / "a", make_state(0.0).params, identity)
        other = Checkpoints(workplace / "a", identity)
        with pytest.raises(UserError, match=OTHER):
            other.restore(make_state(0.0))
        other.close()
    assert (workplace / "a" / "1").is_dir()  # intact, so not set aside as damaged
    check_params(workplace / "a", 1.0, "mine")


def edit_specification(folder, change):
    values = json.loads((folder / "specification.json").read_text())
    change(values)
    (folder / "specification.json").write_text(json.dumps(values))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda values: values["model"].update(heads=1), OTHER),
        (lambda values: values["domain_settings"].update(sweeps=7), OTHER),
        (lambda values: values["origin"].update(seed=5), OTHER),
        (lambda values: values["planner"].update(horizon=0), "must be at least"),
        (lambda values: values["model"].update(width=2**30), OTHER),
    ],
)
def test_edited_specification_fails_before_building(workplace, monkeypatch, change, message):
    folder = untrained_run(workplace / "run")
    edit_specification(folder, change)
    monkeypatch.setattr(pretrained, "make_domain", lambda *given: pytest.fail("built"))
    with pytest.raises(UserError, match=message):
        leap.load(folder)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda values: values["model"].update(width=2**30), "of at most 900 numbers were saved"),
        (lambda values: values.update(context=2**31 - 1), "cannot be built"),
    ],
)
def test_sealed_network_of_impossible_size_raises_an_error(workplace, change, message):
    folder = untrained_run(workplace / "run")
    edit_specification(folder, change)
    seal(folder)
    with pytest.raises(UserError, match=message):
        leap.load(folder)


def test_specification_may_omit_defaults(workplace):
    folder = untrained_run(workplace / "run")
    before = leap.load(folder).specification
    edit_specification(folder, lambda values: values["domain_settings"].pop("radius"))
    assert leap.load(folder).specification == before


def make_sealed_run(folder, **changes) -> Path:
    """Makes an untrained run with matching specification and parameters, as anyone can."""
    (chosen,) = parse("gymnasium", ["--level", "CartPole-v1", "--method", "random"])
    made = specify(chosen, 0, make_domain(chosen))
    pretrained.save_specification(folder, dataclasses.replace(made, **changes))
    seal(folder)
    return folder


@pytest.fixture
def trap(workplace, monkeypatch):
    """The file that a hostile module creates when it is imported."""
    (workplace / "evilmod.py").write_text(
        "import pathlib\nimport gymnasium as gym\npathlib.Path('trap').touch()\n"
        "gym.register('Evil-v0', 'gymnasium.envs.classic_control:CartPoleEnv',"
        " max_episode_steps=500)\n"
    )
    monkeypatch.syspath_prepend(workplace)
    yield workplace / "trap"
    sys.modules.pop("evilmod", None)


def test_module_of_a_checkpoint_runs_only_if_the_caller_names_it(workplace, trap):
    edited = make_sealed_run(workplace / "edited")
    edit_specification(edited, lambda values: values.update(level="evilmod:Evil-v0"))
    with pytest.raises(UserError, match=OTHER):
        leap.load(edited)
    whole = make_sealed_run(workplace / "whole", level="evilmod:Evil-v0")
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
    loaded = leap.load(whole, level="evilmod:Evil-v0")
    assert loaded.specification.level == "evilmod:Evil-v0" and trap.exists()
    (parsed,) = parse("gymnasium", ["--checkpoint", str(whole), "--level", "evilmod:Evil-v0"])
    assert parsed.level == "evilmod:Evil-v0"


def test_module_of_a_data_set_does_not_run(trap, monkeypatch):
    described = storage.Described("evilmod:Evil-v0", 3)
    monkeypatch.setattr(storage, "describe_dataset", lambda name: described)
    with pytest.raises(UserError, match="mine/data-v0 names the level evilmod:Evil-v0"):
        parse("gymnasium", ["--demonstrations", "mine/data-v0"])
    assert not trap.exists()


# Paths and files.


@pytest.mark.parametrize("name", ["x" * 5000, "a\0b", "folder/" + "x" * 300, 7])
def test_impossible_path_raises_a_short_error(name, workplace):
    (workplace / "folder").mkdir()
    for use in (leap.load, find_newest, Checkpoints, files.check_path):
        with pytest.raises(UserError, match="cannot look for|expected a path") as raised:
            use(name if not isinstance(name, str) else Path(name))
        assert len(str(raised.value)) < 200


def test_missing_checkpoint_raises_an_error(workplace):
    (workplace / "loop").symlink_to("loop")
    for nowhere in ("nothing", "loop", ""):
        with pytest.raises(UserError, match="there is no folder|not a checkpoint|symbolic links"):
            leap.load(nowhere)


def test_endless_and_huge_text_files_raise_an_error(workplace):
    os.mkfifo(workplace / "pipe")
    for path in (workplace / "pipe", Path("/dev/zero"), workplace):
        with pytest.raises(UserError, match="not a file"):
            files.read_text(path)
    specification = workplace / "specification.json"
    specification.write_text(" " * pretrained.LARGEST_SPECIFICATION + "{}")
    with pytest.raises(UserError, match="larger than 1 MiB"):
        leap.load(workplace)


def test_planted_links_do_not_redirect_writes(workplace):
    mine, shared = workplace / "mine", workplace / "shared"
    shared.mkdir()
    mine.write_text("precious")
    (shared / f".{os.getpid()}.row.json").symlink_to(mine)
    (shared / ".lock").symlink_to(mine)
    files.write_text(shared / "row.json", "new")
    assert files.read_text(shared / "row.json") == "new"
    expect_error = pytest.raises(UserError, match="cannot write to .*shared.*symbolic links")
    with expect_error, files.lock_folder(shared):
        pass
    assert mine.read_text() == "precious"


def test_folder_that_others_can_write_to_raises_an_error(workplace):
    made = workplace / "a" / "b"
    files.make_private(made)
    assert made.stat().st_mode & 0o777 == made.parent.stat().st_mode & 0o777 == 0o700
    (workplace / "link").symlink_to(made)
    assert files.make_private(workplace / "link") == made.resolve()  # others may change the link
    for folder in (made, made.parent):
        folder.chmod(0o777)
        with pytest.raises(UserError, match="others can write to"):
            files.make_private(workplace / "link")
        folder.chmod(0o755)
    made.parent.chmod(0o1777)  # like /tmp
    files.make_private(made)


@pytest.mark.skipif(os.getuid() != 0, reason="only root gives files away")
def test_private_folder_may_be_writable_for_the_users_own_group(workplace, monkeypatch):
    """Umask 002 makes such folders: the group has the user's name, not always the number."""
    made, mine = workplace / "made", pwd.getpwuid(0).pw_name
    made.mkdir()
    os.chown(made, 0, 4321)
    made.chmod(0o775)
    group = SimpleNamespace(gr_name=mine, gr_mem=[mine])
    monkeypatch.setattr(grp, "getgrgid", lambda number: group)
    files.make_private(made)
    group.gr_mem = ["other"]
    with pytest.raises(UserError, match="others can write"):
        files.make_private(made)
    os.chown(made, 1234, -1)
    with pytest.raises(UserError, match=f"{made} belongs to another user"):
        files.make_private(made)


# Errors before any work.


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--runs", "C:\\Users\\me\\My Runs"], "/C:/Users/me/My Runs"),
        (["--runs", "run[1]"], "takes it for a pattern, with '*', '?' or '['"),
        (["--runs", "file"], "cannot write to"),
        (["--runs", "file", "--record"], "cannot write to"),
        (["--runs", "file", "--checkpoint", "RUN"], "cannot write to"),
        (["--runs", "rows"], "babyai.jsonl, line 1"),
        (["--seeds", "1", "0", "1"], "--seeds names 1 twice: both would be one run"),
        (["--batch", "100000000"], "GiB of memory would be needed"),
        (["--width", "200000"], "GiB of memory would be needed"),
    ],
)
def test_impossible_runs_stop_before_any_work(
    toy_run, workplace, capsys, monkeypatch, arguments, message
):
    (workplace / "file").write_text("")
    (workplace / "rows").mkdir()
    (workplace / "rows" / "babyai.jsonl").write_text('{"successes": NaN}\n')
    for name in ("load_demonstrations", "load_trained", "evaluate"):
        monkeypatch.setattr(running, name, lambda *given: pytest.fail("work was done"))
    given = [toy_run if each == "RUN" else each for each in arguments]
    assert message in get_error_line(capsys, *given)


def test_failing_level_does_not_stop_the_others(capsys, monkeypatch):
    played = []

    def run_one(which, config, seed, *rest):
        played.append((config.level, seed))
        if config.level == "GoToLocalS8N7":
            raise UserError("something is wrong with it")
        return toy_row(level=config.level)

    monkeypatch.setattr(running, "finish", run_one)
    assert babyai.main(["--level", "all", "--seeds", "0", "1", "--no-pictures"]) == 2
    assert played == [(level, seed) for level in levels.LEVELS for seed in (0, 1)]
    printed = capsys.readouterr()
    assert printed.err == "error: something is wrong with it\n"
    assert "GoToLocalS8N7, seed 1, failed" in printed.out and "GoToSeqS5R2" in printed.out


def test_unfinished_run_is_neither_recorded_nor_published(toy_run, workplace, capsys):
    stopped = workplace / "stopped"
    shutil.copytree(toy_run, stopped)
    (stopped / "checkpoints" / "4").rename(stopped / "checkpoints" / "3")
    printed = "ends at step 3 of 4: start the run's command again"
    assert printed in get_error_line(capsys, "--checkpoint", stopped, "--record")
    assert not list(workplace.rglob("*.jsonl"))
    with pytest.raises(UserError, match=printed):
        pretrained.publish(stopped, workplace / "published")
    with pytest.warns(UserWarning, match="ends at step 3 of 4"):
        leap.load(stopped).save(workplace / "copied")
    with pytest.raises(UserError, match=printed):
        pretrained.publish(workplace / "copied", workplace / "published")


def test_a_run_whose_last_checkpoint_is_damaged_is_not_finished(toy_run, workplace):
    stopped = workplace / "stopped"
    shutil.copytree(toy_run, stopped)
    last = stopped / "checkpoints" / "4"
    shutil.copytree(last, last.parent / "3")
    damage(last)
    with pytest.warns(UserWarning) as warned:
        planner = leap.load(stopped)
    messages = "\n".join(str(each.message) for each in warned)
    assert "using step 3" in messages and "ends at step 3 of 4" in messages and planner.step == 3
    planner.save(workplace / "copied")
    with pytest.raises(UserError, match="ends at step 3 of 4"):
        pretrained.publish(workplace / "copied", workplace / "published")


# The machine.


@pytest.mark.parametrize(
    ("setting", "value"), [("enable_x64", True), ("default_prng_impl", "rbg"),
                           ("numpy_dtype_promotion", "strict")],
)  # fmt: skip
def test_unsupported_jax_settings_raise_an_error(setting, value, monkeypatch):
    monkeypatch.setattr(jax_setup, "connect", lambda cluster: pytest.fail("went on"))
    name = f"jax_{setting}"
    with getattr(jax, setting)(value), pytest.raises(UserError, match=f"{name} is .*unset"):
        jax_setup.start()


def test_missing_device_raises_a_one_line_error(monkeypatch):
    def fail():
        raise AssertionError  # as JAX does if JAX_PLATFORMS is cuda without a plugin

    monkeypatch.setattr(jax_setup.jax, "devices", fail)
    monkeypatch.setenv("JAX_PLATFORMS", "cuda")
    with pytest.raises(UserError, match=r"no device.*JAX_PLATFORMS=cuda.* \(AssertionError\)"):
        jax_setup.check_devices()


@only_long
@pytest.mark.parametrize(
    ("variable", "value", "pattern"),
    [
        ("JAX_NUM_CPU_DEVICES", "abc", "error: cannot import JAX with .*JAX_NUM_CPU_DEVICES=abc"),
        ("PYTHONIOENCODING", "ascii", r"error: unknown level 'St\?r \?': expected"),
    ],
)
def test_odd_environment_variables_print_a_one_line_error(variable, value, pattern):
    done = run_python("-m", "experiments.stars", "--level", "St\u00e4r \u00b1", **{variable: value})
    (line,) = done.stderr.splitlines()
    assert done.returncode == 2
    assert re.match(pattern, line)


def test_writing_flushes_the_file_and_then_its_folder(workplace, monkeypatch):
    """The file is flushed before it gets its name, the folder after."""
    flushed = []
    monkeypatch.setattr(
        os, "fsync", lambda number: flushed.append(Path(f"/proc/self/fd/{number}").readlink())
    )
    files.write_text(workplace / "row.json", "new")
    assert [flushed[0].parent, flushed[1]] == [workplace, workplace]
    assert flushed[0].name != "row.json"


def test_full_disk_raises_an_error_before_writing(workplace, monkeypatch):
    saved = Checkpoints(workplace / "a")
    monkeypatch.setattr(files, "SPARE", 2**60)
    with pytest.raises(UserError, match="MiB are free in .* may be needed"):
        saved.save(make_state(1.0))
    saved.close()
    assert list((workplace / "a").iterdir()) == []


def test_filling_disk_raises_an_error_and_keeps_older_files(workplace, capfd, caplog, monkeypatch):
    """The threads of Orbax, asyncio and TensorStore print no text."""
    monkeypatch.setattr(sys, "unraisablehook", startup.print_unraisable)
    row = workplace / "row.json"
    files.write_text(row, "old")
    save(workplace / "a", 1.0)
    arrays = {str(i): jax.random.normal(jax.random.key(i), (200, 200)) for i in range(8)}
    saved = Checkpoints(workplace / "a")
    _, most = resource.getrlimit(resource.RLIMIT_FSIZE)
    with pytest.raises(UserError, match=r"cannot write a checkpoint to .*/a \(File too large\)"):
        # This limit on file sizes acts like a full disk, for this process alone.
        resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, most))
        try:
            with pytest.raises(UserError, match="cannot write .*row.json"):
                files.write_text(row, "new" * 50_000)
            saved.save(TrainState(arrays, (), jnp.int32(2)))
            saved.close()
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))
    gc.collect()
    printed = capfd.readouterr()
    assert (printed.out, printed.err, caplog.text) == ("", "", "")
    assert {path.name for path in workplace.iterdir()} == {"a", "row.json"}
    assert row.read_text() == "old"
    check_params(workplace / "a", 1.0)


def test_bot_that_never_decides_raises_an_error(monkeypatch):
    """MiniGrid's bot cycles through subgoals forever in one in six levels of UnlockToUnlock."""

    class Silent(Subgoal):
        def replan_before_action(self):
            return None

    def process(self, instruction):
        self.stack.append(Silent(self))

    monkeypatch.setattr(bot.FullViewBot, "_process_instr", process)
    adapter = BabyAIAdapter(levels.find_level("GoToLocalS7N5"))
    adapter.reset(0)
    with pytest.raises(bot.Undecided):
        bot.FullViewBot(adapter.env).replan()
