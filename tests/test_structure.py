"""Imports point one way, and the README says what is true."""

import ast
import importlib
import inspect
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import leapjax
from experiments import report
from experiments.common import results, runtime
from tests.programs import only_long

ROOT = Path(__file__).parent.parent
DOMAINS = tuple(f"leapjax.{name}" for name in ("babyai", "atari", "gymnasium", "stars", "sudoku"))
LIBRARY = sorted((ROOT / "leapjax").rglob("*.py"))


def imports(path):
    """Modules of this project that a file imports, as dotted names."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return {name for name in found if name.split(".")[0] in ("leapjax", "experiments")}


def may_import(path, *allowed):
    unexpected = {
        name
        for name in imports(ROOT / path)
        if name != "leapjax" and not any(f"{name}.".startswith(f"leapjax.{a}.") for a in allowed)
    }
    assert not unexpected, f"{path} imports {sorted(unexpected)}"


def test_the_library_never_imports_experiments():
    for path in LIBRARY:
        assert not {name for name in imports(path) if name.startswith("experiments")}, path


def test_the_core_imports_only_what_is_below_it():
    may_import("leapjax/types.py", "checks")
    may_import("leapjax/errors.py")
    may_import("leapjax/checks.py", "errors")
    may_import("leapjax/schedules.py", "checks")
    may_import("leapjax/energy.py", "types", "checks", "errors")
    may_import("leapjax/sharding.py", "types", "checks")
    may_import("leapjax/planners.py", "types", "checks")
    may_import("leapjax/batching.py", "types", "checks", "errors", "planners", "sharding")
    may_import("leapjax/scores.py", "checks")
    may_import("leapjax/training.py", "types", "sharding")
    may_import("leapjax/environments.py", "types", "checks", "errors")
    may_import("leapjax/data/windows.py", "types")
    may_import("leapjax/models/linear.py")
    may_import("leapjax/models/dropout.py")
    may_import("leapjax/models/transformer.py", "models.dropout", "models.linear")
    may_import("leapjax/models/encoder.py", "types", "errors")
    may_import(
        "leapjax/models/trajectory.py",
        *("types", "checks", "models.dropout", "models.encoder", "models.transformer"),
    )
    may_import(
        "leapjax/domain.py",
        *("types", "checks", "errors", "environments", "models.encoder", "models.trajectory"),
    )


def test_models_and_planners_meet_only_in_agents():
    for path in LIBRARY:
        names = imports(path)
        both = any(n.startswith("leapjax.models") for n in names) and any(
            n.startswith("leapjax.planners") for n in names
        )
        where = path.relative_to(ROOT / "leapjax").parts[0]
        assert not both or where in ("agents", "pretrained.py"), path


def test_only_babyai_knows_minigrid_and_only_atari_its_emulator():
    """And nothing but the table of domains knows a domain."""
    for path in LIBRARY:
        inside = path.relative_to(ROOT / "leapjax").parts[0]
        tree = ast.parse(path.read_text())
        used = {
            alias.name for n in ast.walk(tree) if isinstance(n, ast.Import) for alias in n.names
        }
        used |= {n.module or "" for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)}
        packages = {name.split(".")[0] for name in used}
        assert inside == "babyai" or "minigrid" not in packages, path
        assert inside == "atari" or "ale_py" not in packages, path
        others = tuple(domain for domain in DOMAINS if domain != f"leapjax.{inside}")
        if path.name != "domains.py":
            assert not {name for name in used if name.startswith(others)}, path


def test_what_experiments_share_knows_no_domain():
    shared = sorted((ROOT / "experiments" / "common").rglob("*.py"))
    assert len(shared) > 5
    for path in shared:
        assert not {n for n in imports(path) if n.startswith(DOMAINS)}, path


def test_there_is_no_cycle_of_imports():
    """Each module can be put above all that it imports."""
    folders = [ROOT / name for name in ("leapjax", "experiments")]
    below = {
        ".".join(path.relative_to(ROOT).with_suffix("").parts): imports(path)
        for folder in folders
        for path in folder.rglob("*.py")
        if path.name != "__init__.py"
    }
    while below:
        lowest = [name for name, needs in below.items() if not needs & below.keys()]
        assert lowest, f"these import each other: {sorted(below)}"
        below = {name: needs for name, needs in below.items() if name not in lowest}


def test_the_public_names_are_sorted_and_exist():
    assert leapjax.__all__ == sorted(leapjax.__all__)
    assert all(hasattr(leapjax, name) for name in leapjax.__all__)


def test_the_public_names_are_documented():
    listed = re.findall(r"^::: leapjax\.(\w+)$", (ROOT / "docs/api.md").read_text(), re.MULTILINE)
    assert sorted(listed) == leapjax.__all__
    for name in leapjax.__all__:
        said = inspect.getdoc(getattr(leapjax, name)) or ""
        assert len(said) > 20 and not said.startswith(f"{name}("), name


def test_the_readme_snippets_run():
    readme = (ROOT / "README.md").read_text()
    snippets = re.findall(r"```python\n(.*?)```", readme, flags=re.DOTALL)
    assert len(snippets) >= 2
    names: dict = {}
    for snippet in snippets:
        exec(compile(snippet, "README.md", "exec"), names)  # one session, as a reader has
    assert names["plans"].actions.shape == (7, 8)
    assert bool(names["plans"].satisfied.all())
    assert not (names["plans"].actions == 0).any()
    assert names["episodes"].successes.mean() >= 0.9


def test_the_tables_are_what_the_rows_say():
    documents = report.documents(ROOT)
    assert len(documents) == len(report.DOCUMENTS)
    for path, text in documents.items():
        assert path.read_text() == text, f"{path}: run python -m experiments.report"


def test_no_row_is_stale():
    rows = report.rows_of(ROOT, *report.EXPERIMENTS)
    stale = [row for row in rows if not report.is_used(row)]
    assert not [(row["level"], row["preset"], row["hash"]) for row in stale]


def test_the_readme_names_files_that_exist():
    readme = (ROOT / "README.md").read_text()
    for name in re.findall(r"\]\((?!http)([^)#]+)\)", readme):
        assert (ROOT / name).exists(), name
    for name in re.findall(r"^(\S+/\S*)  +\S", readme, flags=re.MULTILINE):
        assert (ROOT / name).exists(), name


PROGRAMS = [
    f"{folder}.{path.stem}"
    for folder in ("experiments", "benchmarks")
    for path in sorted((ROOT / folder).rglob("*.py"))
    if '__name__ == "__main__"' in path.read_text()
]


def exit_code(main, arguments):
    try:
        return main(arguments)
    except SystemExit as stopped:
        return stopped.code


# One of each way to be a program; the others are in the long form.
USUAL = ("__main__", "publish", "report", "stars", "properties", "planning")


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name.split(".")[1] in USUAL else only_long)
        for name in PROGRAMS
    ],
)
def test_every_program_says_how_it_is_used_and_refuses_what_it_does_not_know(
    name, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    main = importlib.import_module(name).main
    monkeypatch.setattr(runtime, "start", lambda *rest, **more: pytest.fail("something was begun"))
    assert exit_code(main, ["--help"]) == 0
    assert "usage" in capsys.readouterr().out.lower()
    for arguments in (["--no-such-option", "3"], ["nothing-of-that-name"]):
        assert exit_code(main, arguments) == 2
        assert capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_every_program_can_be_found():
    assert {"experiments.report", "experiments.publish", "benchmarks.planning"} <= set(PROGRAMS)
    assert len(PROGRAMS) > 20


def test_neither_imports_nor_a_command_line_start_a_backend():
    """Devices are chosen when a program starts: after its imports, and its command line."""
    modules = [
        ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for folder in ("leapjax", "experiments", "benchmarks")
        for path in sorted((ROOT / folder).rglob("*.py"))
        if path.name != "__init__.py"
    ]
    program = (
        "import importlib, jax\n"
        f"for name in {modules}:\n"
        "    importlib.import_module(name)\n"
        "from experiments.common import config, runtime\n"
        "for method in ('leap', 'classifier', 'random'):\n"
        "    for preset in ('paper', 'leapjax'):\n"
        "        config.parse('babyai', ['--method', method, '--preset', preset])\n"
        "runtime.start()\n"
        "import os\n"
        "assert len(jax.devices()) == min(len(os.sched_getaffinity(0)), 8), jax.devices()\n"
    )
    environment = {k: v for k, v in os.environ.items() if k != "JAX_NUM_CPU_DEVICES"}
    environment["LEAPJAX_COMPILATION_CACHE"] = "off"
    subprocess.run([sys.executable, "-c", program], check=True, env=environment, cwd=ROOT)


def test_the_episodes_that_are_kept_are_those_of_the_rows():
    rows = {
        results.episodes_path(ROOT / "results" / f"{row['experiment']}.jsonl", row["hash"]): row
        for row in report.rows_of(ROOT, *report.EXPERIMENTS)
    }
    for path in (ROOT / "results" / "episodes").iterdir():
        played = np.loadtxt(path, delimiter=",", skiprows=1)
        assert (
            len(played) == rows[path]["episodes"] and played[:, 1].sum() == rows[path]["successes"]
        )
        assert played[:, 3].mean() == pytest.approx(rows[path]["mean_length"])


def test_no_file_of_the_tests_hides_a_module_of_python():
    """A script in that folder would import it in the place of Python's own."""
    names = {path.stem for path in (ROOT / "tests").glob("*.py")}
    assert len(names) > 50 and not names & sys.stdlib_module_names
