"""The examples do what they say."""

import re
import runpy
import sys

import pytest

from tests.programs import LONG, ROOT


@pytest.mark.parametrize(
    ("name", "arguments", "says"),
    [
        ("plan_with_my_energy", [], r"(9\d|100)% of 256 plans keep to the constraint"),
        ("colour_a_graph", [], r"best of 8 +[89]\d% of 64 graphs"),
        ("train_on_my_data", ["2", "1"], r"mean return \d+, success \d+%"),
        ("add_a_constraint", ["4"], r"without left turns: success \d+%, 0 left turns"),
        ("variant_of_a_level", ["4"], r"5 objects: success \d+%\n10 objects: success \d+%"),
        ("pure_environment", ["20"], r"20 mazes: success (9\d|100)%"),
    ],
)
def test_an_example_runs(name, arguments, says, monkeypatch, capsys):
    if name == "pure_environment":
        pytest.importorskip("jumanji")
    if name == "add_a_constraint" and not LONG:
        pytest.skip("make test-long runs it")
    monkeypatch.setattr(sys, "argv", [name, *arguments])
    runpy.run_path(str(ROOT / "examples" / f"{name}.py"), run_name="__main__")
    assert re.search(says, capsys.readouterr().out)


def test_every_example_is_tried():
    marks = test_an_example_runs.pytestmark[0].args[1]
    assert {path.stem for path in (ROOT / "examples").glob("*.py")} == {mark[0] for mark in marks}
