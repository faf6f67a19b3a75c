"""Planners that come with the library, and their files."""

import dataclasses
import json
import shutil
import tracemalloc
import zipfile

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import leapjax as leap
from experiments import babyai, publish, sudoku
from leapjax import pretrained, weights
from leapjax.errors import UserError
from leapjax.running import results
from leapjax.running.command_line import parse
from tests.programs import ROOT, only_long, untrained_run

PARAMS = {"a": {"kernel": jnp.linspace(-3, 3, 12).reshape(3, 4)}, "b": jnp.ones(2)}


def test_parameters_round_trip_in_half_precision(tmp_path):
    path = tmp_path / "new" / "weights.npz"
    weights.write(path, PARAMS, "mine")
    found = weights.read(path, PARAMS, "mine")
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3), found, PARAMS)
    assert {leaf.dtype for leaf in jax.tree.leaves(found)} == {jnp.dtype(jnp.float32)}
    with pytest.raises(ValueError, match="b does not fit half precision"):
        weights.write(path, {"b": jnp.full(2, 1e6)}, "mine")


def test_parameters_of_another_configuration_raise_an_error(tmp_path):
    path = tmp_path / "weights.npz"
    weights.write(path, PARAMS, "mine")
    reshaped = {**PARAMS, "b": jnp.ones(3)}
    missing = {"b": PARAMS["b"]}
    for like, identity in ((PARAMS, "yours"), (reshaped, "mine"), (missing, "mine")):
        with pytest.raises(UserError, match="another configuration"):
            weights.read(path, like, identity)


@pytest.mark.parametrize(
    ("name", "size"),
    [("c.npy", 5_000_000), ("b.npy", 10**15), ("identity.npy", 10**15), ("identity", 5_000_000)],
)
@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_unexpected_arrays_are_not_unpacked(tmp_path, name, size):
    """The archive has an extra array, or an entry in place of an array."""
    path = tmp_path / "weights.npz"
    weights.write(path, PARAMS, "mine")
    with (
        zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open(name, "w") as file,
    ):
        header = {"descr": "<f2", "fortran_order": False, "shape": (size,)}
        np.lib.format.write_array_header_1_0(file, header)
        file.write(bytes(10**7))
    tracemalloc.start()
    with pytest.raises(UserError, match="another configuration|two arrays of one name"):
        weights.read(path, PARAMS, "mine")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 10**6


@pytest.fixture
def published(tmp_path, monkeypatch):
    """Publishes an untrained planner for its level; returns the folder of its run."""
    run = untrained_run(tmp_path / "run", "--seeds", "3")
    monkeypatch.setattr(pretrained, "PUBLISHED", tmp_path / "published")
    assert publish.main([str(run)]) == 0
    monkeypatch.chdir(tmp_path)
    return run


def test_a_published_planner_equals_its_run(published, tmp_path):
    run, copy = leap.load(published), leap.load("GoToLocalS7N5")
    assert run.specification == copy.specification
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-6), run.params, copy.params
    )
    specification = tmp_path / "published" / "GoToLocalS7N5" / "specification.json"
    values = json.loads(specification.read_text())
    values["model"]["heads"] = 1
    specification.write_text(json.dumps(values))
    with pytest.raises(UserError, match="another configuration"):
        leap.load("GoToLocalS7N5")
    shutil.rmtree(specification.parent.parent)
    with pytest.raises(UserError, match="there is no folder GoToLocalS7N5, and no planner is"):
        leap.load("GoToLocalS7N5")


def test_the_command_line_plays_published_planners(published, tmp_path, capsys):
    options = ["--pretrained", "--episodes", "2", "--no-pictures"]
    assert babyai.main(options) == 0
    (row,) = results.read(tmp_path / "runs" / "babyai.jsonl")
    assert (row["seed"], row["train_steps"], row["episodes"]) == (3, 0, 2)
    capsys.readouterr()
    for more, message in (
        (["--level", "PickUpLoc"], "no planner is published for 'PickUpLoc': only for GoToLocal"),
        (["--checkpoint", str(published)], "give one of them"),
        (["--seeds", "0"], "seed is 3, not 0"),
        (["--seeds", "3", "0"], "--seeds 3 0: a planner that is trained already is of one seed"),
    ):
        assert babyai.main([*options, *more]) == 2
        assert message in capsys.readouterr().err


def test_publishing_no_runs_is_refused(capsys):
    assert publish.main([]) == 2
    assert "no runs to publish" in capsys.readouterr().err


def test_a_family_planner_plays_each_level_of_its_family(published, tmp_path):
    (tmp_path / "published" / "GoToLocalS7N5").rename(tmp_path / "published" / "BabyAI")
    level = "BabyAI-GoToObj-v0"
    assert leap.load(level).domain.level == level
    assert leap.load(level, level="GoToLocalS7N5").domain.level == "GoToLocalS7N5"
    options = ["--pretrained", "--episodes", "2", "--no-pictures"]
    assert babyai.main(["--level", level, *options]) == 0
    (row,) = results.read(tmp_path / "runs" / "babyai.jsonl")
    assert (row["level"], row["played"]) == ("GoToLocalS7N5", level)
    assert row["paper_success"] is None  # the paper's number belongs to the trained level
    for name in ("BabyAI-GoToObjj-v0", "Other-GoToObj-v0"):
        with pytest.raises(UserError):
            leap.load(name)


LEVELS = {
    path.name: pretrained.read_specification(path).domain
    for path in sorted(pretrained.PUBLISHED.iterdir())
}
PROGRAMS = {"babyai": babyai, "sudoku": sudoku}


def test_published_planners_have_the_current_presets():
    assert len(LEVELS) > 4
    for level, domain in LEVELS.items():
        (config,) = parse(domain, ["--level", level, "--pretrained"])
        (preset,) = parse(domain, ["--level", level])
        assert config == dataclasses.replace(preset, checkpoint=config.checkpoint, pretrained=True)
        leap.load(level)


@only_long
@pytest.mark.parametrize("level", LEVELS)
def test_published_planners_reproduce_the_successes_of_their_rows(level, tmp_path, monkeypatch):
    """Holds on the machine that measured the rows; on another machine, bits may differ."""
    domain = LEVELS[level]
    rows = results.read(ROOT / "results" / f"{domain}.jsonl")
    monkeypatch.chdir(tmp_path)
    assert PROGRAMS[domain].main(["--level", level, "--pretrained", "--no-pictures"]) == 0
    (found,) = results.read(tmp_path / "runs" / f"{domain}.jsonl")
    (row,) = (row for row in rows if row["hash"] == found["hash"])
    assert found["successes"] == row["successes"]
