"""The core works without extras, and error messages name a missing extra."""

import contextlib
import importlib.metadata
import os
import re
import sys
import tomllib

import pytest

from leapjax import extras
from leapjax.errors import UserError
from tests.programs import ROOT, only_long, run_python

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
HEAVY = {*extras.EXTRAS, "chex", "flax"}

README = (ROOT / "README.md").read_text()
SNIPPETS = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
# Both planning snippets, and a rollout in a custom environment.
PLANNING = f"""
{"".join(SNIPPETS[:2])}
import sys
from leapjax.environments import Transition

def reset(key):
    place = jax.random.randint(key, (), 1, 4)
    return place, place

def step(place, action):
    place = place + jnp.array([-1, 1])[action]
    done = place == 0
    return place, Transition(place, jnp.float32(done), done, jnp.bool_(False), done)

assert plans.satisfied.all()
short = leap.from_total(lambda params, context: (), lambda p, m, plan: (plan == 1).sum(), 3)
walk = leap.PureEnvironment(reset, step, 3)
greedy = leap.GibbsConfig(2, 8, temperature=0.0)
rollout = leap.compile_rollout(walk, short, greedy, context=0, max_steps=5)
assert rollout((), range(3), 0).successes.all()
loaded = {{name.partition(".")[0] for name in sys.modules}} & {HEAVY!r}
assert not loaded, loaded
"""

# Code of `sitecustomize`, which Python imports at its start.
HIDE_MODULES = """
import sys

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {missing!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Missing())
"""


def normalise_name(requirement):
    """Returns the normalised name in a requirement such as `orbax_checkpoint>=0.12`."""
    return re.sub(r"[-_.]+", "-", re.match(r"[\w.-]+", requirement)[0]).lower()


def find_installed(requirements):
    """Lists the distributions that requirements install, without optional extras."""
    installed, pending = set(), list(requirements)
    while pending:
        requirement = pending.pop()
        name = normalise_name(requirement)
        if name not in installed and "extra ==" not in requirement:
            installed.add(name)
            with contextlib.suppress(importlib.metadata.PackageNotFoundError):  # for older Pythons
                pending += importlib.metadata.requires(name) or []
    return installed


@pytest.fixture(scope="module")
def core_only(tmp_path_factory):
    """Returns environment variables for a process that can import only the core."""
    core, ours = find_installed(PROJECT["dependencies"]), {"leapjax", "experiments", "tests"}
    missing = {
        module
        for module, names in importlib.metadata.packages_distributions().items()
        if core.isdisjoint(map(normalise_name, names))
    }
    folder = tmp_path_factory.mktemp("core")
    (folder / "sitecustomize.py").write_text(HIDE_MODULES.format(missing=missing - ours))
    return {"PYTHONPATH": os.pathsep.join([str(folder), str(ROOT)])}


LOADING = """
import sys
import leapjax
leapjax.load("GoToLocalS7N5")
assert "orbax" not in sys.modules
"""


@pytest.mark.parametrize("code", [pytest.param(PLANNING, marks=only_long), LOADING])
def test_installed_extras_are_not_imported_unless_needed(code):
    process = run_python("-c", code)
    assert process.returncode == 0, process.stderr


def test_core_plans_and_names_the_extra_of_a_published_planner(core_only):
    loading = """
for path in ("GoToLocalS7N5", "no-such-run"):
    try:
        leap.load(path)
    except leap.UserError as error:
        print(error)
"""
    process = run_python("-c", PLANNING + loading, **core_only)
    assert process.returncode == 0, process.stderr
    *_, needed, unknown = process.stdout.splitlines()
    assert 'is not installed: pip install ".[babyai]"' in needed
    assert unknown.startswith("there is no folder no-such-run, and no planner is published")


@pytest.mark.parametrize(
    ("arguments", "extra"),
    [
        ("experiments.babyai --help", "babyai"),
        ("experiments.atari", "atari"),
        ("experiments.stars", "train"),
    ],
)
def test_programs_print_one_line_if_their_extra_is_missing(core_only, arguments, extra):
    process = run_python("-m", *arguments.split(), **core_only)
    assert (process.returncode, process.stdout) == (2, "")
    assert re.fullmatch(
        rf'error: \w+ is not installed: pip install "\.\[{extra}\]".*\n', process.stderr
    )


def test_table_of_extras_matches_pyproject():
    listed = PROJECT["optional-dependencies"]
    names = importlib.metadata.packages_distributions()
    table = {
        normalise_name(name): extra
        for module, extra in extras.EXTRAS.items()
        for name in names.get(module, [module])
    }
    requirements = {
        normalise_name(requirement): extra
        for extra in {*extras.EXTRAS.values()}
        for requirement in listed[extra]
        if requirement != "leapjax[train]"
    }
    assert requirements.items() <= table.items() and len(requirements) == len(extras.EXTRAS)
    assert {name for name in listed if "leapjax[train]" in listed[name]} == {*extras.WITH_TRAIN}


@pytest.mark.parametrize(
    ("module", "requested", "expected"),
    [
        ("minari", "train", "train"),
        ("minari", "atari", "atari"),
        ("minigrid.core", "train", "babyai"),
        ("wandb", "babyai", "wandb"),
    ],
)
def test_error_names_one_extra_that_installs_everything(monkeypatch, module, requested, expected):
    monkeypatch.setitem(sys.modules, module, None)
    with (
        pytest.raises(UserError, match=rf'{module} is not installed: .*"\.\[{expected}\]"'),
        extras.report_missing(requested),
    ):
        importlib.import_module(module)
