"""Damaged and adversarial input either loads correctly or raises a one-line error.

No input causes a traceback, a hang or much use of memory, or runs code of its own.
"""

import contextlib
import copy
import io
import json
import resource
import shutil
import signal
import tempfile
import typing
import warnings
from pathlib import Path

import h5py
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from leapjax import checkpoints, pretrained, weights
from leapjax.checkpoints import Checkpoints
from leapjax.configuration import hash_config, list_settings, make_config, make_domain, specify
from leapjax.data import storage
from leapjax.domain import Collection
from leapjax.errors import UserError
from leapjax.methods import METHODS
from leapjax.presets import find_preset
from leapjax.running import command_line, results
from leapjax.types import TrainState
from tests.programs import LONG, only_long, toy_row
from tests.test_storage import LEVEL, NAME

CASES = 600 if LONG else 25  # for each of seven kinds of input

# Every run tests the same cases.
cases = settings(
    max_examples=CASES, derandomize=True, database=None, deadline=None,
    suppress_health_check=list(HealthCheck),
)  # fmt: skip


class Hang(BaseException):
    """A reader hangs. As a BaseException, it passes every `except Exception`."""


def raise_hang(*_):
    raise Hang


def try_read(read):
    """Returns the result of a reader, unless it raises a one-line `UserError`.

    Fails if the reader takes 20 seconds (usually less than one) or 512 MiB more memory.
    """
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    previous = signal.signal(signal.SIGALRM, raise_hang)
    signal.alarm(20)
    try:
        return read()
    except UserError as error:
        assert str(error) and "\n" not in str(error)
        return None
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, previous)
        assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 512 * 1024


def damage(data: bytes, rng: np.random.Generator) -> bytes:
    """Truncates data, flips bits, overwrites bytes, or repeats, removes or zeroes a part."""
    at = int(rng.integers(len(data)))
    length = int(rng.integers(1, min(len(data), 2000) + 1))
    width = int(rng.choice([2, 4, 8]))
    before, part, after = data[:at], data[at : at + length], data[at + length :]
    flipped = bytearray(data)
    for place in rng.integers(len(data), size=8):
        flipped[place] ^= 1 << int(rng.integers(8))
    return (
        before,
        bytes(flipped),
        before + rng.bytes(length) + after,
        before + bytes(length) + after,
        before + part * int(rng.integers(2, 50)) + after,
        before + after,
        # A huge length or address.
        before + b"\xff" * (width - 1) + b"\x7f" + data[at + width :],
    )[rng.integers(7)]


SEEDS = st.integers(0, 2**32 - 1)
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20)
    | st.sampled_from([10**30, -1, 1e308, "x" * 10_000, "\ud800", "../../etc", "__class__"]),
    lambda inner: st.lists(inner, max_size=4)
    | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=8,
)  # fmt: skip


def list_paths(value, path=()):
    """Lists the paths of all values inside a JSON value."""
    found = [path]
    if isinstance(value, dict | list):
        for key, inner in value.items() if isinstance(value, dict) else enumerate(value):
            found += list_paths(inner, (*path, key))
    return found


@st.composite
def change_json(draw, original):
    """Replaces, removes or adds parts of a JSON value, or damages its text."""
    if draw(st.integers(0, 2)) == 0:
        text = damage(json.dumps(original).encode(), np.random.default_rng(draw(SEEDS)))
        return draw(st.sampled_from([text, b"[" * 100_000, b"\xff\xfe", b"", text * 2]))
    value = copy.deepcopy(original)
    for _ in range(draw(st.integers(1, 3))):
        path = draw(st.sampled_from(list_paths(value)))
        if not path:
            return json.dumps(draw(JSON)).encode()
        parent = value
        for key in path[:-1]:
            parent = parent[key]
        if draw(st.booleans()):
            parent[path[-1]] = draw(JSON)
        elif isinstance(parent, dict):
            del parent[path[-1]]
            parent[draw(st.text(max_size=8))] = draw(JSON)
    return json.dumps(value).encode()


# Demonstrations.


@pytest.fixture(scope="module")
def data_set(local_demonstrations, tmp_path_factory):
    """Saves an intact data set in its own Minari folder; returns the folder."""
    folder = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(folder))
        storage.save(NAME, Collection(local_demonstrations, {}), LEVEL, "for a test")
    return folder


def read_data_set(intact, change):
    """Reads the demonstrations of a changed copy of the data set."""
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        copied = Path(folder) / "datasets"
        shutil.copytree(intact, copied)
        change(copied / NAME / "data")
        patch.setenv("MINARI_DATASETS_PATH", str(copied))
        return storage.load(NAME, LEVEL).demonstrations


@cases
@given(seed=SEEDS)
def test_damaged_arrays_load_valid_values_or_raise_an_error(data_set, seed):
    def change(folder):
        path = folder / "main_data.hdf5"
        path.write_bytes(damage(path.read_bytes(), np.random.default_rng(seed)))

    loaded = try_read(lambda: read_data_set(data_set, change))
    for demonstration in loaded or []:
        # HDF5 keeps no checksums: loaded values may differ from saved ones, but they are valid.
        grid, actions = demonstration.observations.grid, demonstration.actions
        assert grid.shape == (len(actions) + 1, *LEVEL.blank.grid.shape) and len(actions) > 0
        assert actions.min() >= 0 and actions.max() < 7 and grid[..., 0].max() <= 10


@cases
@given(data=st.data())
def test_damaged_metadata_loads_or_raises_an_error(data_set, data):
    def change(folder):
        path = folder / "metadata.json"
        original = json.loads(path.read_text())
        for name in ("observation_space", "action_space"):
            if data.draw(st.booleans()):
                text = data.draw(change_json(json.loads(original[name])))
                original[name] = text.decode(errors="replace")
        path.write_bytes(data.draw(change_json(original)))

    try_read(lambda: read_data_set(data_set, change))


def test_data_cannot_run_code(data_set, tmp_path):
    """Without an action space, Minari would make the environment that the data names."""
    trap = tmp_path / "trap"
    spec = EnvSpec("Trap-v0", "pathlib:Path.touch", kwargs={"self": str(trap)})

    def change(folder):
        values = json.loads((folder / "metadata.json").read_text())
        del values["action_space"]
        values["env_spec"] = spec.to_json()
        (folder / "metadata.json").write_text(json.dumps(values))

    with pytest.raises(UserError, match="metadata.json has no action_space"):
        read_data_set(data_set, change)
    assert not trap.exists()


@pytest.mark.parametrize(
    ("message", "link", "options"),
    [
        # 8 TB of zeros: chunks that were never written take no room in the file.
        ("claims 8000000", None, {"shape": (10**12,), "dtype": "i8", "chunks": (1000,)}),
        ("is a link", h5py.ExternalLink("/etc/passwd", "/"), None),
        ("is a link", h5py.SoftLink("/episode_1/actions"), None),
        ("not an array of this file", None,
         {"shape": (9,), "dtype": "i8", "external": [("/etc/passwd", 0, 72)]}),
    ],
)  # fmt: skip
def test_links_and_unwritten_arrays_raise_an_error(data_set, message, link, options):
    def change(folder):
        with h5py.File(folder / "main_data.hdf5", "r+") as file:
            del file["episode_0/actions"]
            if options:
                file.create_dataset("episode_0/actions", **options)
            else:
                file["episode_0/actions"] = link

    def read():
        with pytest.raises(UserError, match=message):
            read_data_set(data_set, change)

    try_read(read)


def test_objects_among_weights_are_not_unpickled(tmp_path):
    np.savez(tmp_path / "weights.npz", identity=np.array([object()]))
    with pytest.raises(UserError, match="cannot read"):
        weights.read(tmp_path / "weights.npz", STATE.params, "mine")


ROW = toy_row(
    paper_success=95.0, configuration={"betas": [0.9, 0.95], "planner": {"fill": "margin"}}
)


@cases
@given(data=st.data())
def test_damaged_rows_load_or_raise_an_error(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("rows") / "rows.jsonl"
    other = {**ROW, "hash": "y"}
    path.write_bytes(json.dumps(ROW).encode() + b"\n" + data.draw(change_json(other)) + b"\n")
    rows = try_read(lambda: results.read(path))
    for table in (results.make_success_table, results.make_time_table) if rows else ():
        assert table(rows).row_count >= len(rows) >= 1


SPECIFICATION = specify(
    find_preset("babyai", "GoToLocalS7N5", "leap", "leapjax"), seed=0, domain=LEVEL
)


@cases
@given(data=st.data())
def test_damaged_specifications_load_or_raise_an_error(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("run")
    pretrained.save_specification(folder, SPECIFICATION)
    assert pretrained.parse_specification(folder) == SPECIFICATION
    path = folder / pretrained.SPECIFICATION
    path.write_bytes(data.draw(change_json(json.loads(path.read_text()))))
    found = try_read(lambda: pretrained.parse_specification(folder))
    assert found is None or isinstance(found, pretrained.Specification)


# The command line.

WORDS = (
    "--level --method --preset --seeds --demos --demonstrations --episodes --test-seed "
    "--validation --context --executed --checkpoint --record --runs --architecture --layers "
    "--width --radius --dtype --steps --batch --learning-rate --betas --masking --horizon "
    "--iterations --order --temperature --coordinator --num-processes --fsdp"
).split()
VALUES = st.sampled_from(
    ["0", "1", "-1", "1e9", "nan", "inf", "99999999999999999999", "None", "all", "paper",
     "leapjax", "GoToSeqS5R2", "BabyAI-GoToObj-v0", "random", "each", "True", "--", "-", "=", "",
     "\x00", "\n", "/dev/null", "{}", "$(touch x)", "bfloat16", "localhost:1", "x" * 5000]
) | st.text(max_size=10) | st.integers().map(str) | st.floats().map(str)  # fmt: skip
OPTIONS = st.lists(st.tuples(st.sampled_from(WORDS), VALUES), max_size=4).map(
    lambda pairs: [word for pair in pairs for word in pair]
)


def check_command_line(domain, arguments):
    """Parses a command line and checks its configurations: [] if it is invalid or shows help."""

    def parse():
        quiet = io.StringIO()
        try:
            with contextlib.redirect_stdout(quiet), contextlib.redirect_stderr(quiet):
                return command_line.parse(domain, arguments)
        except SystemExit as stopped:  # help, or a mistake that tyro reports
            assert stopped.code in (0, 2)
            return None

    found = try_read(parse) or []
    for each in found:
        assert len(hash_config(each, each.seeds[0])) == 12
        assert "NaN" not in json.dumps(list_settings(each, each.seeds[0]))
        assert each.context <= make_domain(each).max_steps and each.episodes > 0
        assert each.demos > 0 or each.training.steps == 0
    return found


@cases
@given(arguments=OPTIONS | st.lists(st.sampled_from(WORDS) | VALUES, max_size=6))
def test_any_command_line_parses_or_exits_cleanly(arguments):
    check_command_line("babyai", arguments)


COUNTS = ("-1", "0", "2", "100000", "2147483647", "2147483648", "9223372036854775808", "9" * 5000)
NUMBERS = ("-1", "0", "0.5", "nan", "inf", "-inf", "1e39", "1e308", "9" * 5000)
LEVELS = {
    "babyai": "GoToLocalS7N5", "stars": "Star3x5", "sudoku": "Sudoku4x6",
    "countdown": "Countdown3", "satisfiability": "Nae20x42", "gymnasium": "FrozenLake-v1",
    "atari": "Breakout",
}  # fmt: skip


def list_numeric_options(settings):
    """Yields every numeric option with every value to test."""
    for name, kind in typing.get_type_hints(type(settings)).items():
        parts = typing.get_args(kind) or (kind,)
        pair = typing.get_origin(kind) is tuple and ... not in parts
        for value in COUNTS if int in parts else NUMBERS if float in parts else ():
            yield [f"--{name.replace('_', '-')}", *[value] * (len(parts) if pair else 1)]


@only_long
@pytest.mark.parametrize("domain", LEVELS)
def test_any_number_parses_or_raises_an_error(domain):
    accepted, base = 0, ["--level", LEVELS[domain]]
    if domain == "gymnasium":  # it has no demonstrations
        base += ["--demos", "0", "--steps", "0"]
    for method in METHODS if domain == "babyai" else ("leap", "iql"):
        config = make_config(domain, LEVELS[domain], method)
        parts = [config.method_settings, config.planner]
        if method == "leap":  # settings that all methods share
            parts += [config, config.model, config.training, config.cluster, config.domain_settings]
        for option in (option for part in parts for option in list_numeric_options(part)):
            accepted += len(check_command_line(domain, [*base, "--method", method, *option]))
    assert accepted > 50


# Checkpoints.

STATE = TrainState(
    {"w": jnp.arange(600.0).reshape(20, 30), "b": jnp.ones(30)}, (jnp.zeros(3),), jnp.int32(2)
)


@pytest.fixture(scope="module")
def two_checkpoints(tmp_path_factory):
    folder = tmp_path_factory.mktemp("checkpoints")
    saved = Checkpoints(folder)
    for step in (1, 2):
        saved.save(STATE._replace(step=jnp.int32(step)))
    saved.close()
    return folder


@cases
@given(seed=SEEDS, whole_state=st.booleans())
def test_damaged_checkpoints_restore_exactly_or_raise_an_error(two_checkpoints, seed, whole_state):
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as scratch, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        folder = Path(scratch) / "checkpoints"
        shutil.copytree(two_checkpoints, folder)
        files = sorted(path for path in (folder / "2").rglob("*") if path.is_file())
        path = files[rng.integers(len(files))]
        path.write_bytes(damage(path.read_bytes(), rng))
        if whole_state:
            saved = Checkpoints(folder)
            restored = try_read(lambda: saved.restore(STATE))
            saved.close()
            params = restored and restored.params
            assert restored is None or int(restored.step) in (1, 2)
        else:
            sizes = try_read(lambda: checkpoints.check_identity(folder, ""))
            assert sizes in (None, [30, 600])
            params = try_read(lambda: checkpoints.restore_params(folder, STATE.params)[0])
        if params:  # equal, bit for bit
            for name, value in STATE.params.items():
                np.testing.assert_array_equal(params[name], value)


@cases
@given(seed=SEEDS)
def test_damaged_weights_load_correctly_or_raise_an_error(tmp_path_factory, seed):
    path = tmp_path_factory.mktemp("damaged") / "weights.npz"
    weights.write(path, STATE.params, "mine")
    path.write_bytes(damage(path.read_bytes(), np.random.default_rng(seed)))
    sizes = try_read(lambda: weights.check_identity(path, "mine"))
    assert sizes is None or len(sizes) <= 2
    params = try_read(lambda: weights.read(path, STATE.params, "mine"))
    for name, value in STATE.params.items() if params else ():
        np.testing.assert_allclose(params[name], value, rtol=1e-3)
