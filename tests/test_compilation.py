"""The disk cache of compiled programs: its folder, and when it is off."""

import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental.compilation_cache import compilation_cache

from leapjax import compilation
from leapjax.batching import compile_planner
from leapjax.energy import from_total
from leapjax.planners import ShootingConfig
from leapjax.running import jax_setup

FOLDER = "jax_compilation_cache_dir"
SHORTEST = "jax_persistent_cache_min_compile_time_secs"
SETTINGS = (FOLDER, SHORTEST, "jax_enable_compilation_cache")


@pytest.fixture
def no_cache(monkeypatch):
    """Resets JAX to its initial state: no cache, and no decision about a cache."""
    before = {name: getattr(jax.config, name) for name in SETTINGS}
    for name, value in zip(SETTINGS, (None, compilation.SHORTEST_OF_JAX, True), strict=True):
        jax.config.update(name, value)
    compilation_cache.reset_cache()
    compilation._say_once.cache_clear()
    yield
    for name, value in before.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()


def test_planners_are_cached_even_if_jax_compiled_a_program_before(no_cache, tmp_path, monkeypatch):
    jax.config.update(SHORTEST, 0)
    jax.jit(lambda: jnp.full(3, 7))().block_until_ready()  # JAX decides that it has no cache
    monkeypatch.setenv("LEAPJAX_COMPILATION_CACHE", str(tmp_path / "programs"))
    energy = from_total(lambda p, c: c, lambda p, m, a: (m - a.sum()) ** 2, 3)
    planner = compile_planner(energy, ShootingConfig(2, candidates=4))
    planner((), jax.random.split(jax.random.key(0), 1), np.zeros(1, np.float32))
    assert list((tmp_path / "programs").iterdir())
    assert getattr(jax.config, SHORTEST) == 0  # the user's setting stays


@pytest.mark.parametrize(
    ("setting", "value"), [(FOLDER, "elsewhere"), ("jax_enable_compilation_cache", False)]
)
def test_user_settings_stay_unchanged(setting, value, no_cache, tmp_path, monkeypatch):
    monkeypatch.setenv("LEAPJAX_COMPILATION_CACHE", str(tmp_path / "programs"))
    jax.config.update(setting, value)
    before = [getattr(jax.config, name) for name in SETTINGS]
    compilation.use_disk_cache()
    assert [getattr(jax.config, name) for name in SETTINGS] == before
    assert not list(tmp_path.iterdir())


def test_users_and_programs_can_turn_the_cache_off(no_cache, tmp_path, monkeypatch):
    for folder in ("off", str(tmp_path)):  # turned off by the user, or by the program
        monkeypatch.setenv("LEAPJAX_COMPILATION_CACHE", folder)
        jax_setup.start(cache=folder == "off")
        compilation.use_disk_cache()  # as `compile_planner` does
        assert getattr(jax.config, FOLDER) is None


@pytest.mark.parametrize("system", ["linux", "windows"])
def test_default_folder_is_in_the_users_cache_folder(system, no_cache, tmp_path, monkeypatch):
    if system == "windows":  # Windows has no owners of files, and no /proc
        monkeypatch.delattr(os, "getuid")
        monkeypatch.setattr(compilation, "CPU", tmp_path / "nowhere")
        name = "Intel64 Family 6 Model 142 Stepping 10, GenuineIntel"
        monkeypatch.setattr(compilation.platform, "processor", lambda: name)
    monkeypatch.delenv("LEAPJAX_COMPILATION_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    compilation.use_disk_cache()
    (folder,) = (tmp_path / "leapjax" / "xla").iterdir()
    assert getattr(jax.config, FOLDER) == str(folder)
    assert system == "linux" or folder.name.startswith("Intel64_Family_6")
    assert getattr(jax.config, SHORTEST) == compilation.SHORTEST


@pytest.mark.parametrize("reason", ["others can write to", "cannot write to"])
def test_unsafe_folder_turns_the_cache_off_with_one_warning(
    reason, no_cache, tmp_path, monkeypatch, capsys
):
    folder = tmp_path / "shared"
    if reason == "others can write to":
        folder.mkdir()
        folder.chmod(0o777)
    else:
        folder.write_text("")
    monkeypatch.setenv("LEAPJAX_COMPILATION_CACHE", str(folder))
    compilation.use_disk_cache()
    compilation.use_disk_cache()
    assert getattr(jax.config, FOLDER) is None
    warning = capsys.readouterr().err
    assert warning.startswith(f"compiled programs are not kept: {reason}")
    assert warning.count("\n") == 1
