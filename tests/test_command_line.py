"""The command line, as a new user meets it."""

import importlib
import os
import re
import sys
from pathlib import Path

import pytest

import experiments.__main__ as programs
import leapjax
import leapjax.__main__
from experiments import atari, babyai, gymnasium
from leapjax import scores
from leapjax.errors import UserError
from leapjax.methods import METHODS
from leapjax.running import command_line, results, startup
from tests.programs import run_python, toy_row


@pytest.mark.parametrize("command", ["leapjax", "experiments babyai", "experiments.babyai"])
def test_the_version_needs_no_jax(command):
    """-S hides all installed packages, and with them the version."""
    completed = run_python("-S", "-m", *command.split(), "--version")
    assert (completed.returncode, completed.stderr) == (0, "")
    assert completed.stdout in ("leapjax 0+unknown\n", f"leapjax {leapjax.__version__}\n")


@pytest.mark.parametrize(
    ("main", "started", "command"),
    [
        (leapjax.__main__.main, "/env/bin/leapjax", "leapjax babyai"),
        (leapjax.__main__.main, "/site/leapjax/__main__.py", "python -m leapjax babyai"),
        (programs.main, "/site/experiments/__main__.py", "python -m experiments babyai"),
        (programs.main, "/site/experiments/babyai.py", "python -m experiments.babyai"),
    ],
)
def test_usage_lines_say_how_a_program_was_started(main, started, command, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [started])
    monkeypatch.setattr(sys, "path", list(sys.path))
    for arguments, code in (["--help"], 0), (["--nothing"], 2):
        with pytest.raises(SystemExit, match=str(code)):
            main(["babyai", *arguments])
    printed = capsys.readouterr()
    assert printed.out.startswith(f"usage: {command} [-h]") and f"{command} --help" in printed.err


def test_a_closed_output_pipe_ends_a_program_quietly():
    reader, writer = os.pipe()
    os.close(reader)
    completed = run_python("-m", "experiments", "--help", stdout=writer)
    os.close(writer)
    assert (completed.returncode, completed.stderr) == (startup.UNREAD, "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="Linux has a device that is full")
def test_an_output_that_cannot_be_written_ends_a_program_with_one_line():
    with Path("/dev/full").open("w") as full:
        completed = run_python("-m", "experiments", "--help", stdout=full)
    expected = "error: cannot write the output: No space left on device\n"
    assert (completed.returncode, completed.stderr) == (1, expected)


def read_help(main, arguments, capsys, monkeypatch):
    """Returns the help text of each option of a program, without the default."""
    monkeypatch.setenv("COLUMNS", "1000")
    with pytest.raises(SystemExit, match="0"):
        main([*arguments, "--help"])
    printed = re.sub("[│]", "", capsys.readouterr().out)
    found = re.findall(r"^ *(--\w\S*|\[?RUNS)[^\n]*?(?:  +|\n +)(\w.*)$", printed, re.MULTILINE)
    return {option: re.sub(r" ?\((default: .*|required)\) *$", "", body) for option, body in found}


@pytest.mark.parametrize(
    "command",
    [*programs.PROGRAMS, "atari collect", *(f"babyai --method {m}" for m in METHODS)],
)
def test_every_option_is_explained_in_whole_sentences(command, capsys, monkeypatch):
    name, *arguments = command.split()
    main = importlib.import_module(f"experiments.{name}").main
    found = read_help(main, arguments, capsys, monkeypatch)
    assert found
    for option, printed in found.items():
        assert re.fullmatch(r"[A-Z0-9].*[.)\]] *", printed), f"{option}: {printed}"


@pytest.mark.parametrize(
    ("main", "own", "not_own"),
    [
        (gymnasium.main, {"--env", "--dataset"}, {"--level", "--demonstrations", "--game"}),
        (atari.main, {"--game", "--demonstrations"}, {"--level", "--env", "--dataset"}),
        (babyai.main, {"--level", "--demonstrations"}, {"--env", "--dataset", "--game"}),
    ],
)
def test_programs_show_only_options_of_their_own_domain(main, own, not_own, capsys, monkeypatch):
    found = read_help(main, [], capsys, monkeypatch)
    assert own <= set(found) and not not_own & set(found)
    assert not [printed for printed in found.values() if any(name in printed for name in not_own)]


def test_a_command_line_may_name_several_methods():
    def methods(*names):
        return [each.method for each in command_line.parse("babyai", ["--method", *names])]

    assert methods("leap", "bc", "dt", "bc") == ["leap", "bc", "dt"]
    assert methods("all") == [name for name in METHODS if METHODS[name].everywhere]
    chosen = command_line.parse("babyai", ["--method", "bc", "random", "--steps", "5"])
    assert [each.training.steps for each in chosen] == [5, 0]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--method bc dtt", "unknown method 'dtt'"),
        ("--method", "--method needs a name"),
        ("--method bc dt --pretrained", "--method bc dt: .* is of one method"),
    ],
)
def test_invalid_methods_raise_an_error(arguments, message):
    with pytest.raises(UserError, match=message):
        command_line.parse("babyai", arguments.split())


def make_row(seed, method="bc", successes=5, **more):
    body = {"seed": seed, "method": method, "hash": f"{seed}{method}"}
    return toy_row(**body, episodes=10, successes=successes, success=successes / 10, **more)


def test_tables_end_with_the_mean_over_seeds():
    other = {"planner": {"iterations": 3}}
    rows = [
        make_row(0),
        make_row(1, successes=7),
        make_row(0, "dt"),
        make_row(1, "dt"),
        make_row(2, "dt", configuration=other),
    ]
    table = results.make_success_table(rows)
    columns = {column.header: list(column.cells) for column in table.columns}
    assert columns["seed"] == ["0", "1", "0", "1", "2", "mean of 2", "mean of 2"]
    low, high = scores.interval_over_seeds([5, 7], [10, 10])
    assert columns["success [95%]"][-2] == f"60.0% [{low:.1%}, {high:.1%}]"


def test_searches_of_one_seed_are_told_apart_and_not_averaged():
    planners = [{"iterations": 5, "fill": "confident"}]
    planners += [{**planners[0], "certainty": 0.9}, {**planners[0], "restarts": 16}]
    rows = [make_row(0, configuration={"planner": each, "seed": 0}) for each in planners]
    table = results.make_success_table(rows)
    columns = {column.header: list(column.cells) for column in table.columns}
    assert columns["seed"] == ["0", "0", "0"]
    common = "N = 5, confident"
    assert columns["planner"] == [common, f"{common}, certainty 0.9", f"{common}, restarts 16"]
