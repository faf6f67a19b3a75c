"""Documents agree with the code and the rows, and public names are documented."""

import importlib
import inspect
import re
from pathlib import Path

import pytest

import leapjax
from experiments import report
from leapjax import types
from leapjax.agents.base import TrainingConfig
from leapjax.models.config import ModelConfig
from leapjax.running import jax_setup, results
from tests.programs import LONG, ROOT, run_python


def test_the_public_names_are_documented():
    listed = re.findall(r"^::: leapjax\.(\w+)$", (ROOT / "docs/api.md").read_text(), re.MULTILINE)
    assert sorted(listed) == leapjax.__all__
    assert set(listed) <= set(dir(leapjax)) and not hasattr(leapjax, "no_such_name")
    for name in leapjax.__all__:
        doc = inspect.getdoc(getattr(leapjax, name)) or ""
        assert len(doc) > 20 and not doc.startswith(f"{name}("), name


def list_fields(kind):
    """Lists the fields of a named tuple or a dataclass."""
    return getattr(kind, "_fields", None) or getattr(kind, "__dataclass_fields__", {}).keys()


def test_fields_are_documented_in_the_docstring_of_their_class():
    public = [getattr(leapjax, name) for name in leapjax.__all__]
    public = [each for each in public if isinstance(each, type)]
    documented = [*public, types.Window, types.TransitionWindow, ModelConfig, TrainingConfig]
    assert sum(map(len, map(list_fields, documented))) > 100
    for kind in documented:
        doc = inspect.getdoc(kind).partition("\nAttributes:\n")[2]
        for field in list_fields(kind):
            assert re.search(rf"^    {field}: \S", doc, re.MULTILINE), f"{kind.__name__}.{field}"


def test_the_readme_snippets_run():
    readme = (ROOT / "README.md").read_text()
    snippets = re.findall(r"```python\n(.*?)```", readme, flags=re.DOTALL)
    names: dict = {}
    for snippet in snippets:
        exec(compile(snippet, "README.md", "exec"), names)  # a single session, as for a reader
    assert names["plans"].actions.shape == (7, 8) and bool(names["plans"].satisfied.all())
    assert not (names["plans"].actions == 0).any()
    assert names["episodes"].successes.mean() >= 0.9


def test_the_tables_match_the_rows():
    documents = report.make_documents(ROOT)
    for path, text in documents.items():
        assert path.read_text() == text, f"{path}: run python -m experiments.report"


def test_no_row_is_stale():
    rows = report.read_rows(ROOT, *report.EXPERIMENTS)
    stale = [row for row in rows if not report.is_used(row)]
    assert not [(row["level"], row["preset"], row["hash"]) for row in stale]


def test_files_named_in_the_readme_exist():
    readme = (ROOT / "README.md").read_text()
    links = re.findall(r"\]\((?!http)([^)#]+)\)", readme)
    for name in links + re.findall(r"^(\S+/\S*)  +\S", readme, flags=re.MULTILINE):
        assert (ROOT / name).exists(), name


PROGRAMS = [
    f"{folder}.{path.stem}"
    for folder in ("experiments", "benchmarks")
    for path in sorted((ROOT / folder).rglob("*.py"))
    if '__name__ == "__main__"' in path.read_text()
]


# A program of each kind; the long form runs all.
USUAL = ("__main__", "publish", "report", "stars", "properties", "planning")


def exit_code(main, *arguments):
    try:
        return main(list(arguments))
    except SystemExit as stopped:
        return stopped.code


@pytest.mark.parametrize("name", [n for n in PROGRAMS if LONG or n.split(".")[1] in USUAL])
def test_programs_print_usage_and_reject_unknown_arguments(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    main = importlib.import_module(name).main
    monkeypatch.setattr(jax_setup, "start", lambda *rest, **more: pytest.fail("began"))
    assert exit_code(main, "--help") == 0
    assert "usage" in capsys.readouterr().out.lower()
    for arguments in (["--no-such-option", "3"], ["nothing-of-that-name"]):
        assert exit_code(main, *arguments) == 2 and capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_imports_and_command_lines_start_no_backend():
    """A program chooses its devices when it starts, after its imports and its command line."""
    paths = [
        path
        for name in ("leapjax", "experiments", "benchmarks")
        for path in Path(ROOT, name).rglob("*.py")
    ]
    modules = [".".join(path.relative_to(ROOT).with_suffix("").parts) for path in paths]
    program = f"""
import importlib, os
del os.environ["JAX_NUM_CPU_DEVICES"]
import jax
for name in {[name for name in modules if not name.endswith("__init__")]}:
    importlib.import_module(name)
from leapjax.running import jax_setup, command_line
for method in ("leap", "classifier", "random"):
    command_line.parse("babyai", ["--method", method])
for domain in ("atari", "countdown", "satisfiability", "stars", "sudoku"):
    command_line.parse(domain, [])
jax_setup.start()
assert len(jax.devices()) == min(len(os.sched_getaffinity(0)), 8), jax.devices()
"""
    assert run_python("-c", program, LEAPJAX_COMPILATION_CACHE="off").returncode == 0


@pytest.mark.parametrize("name", report.EXPERIMENTS)
def test_recorded_episodes_match_their_rows(name):
    path = ROOT / "results" / f"{name}.jsonl"
    rows = {row["hash"]: row for row in results.read(path)}
    for hashed, played in results.read_episodes(path).items():
        row = rows[hashed]
        assert len(played) == row["episodes"] and played["success"].sum() == row["successes"]
        assert played["length"].mean() == pytest.approx(row["mean_length"])
