"""The configuration of a run, and the hash that names its results."""

import dataclasses
import itertools
import math
import typing
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import pytest

import experiments.__main__ as programs
from experiments.common.searches import list_searches
from leapjax import domains, files, pretrained, serialization
from leapjax.agents.base import TrainingConfig
from leapjax.configuration import hash_config, list_settings, make_domain, specify
from leapjax.domains import DOMAINS, find_domain
from leapjax.domains.babyai.domain import BABYAI
from leapjax.domains.babyai.settings import Settings
from leapjax.errors import UserError
from leapjax.methods import METHODS
from leapjax.models.config import ModelConfig
from leapjax.planners import BeamConfig, CrossEntropyConfig, GibbsConfig, ShootingConfig
from leapjax.presets import babyai, find_preset
from leapjax.running import command_line, memory, shell
from leapjax.running.command_line import GROUPS
from leapjax.types import TrainState

LEVEL = "GoToLocalS7N5"


@dataclasses.dataclass(frozen=True)
class LaterSettings(Settings):
    """Settings of a later version, which adds a field."""

    mood: str = "calm"


def parse(*arguments):
    (found,) = command_line.parse("babyai", arguments)
    return found


def test_hashes_differ_by_level_method_preset_and_seed():
    cases = list(itertools.product(BABYAI.levels, METHODS, ("leapjax", "paper"), (0, 1)))
    hashes = {
        hash_config(find_preset("babyai", level, method, name), seed)
        for level, method, name, seed in cases
    }
    assert len(hashes) == len(cases) > 80


@pytest.mark.parametrize(
    "option",
    ["--demos 499", "--context 1", "--heads 2", "--steps 7", "--iterations 9", "--masking one",
     "--radius 2", "--test-seed 1", "--validation", "--executed 3"],
)  # fmt: skip
def test_options_that_affect_the_result_change_the_hash(option):
    assert hash_config(parse(*option.split()), 0) != hash_config(parse(), 0)


def test_options_that_do_not_affect_the_result_keep_the_hash():
    options = "--seeds 1 2 --record --runs elsewhere --no-pictures --checkpoint-seconds 1 --fsdp 2"
    more = "--microbatch 8 --demos 500"  # the preset's values
    found = parse(*options.split(), *more.split())
    assert hash_config(found, 0) == hash_config(parse(), 0)


def test_a_new_setting_at_its_default_keeps_hashes_and_identities(monkeypatch):
    def identify(*options):
        chosen = parse(*options)
        specification = specify(chosen, 0, make_domain(chosen))
        return hash_config(chosen, 0), pretrained.describe_identity(specification)

    methods = [method for method in METHODS if METHODS[method].everywhere]
    before = [identify("--method", method) for method in methods]
    monkeypatch.setitem(domains.DOMAINS, "babyai", BABYAI._replace(settings=LaterSettings))
    monkeypatch.setattr(babyai, "Settings", LaterSettings)
    assert isinstance(parse().domain_settings, LaterSettings)
    assert [identify("--method", method) for method in methods] == before
    assert identify("--mood", "calm") == before[0]
    assert not set(identify("--mood", "angry")) & set(before[0])


def test_saving_a_custom_fill_raises_an_error():
    chosen = parse()
    specification = specify(chosen, 0, make_domain(chosen))
    custom = GibbsConfig(5, 5, fill=lambda energies, key: energies[:, 0])
    with pytest.raises(UserError, match="a strategy by name, such as fill='confident'"):
        pretrained.describe_identity(dataclasses.replace(specification, planner=custom))


def test_settings_are_restored_from_a_row():
    chosen = parse("--heads", "2", "--masking", "each", "--clutter", "0.2", "--steps", "7")
    row = list_settings(chosen, seed=0)
    for group in GROUPS:
        settings = getattr(chosen, group)
        assert serialization.from_json(type(settings), row[group]) == settings
        for field in dataclasses.fields(settings):
            fewer = {name: value for name, value in row[group].items() if name != field.name}
            default = dataclasses.replace(settings, **{field.name: field.default})
            assert serialization.from_json(type(settings), fewer) == default
        with pytest.raises(UserError, match="unknown mood: expected what this version"):
            serialization.from_json(type(settings), {**row[group], "mood": "calm"})


def test_paper_preset_masks_and_ends_plans_like_the_authors_code():
    by_level = {level: find_preset("babyai", level, "leap", "paper").method_settings
               for level in (LEVEL, "GoToObjMazeS7", "PickUpLoc")}  # fmt: skip
    assert [each.masking for each in by_level.values()] == ["each", "each", "all"]
    assert not any(each.end or each.repeat_state for each in by_level.values())
    assert find_preset("babyai", LEVEL, "leap", "leapjax").method_settings.end
    # In star graphs there is no pose to leave out, and a plan may end.
    stars = find_preset("stars", "Star3x5", "leap", "paper").method_settings
    assert stars.repeat_state and stars.end


def test_level_all_selects_the_levels_of_the_paper():
    found = command_line.parse("babyai", ["--level", "all", "--demos", "9"])
    assert [each.level for each in found] == list(BABYAI.levels)
    assert {each.demos for each in found} == {9}
    assert len({each.planner.horizon for each in found}) > 1  # each level has its own defaults


@pytest.mark.parametrize(
    ("method", "option", "value", "reason"),
    [
        ("classifier", "--fill", "sequential", "use fill 'together'"),
        ("plate", "--fill", "confident", "from left to right"),
        ("plate", "--judge", "halves", "use judge 'energy'"),
        ("classifier", "--judge", "halves", "use judge 'energy'"),
        ("random", "--horizon", "3", "its horizon is 1"),
    ],
)
def test_unsupported_planner_options_raise_an_error(method, option, value, reason):
    with pytest.raises(UserError, match=reason) as raised:
        command_line.parse("babyai", ["--method", method, option, value])
    assert option in shell.describe(raised.value)


@pytest.mark.parametrize("domain", ["stars", "sudoku"])
def test_searches_of_the_classifier_fill_plans_together(domain):
    found = {name: command_line.parse(domain, ["--method", name])[0]
             for name in ("leap", "classifier")}  # fmt: skip
    assert found["leap"].planner.fill == "confident"
    searches = list_searches(found["classifier"])
    assert {search.planner.fill for search in searches} == {"together"}
    others = list_searches(found["leap"])
    assert len(others) > len(searches) > 1
    assert found["leap"] not in others  # a run plays its own configuration first


def test_unknown_program_error_suggests_a_similar_name(capsys):
    assert programs.main(["babyia"]) == 2
    assert "did you mean babyai" in capsys.readouterr().err


KINDS = [
    *dict.fromkeys(method.settings for method in METHODS.values()),
    *(find_domain(name).settings for name in DOMAINS),
    ModelConfig, TrainingConfig, GibbsConfig, ShootingConfig, CrossEntropyConfig, BeamConfig,
]  # fmt: skip
INVALID = {
    int: [1.0, True, "1", math.nan, -1, 2**31],
    float: [True, "1", math.nan, -math.inf],
    bool: [1, "yes", None],
    str: [1, None],
    Path: [1, True, b"path"],
}


@pytest.mark.parametrize("kind", KINDS)
def test_every_field_of_every_configuration_is_validated(kind):
    for field in dataclasses.fields(kind):
        type_of = typing.get_type_hints(kind)[field.name]
        kinds = typing.get_args(type_of) or (type_of,)
        pair = typing.get_origin(type_of) is tuple
        for value in INVALID[kinds[0]]:
            if value is not None or type(None) not in kinds:
                with pytest.raises(UserError, match=field.name):
                    kind(**{field.name: (value,) * len(kinds) if pair else value})


@pytest.mark.parametrize(
    "option",
    ["--context 100000", "--word-heads 100000", "--microbatch 9223372036854775808",
     "--restarts 100000", "--seeds 2147483648", "--episodes 90000000", "--width 100000",
     "--batch 2147483647", "--demos 9999999", "--checkpoint-seconds nan", "--rules inf",
     "--fsdp 9223372036854775808", "--clip nan"],
)  # fmt: skip
def test_excessive_numbers_raise_an_error(option, monkeypatch):
    pages = {"SC_PAGE_SIZE": 1 << 12, "SC_PHYS_PAGES": 16 << 18}
    monkeypatch.setattr(files.os, "sysconf", pages.__getitem__)
    name, value = option.split()
    with pytest.raises(UserError, match=name.strip("-s").replace("-", "[ _-]")):
        parse("--level", LEVEL, name, value)


def test_memory_checks_reject_a_network_or_program_that_is_too_large(monkeypatch, tmp_path):
    pages = {"SC_PAGE_SIZE": 1 << 12, "SC_PHYS_PAGES": 10 << 18}
    monkeypatch.setattr(files.os, "sysconf", pages.__getitem__)

    def state(count):
        params = {"w": jax.ShapeDtypeStruct((count, 1024, 1024), jnp.float32)}
        return TrainState(params, (params, params), jax.ShapeDtypeStruct((), jnp.int32))

    memory.check_state(state(600))  # parameters, two moments and gradients: 4 * 4 bytes each
    with pytest.raises(UserError, match="at least 10 GiB of memory would be needed"):
        memory.check_state(state(700))

    analysis = SimpleNamespace(temp_size_in_bytes=1 << 30, argument_size_in_bytes=1 << 20)
    program = SimpleNamespace(memory_analysis=lambda: analysis)
    memory.check_program(program)  # on each of 8 devices
    analysis.temp_size_in_bytes = 2 << 30
    with pytest.raises(UserError, match="--batch.* at least 16 GiB"):
        memory.check_program(program)
    memory.check_program(SimpleNamespace(memory_analysis=lambda: None))  # without an analysis
    (tmp_path / "memory.max").write_text("2147483648\n")  # a container of 2 GiB
    monkeypatch.setattr(files, "CONTAINER_MEMORY", tmp_path / "memory.max")
    with pytest.raises(UserError, match="this machine has 2"):
        memory.check_state(state(200))
