"""The examples run, and their output is as documented."""

import json
import re
import runpy
import sys

import matplotlib.pyplot as plt
import pytest

from tests.programs import LONG, ROOT

# The constants in the first code cell of each notebook, at toy size.
NOTEBOOKS = {
    "tour": {"PASSES": 40, "STARTS": 2},
    "babyai": {"LEVELS": 2},
    "train_on_my_data": {"STEPS": 2, "SEEDS": 1, "EPISODES": 2},
}
MOST_BYTES = 400_000  # size of a notebook, with its pictures
# Matches absolute paths, but not parts of relative paths or URLs.
ABSOLUTE = re.compile(r"(?<![\w.:/<)\]])/\w[\w.-]*/\w|\b[A-Z]:\\")


def read_notebook(name):
    return json.loads((ROOT / "examples" / f"{name}.ipynb").read_text(encoding="utf-8"))


def read_code_cells(name):
    return [cell for cell in read_notebook(name)["cells"] if cell["cell_type"] == "code"]


@pytest.mark.parametrize(
    ("name", "arguments", "pattern"),
    [
        ("plan_with_my_energy", [], r"(9\d|100)% of 256 plans keep to the constraint"),
        ("colour_a_graph", [], r"best of 8 +[89]\d% of 64 graphs"),
        ("train_on_my_data", ["2" if LONG else "0", "1"], r"mean return \d+, success \d+%"),
        ("add_a_constraint", ["4"], r"without left turns: success \d+%, 0 left turns"),
        ("variant_of_a_level", ["4"], r"5 objects: success \d+%\n10 objects: success \d+%"),
        ("pure_environment", ["20"], r"20 mazes: success (9\d|100)%"),
    ],
)
def test_example_runs(name, arguments, pattern, monkeypatch, capsys):
    if name == "pure_environment":
        pytest.importorskip("jumanji")
    if name in ("add_a_constraint", "colour_a_graph", "variant_of_a_level") and not LONG:
        pytest.skip("make test-long runs it")
    monkeypatch.setattr(sys, "argv", [name, *arguments])
    runpy.run_path(str(ROOT / "examples" / f"{name}.py"), run_name="__main__")
    assert re.search(pattern, capsys.readouterr().out)


def test_every_example_is_tested():
    marks = test_example_runs.pytestmark[0].args[1]
    assert {path.stem for path in (ROOT / "examples").glob("*.py")} == {mark[0] for mark in marks}


@pytest.mark.parametrize("name", sorted(path.stem for path in (ROOT / "examples").glob("*.ipynb")))
def test_notebook_runs(name, monkeypatch, tmp_path):
    """Executes the code cells in order, in one namespace, as a kernel does."""
    constants = NOTEBOOKS[name]
    if name != "tour" and not LONG:
        pytest.skip("make test-long runs it")
    plt.switch_backend("Agg")
    monkeypatch.chdir(tmp_path)
    pictures = []
    monkeypatch.setattr(plt, "show", lambda: pictures.append(plt.gcf()) or plt.close("all"))
    namespace = {"__name__": "__main__"}
    for number, cell in enumerate(read_code_cells(name)):
        exec(compile("".join(cell["source"]), f"{name}, code cell {number}", "exec"), namespace)
        if number == 0:
            assert constants.keys() <= namespace.keys()
            namespace.update(constants)
    shown = [part for cell in read_code_cells(name) for part in cell["outputs"] if "data" in part]
    assert len(pictures) == len(shown) > 0


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_committed_notebook_has_clean_outputs(name):
    """The outputs are from one run from top to bottom, without errors or absolute paths.

    To write them: `jupyter nbconvert --to notebook --execute --inplace examples/NAME.ipynb`.
    """
    assert (ROOT / "examples" / f"{name}.ipynb").stat().st_size < MOST_BYTES
    assert read_notebook(name)["metadata"]["kernelspec"] == {
        "display_name": "Python 3",
        "language": "python",
        "name": "python3",
    }
    cells = read_code_cells(name)
    assert [cell["execution_count"] for cell in cells] == [*range(1, len(cells) + 1)]
    outputs = [output for cell in cells for output in cell["outputs"]]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    for output in outputs:
        assert output["output_type"] != "error"
        assert output.get("name") != "stderr"
    for cell in read_notebook(name)["cells"]:
        texts = ["".join(output.get("text", "")) for output in cell.get("outputs", [])]
        assert not ABSOLUTE.search("\n".join(["".join(cell["source"]), *texts]))
