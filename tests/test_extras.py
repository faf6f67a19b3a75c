"""What works without the extras of the package, and what is said where one is missing."""

import contextlib
import importlib.metadata
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from leapjax import extras
from leapjax.errors import UserError
from tests.programs import only_long

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
HEAVY = {*extras.EXTRAS, "chex", "flax"}

README = (ROOT / "README.md").read_text()
SNIPPETS = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
# The two that plan, and an environment of one's own.
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

# A module that Python imports when it starts.
WITHOUT = """
import sys

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {missing!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Missing())
"""


def distribution(need):
    """The normalised name in a requirement such as `orbax_checkpoint>=0.12`."""
    return re.sub(r"[-_.]+", "-", re.match(r"[\w.-]+", need)[0]).lower()


def installed_with(needs):
    """The distributions that requirements bring, extras left out."""
    found, waiting = set(), list(needs)
    while waiting:
        need = waiting.pop()
        name = distribution(need)
        if name not in found and "extra ==" not in need:
            found.add(name)
            with contextlib.suppress(importlib.metadata.PackageNotFoundError):  # of older Pythons
                waiting += importlib.metadata.requires(name) or []
    return found


@pytest.fixture(scope="module")
def core_alone(tmp_path_factory):
    """The environment of a process that has nothing but the core of the package."""
    core, ours = installed_with(PROJECT["dependencies"]), {"leapjax", "experiments", "tests"}
    missing = {
        module
        for module, names in importlib.metadata.packages_distributions().items()
        if core.isdisjoint(map(distribution, names))
    }
    folder = tmp_path_factory.mktemp("core")
    (folder / "sitecustomize.py").write_text(WITHOUT.format(missing=missing - ours))
    return {"PYTHONPATH": os.pathsep.join([str(folder), str(ROOT)])}


def run(arguments, environment):
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=ROOT, env={**os.environ, **environment}, capture_output=True, text=True,
    )  # fmt: skip


LOADING = """
import sys
import leapjax
leapjax.load("GoToLocalS7N5")
assert "orbax" not in sys.modules
"""


@pytest.mark.parametrize("code", [pytest.param(PLANNING, marks=only_long), LOADING])
def test_what_is_not_needed_is_not_loaded_although_it_is_installed(code):
    ended = run(["-c", code], {})
    assert ended.returncode == 0, ended.stderr


def test_the_core_alone_plans_and_names_the_extra_of_a_published_planner(core_alone):
    loading = """
for path in ("GoToLocalS7N5", "no-such-run"):
    try:
        leap.load(path)
    except leap.UserError as error:
        print(error)
"""
    ended = run(["-c", PLANNING + loading], core_alone)
    assert ended.returncode == 0, ended.stderr
    *_, needed, unknown = ended.stdout.splitlines()
    assert 'is not installed: pip install ".[babyai]"' in needed
    assert unknown.startswith("no-such-run is not a checkpoint")


@pytest.mark.parametrize(
    ("arguments", "extra"),
    [
        ("experiments.babyai --help", "babyai"),
        ("experiments.atari", "atari"),
        ("experiments.stars", "train"),
    ],
)
def test_a_program_without_its_extra_is_one_line(core_alone, arguments, extra):
    ended = run(["-m", *arguments.split()], core_alone)
    assert (ended.returncode, ended.stdout) == (2, "")
    assert re.fullmatch(
        rf'error: \w+ is not installed: pip install "\.\[{extra}\]".*\n', ended.stderr
    )


def test_the_table_of_extras_is_that_of_the_package():
    listed = PROJECT["optional-dependencies"]
    names = importlib.metadata.packages_distributions()
    brought = {
        distribution(name): extra
        for module, extra in extras.EXTRAS.items()
        for name in names.get(module, [module])
    }
    needs = {
        distribution(need): extra
        for extra in {*extras.EXTRAS.values()}
        for need in listed[extra]
        if need != "leapjax[train]"
    }
    assert needs.items() <= brought.items() and len(needs) == len(extras.EXTRAS)
    assert {name for name in listed if "leapjax[train]" in listed[name]} == {*extras.WITH_TRAIN}


@pytest.mark.parametrize(
    ("module", "asked", "named"),
    [
        ("minari", "train", "train"),
        ("minari", "atari", "atari"),
        ("minigrid.core", "train", "babyai"),
        ("wandb", "babyai", "wandb"),
    ],
)
def test_one_extra_is_named_that_brings_all(monkeypatch, module, asked, named):
    monkeypatch.setitem(sys.modules, module, None)
    with (
        pytest.raises(UserError, match=rf'{module} is not installed: .*"\.\[{named}\]"'),
        extras.report_missing(asked),
    ):
        importlib.import_module(module)
