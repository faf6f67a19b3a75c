"""Result rows and measurements are checked, and recorded with the version of the code."""

import json
import math
import subprocess
import sys

import numpy as np
import pytest

from experiments.tables import measured
from leapjax.errors import UserError
from leapjax.rollouts import Episodes
from leapjax.running import results
from tests.programs import ROOT, toy_row


@pytest.fixture
def checkout(tmp_path):
    """Makes a repository with one commit of code."""
    (tmp_path / "leapjax").mkdir()
    (tmp_path / "leapjax" / "code.py").write_text("1")
    git(tmp_path, "init", "--quiet")
    commit(tmp_path)
    return tmp_path


def git(folder, *arguments):
    identity = ("-c", "user.name=a", "-c", "user.email=a@example.org")
    process = subprocess.run(
        ("git", "-C", folder, *identity, *arguments), capture_output=True, text=True, check=True
    )
    return process.stdout.strip()


def commit(folder):
    git(folder, "add", ".")
    git(folder, "commit", "--quiet", "--message", "a")
    return git(folder, "log", "-1", "--format=%h")


def test_code_version_is_the_last_commit_of_the_code(checkout):
    version = results.find_code_version(checkout)
    (checkout / "rows").write_text("new")
    commit(checkout)
    assert results.find_code_version(checkout) == version
    (checkout / "leapjax" / "code.py").write_text("2")
    assert results.find_code_version(checkout) == f"{version}.dirty"
    latest = commit(checkout)
    assert results.find_code_version(checkout) == f"+g{latest}" != version


ROW = toy_row()


def write_rows(path, *rows):
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    return path


def test_duplicate_rows_of_merged_files_raise_an_error(tmp_path):
    other = {**ROW, "hash": "y", "seed": 2}
    path = write_rows(tmp_path / "rows.jsonl", ROW, other)
    assert results.read(path) == [ROW, other]
    for duplicate in (ROW, {**ROW, "seed": 3, "successes": 0, "success": 0.0}):
        write_rows(path, ROW, other, duplicate)
        with pytest.raises(UserError, match="line 3: the same hash, x, as line 1.* delete one"):
            results.read(path)
    with pytest.raises(UserError, match="line 3"):
        results.record(path, {**ROW, "hash": "z"})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": True}, "seed is a bool, expected int"),
        ({"seed": 2**32}, "seed is 4294967296, expected at least 0 and at most 4294"),
        ({"successes": 2}, "2 successes of 1 episodes"),
        ({"success": 0.6}, r"success is 0\.6, of 1 of 1 episodes"),
        ({"mean_length": float("nan")}, "mean_length is nan: no number that a run could"),
        ({"paper_success": "95"}, "paper_success is a str, expected float"),
        ({"configuration": {"planner": 3}}, "configuration.planner is a int, expected object"),
        ({"mean_return": None}, "mean_return is a NoneType, expected float"),
    ],
)
def test_invalid_field_raises_an_error_that_names_its_line(tmp_path, change, message):
    path = write_rows(tmp_path / "rows.jsonl", ROW, {**ROW, "hash": "y", **change})
    with pytest.raises(UserError, match=f"line 2: {message}"):
        results.read(path)


def test_duplicate_field_raises_an_error(tmp_path):
    text = json.dumps(ROW)
    (tmp_path / "rows.jsonl").write_text(f'{text[:-1]}, "seed": 5}}\n')
    with pytest.raises(UserError, match=r"line 1: not JSON \(an object names 'seed' twice\)"):
        results.read(tmp_path / "rows.jsonl")


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("planning", lambda v: v[3].update(batch="1"), r"\[3\].batch is a str, expected int"),
        ("training", lambda v: v[0]["parts"][1].pop("ms"), r"\[0\].parts\[1\] without ms"),
        ("quality", lambda v: v[0].update(successes=10**6), "1000000 successes of"),
        ("landscape", lambda v: v.clear(), "empty"),
        ("atari-energy", lambda v: v["Pong"]["returns"].pop(), "Pong.*other numbers"),
    ],
)
def test_invalid_measurements_raise_an_error(tmp_path, name, change, message):
    path = tmp_path / f"{name}.json"
    values = measured.read_measured(ROOT / "results" / path.name)
    change(values)
    path.write_text(json.dumps(values))
    with pytest.raises(UserError, match=message):
        measured.read_measured(path)


def test_infinite_values_are_not_recorded(tmp_path):
    path = tmp_path / "rows.jsonl"
    with pytest.raises(UserError, match="planner of a new row is not finite"):
        results.record(path, {"hash": "a", "planner": {"temperature": math.inf}})
    assert not path.exists()


def test_episodes_are_stored_with_their_rows(tmp_path, monkeypatch):
    def make_episodes(*lengths):
        seeds = np.arange(len(lengths))
        return Episodes(seeds, seeds > 0, np.array(lengths), seeds / 3, 1, 10, 1.0, 1.0)

    def read_lengths():
        return {name: each["length"].tolist() for name, each in results.read_episodes(path).items()}

    path = tmp_path / "babyai.jsonl"
    assert read_lengths() == {}
    results.record(path, {**ROW, "hash": "a"}, make_episodes(3, 4))
    results.record(path, {**ROW, "hash": "b"}, make_episodes(5))
    assert read_lengths() == {"a": [3, 4], "b": [5]}
    table = results.read_episodes(path)["a"]
    assert table["seed"].tolist() == [0, 1] and table["success"].tolist() == [False, True]
    assert table["return"].tolist() == [0, 1 / 3]
    results.record(path, {**ROW, "hash": "a"}, make_episodes(7))
    with monkeypatch.context() as patch:  # killed while it replaces a row
        patch.setattr(results, "_write_episodes", lambda *given: sys.exit("killed"))
        with pytest.raises(SystemExit):
            results.record(path, {**ROW, "hash": "b"}, make_episodes(6))
    assert {row["hash"] for row in results.read(path)} == {"a"}  # no row with episodes of another
    results.record(path, {**ROW, "hash": "b"})  # another outcome, without episodes
    assert read_lengths() == {"a": [7]}
    results.record(path, {**ROW, "hash": "a"})
    assert read_lengths() == {}
    archive = tmp_path / "episodes" / "babyai.npz"
    for damage in (lambda: archive.write_bytes(archive.read_bytes()[:10]),
                   lambda: np.savez(archive, a=np.zeros(3))):  # fmt: skip
        damage()
        with pytest.raises(UserError, match=r"babyai\.npz"):
            results.record(path, {**ROW, "hash": "c"}, make_episodes(1))
