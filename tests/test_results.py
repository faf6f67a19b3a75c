"""Rows say what they were made with."""

import math
import subprocess
from types import SimpleNamespace

import pytest

from experiments.common import results
from leapjax.errors import UserError


@pytest.fixture
def checkout(tmp_path):
    """A repository with one commit of code."""
    (tmp_path / "leapjax").mkdir()
    (tmp_path / "leapjax" / "code.py").write_text("1")
    git(tmp_path, "init", "--quiet")
    commit(tmp_path)
    return tmp_path


def git(folder, *arguments):
    identity = ("-c", "user.name=a", "-c", "user.email=a@example.org")
    done = subprocess.run(
        ("git", "-C", folder, *identity, *arguments), capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


def commit(folder):
    git(folder, "add", ".")
    git(folder, "commit", "--quiet", "--message", "a")
    return git(folder, "log", "-1", "--format=%h")


def test_a_checkout_is_known_by_the_last_commit_of_its_code(checkout):
    version = results.code_version(checkout)
    (checkout / "rows").write_text("new")
    commit(checkout)
    assert results.code_version(checkout) == version
    (checkout / "leapjax" / "code.py").write_text("2")
    assert results.code_version(checkout) == f"{version}.dirty"
    latest = commit(checkout)
    assert results.code_version(checkout) == f"+g{latest}" != version


def test_without_a_repository_only_the_version_is_known(tmp_path):
    assert results.code_version(tmp_path) == ""
    (tmp_path / ".git").write_text("damaged")
    assert results.code_version(tmp_path) == ""


def test_rows_name_the_devices_that_they_were_made_with(monkeypatch):
    alone = results.versions()["machine"]
    assert "H100" not in alone  # the devices of these tests are cores
    gpus = [SimpleNamespace(platform="gpu", device_kind="NVIDIA H100")] * 2
    monkeypatch.setattr(results.jax, "local_devices", lambda: gpus)
    assert results.versions()["machine"] == f"{alone}, 2 NVIDIA H100"


@pytest.mark.parametrize(
    ("field", "value"), [("mean_return", math.nan), ("planner", {"temperature": math.inf})]
)
def test_a_row_is_json_or_refused(tmp_path, field, value):
    path = tmp_path / "rows.jsonl"
    with pytest.raises(UserError, match=f"{field} of a new row is not finite"):
        results.record(path, {"hash": "a", field: value})
    assert not path.exists()
