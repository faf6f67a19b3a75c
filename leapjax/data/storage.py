"""Demonstrations as Minari data sets: written once, atomically, and read by one path.

A data set of the user's own, of the same observations, is read in the same way. Observations
are a dictionary by field, or one array where they are an array.
"""

import contextlib
import io
import json
import math
import os
import re
import shutil
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import jax
import minari
import numpy as np
from minari.data_collector import EpisodeBuffer
from minari.dataset.episode_data import EpisodeData
from minari.dataset.minari_storage import MinariStorage, is_image_space
from minari.serialization import deserialize_space
from minari.storage.datasets_root_dir import get_dataset_path
from PIL import Image

from leapjax import files
from leapjax.checks import MOST, check_fits, check_integer
from leapjax.domain import Collection, Described, Domain, Recording, Source
from leapjax.environments import Adapter, closing
from leapjax.errors import UserError, first_line
from leapjax.types import Demonstration, PyTree

LARGEST_SPACE = 10_000_000  # elements
DEEPEST = 16  # groups in groups
COMPARED = 100  # steps of an episode that is played again
SLAB = 2**28  # bytes that are read at once where sizes are not known yet
SPACES = ("observation_space", "action_space")  # in the metadata
STEPWISE = ("actions", "rewards", "terminations", "truncations")  # arrays of an episode
SCRATCH, LOCK = ".leapjax-unfinished-", ".leapjax-lock"  # hidden: Minari passes them over
BEFORE = "before"  # where in such a folder what a new data set replaces is kept
ARRAY_ROOM = 2**12  # bytes that HDF5 takes for an array, beside what it holds
UNKNOWN_SEED = -1  # of a user's episodes: no test level has it
FORMAT = 2  # raised whenever what a demonstration holds changes: old caches are then unused


def dataset_id(domain: Domain, count: int, seed: int) -> str:
    """The id under which `count` demonstrations for a training seed are cached."""
    return f"leapjax/{domain.level}/bot-{count}-seed{seed}-v{FORMAT}"


def source(domain: Domain, count: int, seed: int) -> Source:
    """`count` demonstrations of a domain for a training seed, kept as a Minari data set."""

    def make(name: str, progress: Callable[[int], None]) -> str:
        check_writable()
        if domain.collect is None:
            raise UserError(no_demonstrator(domain))
        collection = domain.collect(count, seed, progress)
        dropped = reasons(collection)
        summary = f"{count} demonstrations of {domain.level}"
        summary += f"; dropped: {dropped}" if dropped else ""
        save(name, collection, domain, summary)
        return summary

    def whole(name: str, seed: int) -> Collection:
        del seed
        loaded = load(name, domain, count)
        found, dropped = len(loaded.demonstrations), reasons(loaded)
        if found < count:
            also = f" that can be used ({dropped})" if dropped else ""
            raise UserError(
                f"{name} has {found} episodes{also}, fewer than --demos {count}: "
                f"use --demos {found}"
            )
        return loaded

    default = dataset_id(domain, count, seed)
    return Source(default, exists, make, whole, count, "demonstrations")


def no_demonstrator(domain: Domain) -> str:
    """What to say where demonstrations would have to be made, and nobody can."""
    return f"{domain.level} has no demonstrator: name a Minari data set of it to train on"


def observation_space(blank: PyTree) -> gym.Space:
    """The Minari space of observations like `blank`: of their shapes and types."""
    if isinstance(blank, np.ndarray):
        low, high = -np.inf, np.inf
        if blank.dtype == bool:
            low, high = 0, 1
        elif np.issubdtype(blank.dtype, np.integer):
            low, high = np.iinfo(blank.dtype).min, np.iinfo(blank.dtype).max
        return gym.spaces.Box(low, high, blank.shape, blank.dtype.type)
    return gym.spaces.Dict({name: observation_space(x) for name, x in _fields(blank).items()})


def _fields(observations: PyTree) -> dict[str, Any]:
    """The parts of observations that are not one array, by name."""
    return observations._asdict() if hasattr(observations, "_asdict") else dict(observations)


def save(name: str, collection: Collection, domain: Domain, description: str) -> None:
    """Writes a Minari data set; a killed program leaves all of it, or what was there before.

    Raises:
        UserError: there is no room, nothing can be written, or others have that name before theirs.
    """
    buffers = [
        EpisodeBuffer(
            id=index,
            seed=demonstration.seed,
            observations=_stored(demonstration.observations),
            actions=list(demonstration.actions),
            rewards=demonstration.rewards.tolist(),
            terminations=_only_at_end(demonstration, demonstration.terminated),
            truncations=_only_at_end(demonstration, demonstration.truncated),
            infos={},
        )
        for index, demonstration in enumerate(collection.demonstrations)
    ]
    root = datasets_folder()
    try:
        with files.only_process_in(root / LOCK, wait=True):
            final = get_dataset_path(name)
            if final.exists() and not exists(name):
                raise UserError(f"{name!r} is a folder of data sets: name another")
            files.check_room(root, _room(collection.demonstrations))
            for left_over in root.glob(f"{SCRATCH}*"):  # by a program that was killed
                _put_back(left_over / BEFORE, root)
                shutil.rmtree(left_over, ignore_errors=True)
            # Minari lists no hidden folders: nothing is a data set before it is whole.
            scratch = Path(tempfile.mkdtemp(prefix=SCRATCH, dir=root))
            whole = scratch / "whole"
            _write(whole, buffers, domain, {"dataset_id": name, "description": description})
            final.parent.mkdir(parents=True, exist_ok=True)
            if final.exists():
                before = scratch / BEFORE / name
                before.parent.mkdir(parents=True)
                final.rename(before)
            whole.rename(final)
            files.flush(final.parent)
            shutil.rmtree(scratch, ignore_errors=True)
    except UserError:
        raise
    except Exception as error:  # noqa: BLE001  (h5py and Minari raise many kinds)
        raise UserError(
            f"cannot write the data set {name!r} to {root} ({first_line(error)}): make room, or "
            "name another folder in MINARI_DATASETS_PATH"
        ) from None


def _room(demonstrations: Sequence[Demonstration]) -> int:
    """How many bytes demonstrations may take on the disk; nothing is compressed."""
    arrays = jax.tree.leaves([each[:5] for each in demonstrations])
    return sum(2 * np.asarray(each).nbytes + ARRAY_ROOM for each in arrays)


def _put_back(before: Path, root: Path) -> None:
    """Returns a data set that was to be replaced, where the program was killed in between."""
    for data in list(before.rglob("data")):
        name = data.parent.relative_to(before)
        if data.is_dir() and not (root / name).exists():
            data.parent.rename(root / name)


def datasets_folder() -> Path:
    """Minari's folder of data sets, made if it is not there.

    Raises:
        UserError: it cannot be made, or is no folder.
    """
    chosen = os.environ.get("MINARI_DATASETS_PATH")
    if chosen == "":
        raise UserError("MINARI_DATASETS_PATH is empty: name a folder in it, or unset it")
    try:
        return get_dataset_path().absolute()
    except OSError as error:
        raise UserError(
            f"no folder for data sets at {chosen or Path.home()} ({first_line(error)}): name "
            "another in MINARI_DATASETS_PATH"
        ) from None


def check_writable() -> None:
    """Refuses, before there is anything to write, a folder that cannot be written to.

    Raises:
        UserError: says which folder.
    """
    root = datasets_folder()
    if not os.access(root, os.W_OK):
        raise UserError(f"cannot write to {root}: name another folder in MINARI_DATASETS_PATH")


def _write(
    folder: Path, buffers: list[EpisodeBuffer], domain: Domain, details: dict[str, str]
) -> None:
    """A data set in a new folder."""
    folder.mkdir()
    storage = MinariStorage.new(
        folder / "data",
        observation_space=observation_space(domain.blank),
        action_space=gym.spaces.Discrete(domain.num_actions - 1),
        jpeg_encoding=False,  # grids are symbols, not pictures
    )
    storage.update_metadata(
        {
            "minari_version": minari.__version__,
            "algorithm_name": "a demonstrator",
            "author": {"leapjax"},
            **details,
        }
    )
    storage.update_episodes(buffers)
    for path in [*(folder / "data").iterdir(), folder / "data", folder]:
        files.flush(path)


def _stored(observations: PyTree) -> Any:
    if isinstance(observations, np.ndarray):
        return observations
    return {name: _stored(part) for name, part in _fields(observations).items()}


def _only_at_end(demonstration: Demonstration, value: bool) -> list[bool]:
    return [False] * (len(demonstration.actions) - 1) + [bool(value)]


def load(name: str, domain: Domain, most: int | None = None) -> Collection:
    """The demonstrations of a Minari data set, checked against a domain.

    Args:
        name: its id.
        domain: the level that it should be of. Where it can, it plays episodes again that were
            recorded with other observations; what is no demonstration then is dropped.
        most: so many are enough; None for all.

    Raises:
        UserError: missing, damaged, empty, or not of this domain's observations.
    """
    if not exists(name):
        raise UserError(
            f"no Minari data set {name!r} in {datasets_folder()}: "
            "check the id with `minari list local`"
        )
    version = _version(name)
    if version is not None and version < FORMAT:
        raise UserError(
            f"the data set {name!r} is of an earlier version, which kept no rewards: without "
            "--demonstrations it is made anew"
        )
    folder = get_dataset_path(name) / "data"
    with _reading(name):
        metadata = _read_metadata(folder)
        outlines = _inspect(folder, metadata)
        recorded = described(name)._replace(spaces=_read_spaces(metadata, domain))
    _check_arguments(name, recorded, domain)
    with _reading(name):
        domain.check_recorded(recorded, f"the Minari data set {name!r}")
    for index, outline in enumerate(outlines):
        _check_outline(outline, domain, _name_episode(index, name))
    with _reading(name):
        _check_total(metadata, outlines)
    _check_memory(name, outlines[:most], domain)
    found: list[Demonstration] = []
    dropped: Counter[str] = Counter()
    for episode, seed in _episodes(name):
        if most is not None and len(found) >= most:
            break
        result = _demonstration(episode, seed, domain, _name_episode(episode.id, name))
        if isinstance(result, str):
            dropped[result] += 1
        else:
            found.append(result)
    _compare_with_play(name, recorded, domain, found)
    collection = Collection(found, dropped)
    if not found:
        only = f" that can be used, only {reasons(collection)}" if dropped else ""
        raise UserError(f"the Minari data set {name!r} has no episodes{only}")
    return collection


def _compare_with_play(
    name: str, recorded: Described, domain: Domain, found: Sequence[Demonstration]
) -> None:
    """Warns if the environment answers the seed and the actions of an episode in another way.

    A data set need not say how its environment was made: Minari leaves that out if a wrapper was
    given a function. The first episode with a known seed is played again, for some steps.
    """
    if _version(name) is not None or domain.replay is not None:  # made here, or all played again
        return
    known = next((each for each in found if each.seed != UNKNOWN_SEED), None)
    problem = None
    if known is not None:
        with closing(domain.make_adapter()) as adapter:
            problem = _find_difference(adapter, known)
    elif found and recorded.level is None:
        problem = "the data name neither their environment nor the seeds of its resets"
    if problem is not None:
        warnings.warn(
            f"{name} may not have been recorded in {domain.level} as it is played: {problem}; look "
            "for wrappers, other arguments or another version",
            stacklevel=3,
        )


def _find_difference(adapter: Adapter, recorded: Demonstration) -> str | None:
    """Says where an episode that is played again first differs from its recording."""

    def differs(played: Any, stored: Any) -> bool:
        pairs = zip(jax.tree.leaves(played), jax.tree.leaves(stored), strict=True)
        return not all(np.allclose(one, other, rtol=1e-4, atol=1e-5) for one, other in pairs)

    def state(step: int) -> PyTree:
        return jax.tree.map(lambda leaf: leaf[step], recorded.observations)

    again = f"an episode that is played again with its seed {recorded.seed} has another"
    if differs(adapter.reset(recorded.seed), state(0)):
        return f"{again} first observation"
    for step, action in enumerate(recorded.actions[:COMPARED]):
        found = adapter.step(int(action))
        if differs(found.reward, recorded.rewards[step]):
            return f"{again} reward at step {step}"
        if differs(found.observation, state(step + 1)):
            return f"{again} observation after step {step}"
        if found.terminated or found.truncated:
            break
    return None


def _name_episode(episode: int, name: str) -> str:
    return f"episode {episode} of the Minari data set {name!r}"


def _version(name: str) -> int | None:
    """Of a data set that was made here, by its id; None: it is somebody else's."""
    found = re.fullmatch(r"leapjax/.*/bot-.*-v(\d+)", name)
    return int(found[1]) if found else None


def _check_arguments(name: str, recorded: Described, domain: Domain) -> None:
    """Refuses data of an environment that was made with other arguments than it is played with.

    Raises:
        UserError: says which, and how to have them.
    """
    if domain.arguments is None or recorded.arguments is None:
        return
    # How an environment is looked at changes nothing.
    wanted, played = (
        {key: value for key, value in arguments.items() if key != "render_mode"}
        for arguments in (recorded.arguments, domain.arguments)
    )
    if wanted != played:
        raise UserError(
            f"{name} was recorded in {domain.level} with other arguments than it is played with: "
            f"give --arguments '{json.dumps(wanted)}'"
        )


def reasons(collection: Collection) -> str:
    """What was dropped, and why, in words."""
    return ", ".join(f"{count} {reason}" for reason, count in collection.dropped.items())


@contextlib.contextmanager
def _reading(name: str) -> Iterator[None]:
    """Says in one line that a data set is damaged, whatever h5py and Minari raise."""
    try:
        yield
    except UserError:
        raise
    except Exception as error:  # noqa: BLE001
        again = "delete it and it is made again, or " if _version(name) is not None else ""
        raise UserError(
            f"the Minari data set {name!r} cannot be read ({first_line(error)}): {again}restore it"
        ) from None


def _episodes(name: str) -> Iterator[tuple[EpisodeData, int]]:
    """The episodes of an inspected data set, one by one, and the seeds of their resets.

    Raises:
        UserError: it is damaged.
    """
    with _reading(name):
        dataset = minari.load_dataset(name)
        metadata = list(dataset.storage.get_episode_metadata(dataset.episode_indices))
        for episode, details in zip(dataset.iterate_episodes(), metadata, strict=True):
            yield episode, _seed(details.get("seed"))


def _seed(value: Any) -> int:
    """The seed of a reset as a data set holds it: of 64 bits, which is all that it can hold.

    Anything else is unknown, so that a demonstration can always be stored again.
    """
    try:
        return check_integer("the seed of an episode", value, 0, 2**64 - 1)
    except UserError:
        return UNKNOWN_SEED


def _demonstration(
    episode: EpisodeData, seed: int, domain: Domain, where: str
) -> Demonstration | str:
    """An episode as it was stored, or played again; or why it cannot be used."""
    actions = _actions(episode.actions, where)
    rewards = _rewards(episode.rewards, where)
    terminated, truncated = (
        _read_mark(getattr(episode, marks), f"{where}: {marks}") for marks in STEPWISE[2:]
    )
    if domain.replay is not None:
        again = domain.replay(
            Recording(episode.observations, actions.astype(np.int64), rewards, seed)
        )
        if again is not None:
            return again
    found = Demonstration(episode.observations, actions, rewards, terminated, truncated, seed)
    return check_demonstration(found, domain, where)


def check_demonstration(given: Demonstration, domain: Domain, where: str) -> Demonstration:
    """Returns a demonstration in the types that a domain's network reads.

    Args:
        given: one episode.
        domain: the level that it should be of.
        where: what it is, for messages.

    Raises:
        UserError: actions that the domain does not have; observations or rewards of other shapes
            or types; numbers that are out of range.
    """
    actions, rewards = _actions(given.actions, where), _rewards(given.rewards, where)
    last = domain.num_actions - 2
    if actions.max() > last:
        raise UserError(
            f"{where}: actions run from {actions.min()} to {actions.max()}, expected 0 to {last}"
        )
    if rewards.shape != actions.shape:
        raise UserError(f"{where}: rewards of shape {rewards.shape}, actions of {actions.shape}")
    observations = _like(domain.blank, given.observations, where)
    _check_shapes(observations, domain, len(actions) + 1, where)
    domain.check(observations, where)

    def narrowed(path: Any, values: np.ndarray, like: np.ndarray) -> np.ndarray:
        name = jax.tree_util.keystr(path, simple=True) or "observations"
        return check_fits(f"{where}: {name}", values, like.dtype)

    return given._replace(
        observations=jax.tree.map_with_path(narrowed, observations, domain.blank),
        actions=actions.astype(np.int32),
        rewards=rewards,
    )


def described(name: str) -> Described:
    """What a data set says of itself, as far as it does."""
    path = datasets_folder() / name / "data" / "metadata.json"
    try:
        metadata = json.loads(files.read_text(path))
        count = metadata.get("total_episodes")
    except (OSError, ValueError, AttributeError, RecursionError):
        return Described()
    known = Described(episodes=count if isinstance(count, int) and count > 0 else None)
    try:
        spec = json.loads(metadata["env_spec"])
        level, arguments, most = spec["id"], spec.get("kwargs"), spec.get("max_episode_steps")
        wrappers = spec.get("additional_wrappers")
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return known
    listed = isinstance(wrappers, list) and all(isinstance(each, dict) for each in wrappers)
    return known._replace(
        level=level if isinstance(level, str) else None,
        arguments=arguments if isinstance(arguments, dict) else None,
        wrappers=wrappers if listed else None,
        max_steps=most if isinstance(most, int) else None,
    )


def _read_spaces(metadata: dict[str, Any], domain: Domain) -> dict[str, gym.Space]:
    """The spaces of inspected data, but for one that `save` has made of shapes and types."""
    found = {name.removesuffix("_space"): deserialize_space(metadata[name]) for name in SPACES}
    if found["observation"] == observation_space(domain.blank):
        del found["observation"]
    return found


def _inspect(folder: Path, metadata: dict[str, Any]) -> list[PyTree]:
    """Refuses what must not even be opened by Minari and HDF5; reads no array.

    Without its spaces Minari makes the environment that the data names, which runs code of
    the data's choice. Sizes that are only claimed, and files elsewhere that are linked to,
    would be read.

    Returns:
        An outline of each episode: see `_outline`.

    Raises:
        ValueError: says what.
    """
    if metadata.get("data_format") != "hdf5":
        raise ValueError(f"its format is {metadata.get('data_format')!r}, expected 'hdf5'")
    for name in SPACES:
        if not isinstance(metadata.get(name), str):
            raise ValueError(f"metadata.json has no {name}")
        _check_sizes(json.loads(metadata[name]))
    spaces = [deserialize_space(metadata[name]) for name in SPACES]
    jpeg = bool(metadata.get("jpeg_encoding", True))  # as Minari reads it
    path = folder / "main_data.hdf5"
    with h5py.File(path) as file:
        total = metadata.get("total_episodes")
        if not isinstance(total, int) or total != len(file):
            raise ValueError(f"{total} episodes are announced, {len(file)} are there")
        outlines = _outline(file, path.stat().st_size)
        names = [f"episode_{index}" for index in range(total)]
        missing = [name for name in names if not isinstance(outlines.get(name), dict)]
        if missing:
            raise ValueError(f"{missing[0]} is not there")
        episodes = [outlines[name] for name in names]
        for index, outline in enumerate(episodes) if jpeg else ():
            for part, space in zip(("observations", "actions"), spaces, strict=True):
                if part in outline:
                    stored = file[names[index]][part]
                    outline[part] = _with_frames(outline[part], stored, space)
    return episodes


def _read_metadata(folder: Path) -> dict[str, Any]:
    try:
        text = files.read_text(folder / "metadata.json")
    except UserError as error:  # whoever inspects says what to do
        raise ValueError(str(error)) from None
    metadata = json.loads(text)
    if not isinstance(metadata, dict):
        raise ValueError("metadata.json is not a JSON object")
    return metadata


def _check_sizes(space: Any) -> None:
    """No space may ask for more than a picture's worth of bounds."""
    if isinstance(space, dict):
        for key in ("shape", "n"):
            numbers = space.get(key)
            sizes = numbers if isinstance(numbers, list) else [numbers]
            sizes = [size for size in sizes if isinstance(size, int)]
            if space.get("type") != "Discrete" and math.prod(sizes) > LARGEST_SPACE:
                raise ValueError(f"a space of shape {numbers}")
        space = list(space.values())
    if isinstance(space, list):
        for part in space:
            _check_sizes(part)


def _outline(file: h5py.File, file_size: int) -> dict[str, Any]:
    """Says which arrays a file holds, without reading them.

    Its objects have to be a tree, as Minari writes it: where an object has two names, whoever
    follows all names may never come to an end.

    Returns:
        A dictionary by name; for each group one like it, and for each array one of its shape and
        type that takes no memory.

    Raises:
        ValueError: links, an object of two names, groups too deep, arrays that are not in the file.
    """
    outline: dict[str, Any] = {}
    known = {_identity(file)}
    groups: list[tuple[h5py.Group, dict[str, Any], int]] = [(file, outline, 0)]
    while groups:
        group, found, depth = groups.pop()
        if depth > DEEPEST:
            raise ValueError(f"{group.name[:60]} is a group in {depth} groups")
        for name in group:
            if not isinstance(group.get(name, getlink=True), h5py.HardLink):
                raise ValueError(f"{name} is a link to somewhere else")
            item = group[name]
            identity = _identity(item)
            if identity in known:
                raise ValueError(f"{name} is an object that has another name too")
            known.add(identity)
            if isinstance(item, h5py.Group):
                found[name] = {}
                groups.append((item, found[name], depth + 1))
                continue
            if not isinstance(item, h5py.Dataset) or item.external or item.is_virtual:
                raise ValueError(f"{name} is not an array of this file")
            array = found[name] = np.broadcast_to(np.zeros((), item.dtype), item.shape)
            # gzip makes at most 1 byte of 1032.
            if array.nbytes > 1032 * item.id.get_storage_size() + 1024:
                raise ValueError(f"{name} claims {array.nbytes} bytes, which are not there")
            if array.dtype.hasobject:
                _check_varying(item, name, file_size)
    return outline


def _identity(item: Any) -> tuple[int, int]:
    """Tells the objects of HDF5 files apart, whatever names lead to them."""
    info = h5py.h5o.get_info(item.id)
    return info.fileno, info.addr


def _check_varying(array: h5py.Dataset, name: str, file_size: int) -> None:
    """Refuses elements of varying length that are longer together than the file they are in."""
    total, at_once = 0, max(16, SLAB // file_size)
    for start in range(0, array.shape[0] if array.shape else 0, at_once):
        total += sum(len(each) for each in np.ravel(array[start : start + at_once]))
        if total > file_size:
            raise ValueError(f"{name} claims {total} bytes, which are not there")


def _with_frames(outline: Any, stored: Any, space: gym.Space) -> Any:
    """The outline of what Minari makes of stored arrays, some of which are JPEG frames.

    Raises:
        ValueError: a frame of another size than the space says.
    """
    if isinstance(space, gym.spaces.Dict | gym.spaces.Tuple) and isinstance(outline, dict):
        parts = (
            dict(space.spaces)
            if isinstance(space, gym.spaces.Dict)
            else {f"_index_{index}": part for index, part in enumerate(space.spaces)}
        )
        return {
            name: _with_frames(part, stored[name], parts[name]) if name in parts else part
            for name, part in outline.items()
        }
    if not is_image_space(space) or isinstance(outline, dict):
        return outline
    assert space.shape is not None  # of an image
    largest = 2 * math.prod(space.shape) + 4096  # bytes, of a frame in a file
    for start in range(0, len(stored), at_once := max(1, SLAB // largest)):
        for frame in stored[start : start + at_once]:
            with Image.open(io.BytesIO(frame)) as image:  # reads the header
                shape = (image.height, image.width, len(image.getbands()))
            if shape[: len(space.shape)] != space.shape or len(frame) > largest:
                raise ValueError(
                    f"a frame of shape {shape} in {len(frame)} bytes, its space is {space.shape}"
                )
    return np.broadcast_to(np.zeros((), np.uint8), (len(stored), *space.shape))


def _check_outline(outline: PyTree, domain: Domain, where: str) -> None:
    """Refuses an episode by the shapes and types of its arrays, before they are read.

    Raises:
        UserError: arrays are missing, or their lengths contradict each other or the domain.
    """
    for part in ("observations", *STEPWISE):
        if part not in outline:
            raise UserError(f"{where} has no {part}")
    steps = _numbers(np.zeros((), np.int64), outline["actions"], f"{where}: actions").shape
    if len(steps) != 1:
        raise UserError(f"{where}: actions have shape {steps}, expected one per step")
    if steps == (0,):
        raise UserError(f"{where} has no actions")
    for part in STEPWISE[1:]:
        if np.shape(outline[part]) != steps:
            raise UserError(
                f"{where}: {part} have shape {np.shape(outline[part])}, expected {steps}"
            )
    stored = outline["observations"]
    # Others may be played again.
    if domain.replay is None or _holds_fields(domain.blank, stored):
        observations = _like(domain.blank, stored, where)
        _check_shapes(observations, domain, steps[0] + 1, where)


def _holds_fields(blank: PyTree, stored: Any) -> bool:
    dictionaries = isinstance(stored, dict) and not isinstance(blank, np.ndarray)
    return dictionaries and set(_fields(blank)) <= set(stored)


def _check_total(metadata: dict[str, Any], outlines: Sequence[PyTree]) -> None:
    """Refuses data whose episodes are not as long together as they say.

    Raises:
        ValueError: says how long they are.
    """
    steps = sum(len(outline["actions"]) for outline in outlines)
    announced = metadata.get("total_steps")
    if announced != steps:
        raise ValueError(f"{announced} steps are announced, {steps} are there")


def _check_memory(name: str, outlines: Sequence[PyTree], domain: Domain) -> None:
    """Refuses, before anything is unpacked, what does not fit into memory.

    Raises:
        UserError: says how much would be needed.
    """
    state = sum(leaf.nbytes for leaf in jax.tree.leaves(domain.blank))
    kept = sum((len(outline["actions"]) + 1) * (state + 8) for outline in outlines)
    read = [sum(leaf.nbytes for leaf in jax.tree.leaves(outline)) for outline in outlines]
    # While an episode is checked, it is in memory twice.
    files.check_memory(kept + 2 * max(read, default=0), f"the Minari data set {name!r}")


def _actions(values: Any, where: str) -> np.ndarray:
    """The actions of an episode `[n]`, n > 0, in the type that they are stored in."""
    actions = _numbers(np.zeros((), np.int64), values, f"{where}: actions")
    if actions.ndim != 1 or not actions.size:
        raise UserError(f"{where}: actions have shape {actions.shape}, expected one per step")
    if actions.min() < 0 or actions.max() > MOST:
        raise UserError(
            f"{where}: actions run from {actions.min()} to {actions.max()}, expected 0 or more"
        )
    return actions


def _rewards(values: Any, where: str) -> np.ndarray:
    rewards = _numbers(np.zeros((), np.float32), values, f"{where}: rewards")
    return check_fits(f"{where}: rewards", rewards, np.dtype(np.float32))


def _read_mark(marks: Any, what: str) -> bool:
    """How an episode ended, from a mark `[n]` for each of its steps.

    Raises:
        UserError: marks that are neither true nor false, or an end before the last step.
    """
    values = np.asarray(marks)
    if values.dtype.kind not in "biuf" or not np.isin(values, (0, 1)).all():
        raise UserError(f"{what} must be true or false")
    if values[:-1].any():
        step = int(np.argmax(values != 0))
        raise UserError(
            f"{what} say that the episode ended with step {step}, and it goes on to step "
            f"{len(values) - 1}: split it there"
        )
    return bool(values[-1])


def _like(blank: PyTree, stored: Any, where: str, name: str = "observations") -> PyTree:
    """What was stored, in the structure of `blank`, in the types that it is stored in."""
    if isinstance(blank, np.ndarray):
        return _numbers(blank, stored, f"{where}: {name}")
    stored = stored._asdict() if hasattr(stored, "_asdict") else stored
    parts = _fields(blank)
    missing = [part for part in parts if not isinstance(stored, dict) or part not in stored]
    if missing:
        raise UserError(
            f"{where} has no observation {missing[0]!r}: "
            f"expected a dictionary of {', '.join(parts)}"
        )
    values = {part: _like(x, stored[part], where, part) for part, x in parts.items()}
    return type(blank)(**values)


def _numbers(blank: np.ndarray, values: Any, what: str) -> np.ndarray:
    array = np.asarray(values)
    if blank.dtype == bool:
        if array.dtype != bool:
            raise UserError(f"{what} must be true or false, got {array.dtype}")
        return array
    if np.issubdtype(blank.dtype, np.integer):
        if not np.issubdtype(array.dtype, np.integer):
            raise UserError(f"{what} must be integers, got {array.dtype}")
        return array
    if not np.issubdtype(array.dtype, np.number) or np.iscomplexobj(array):
        raise UserError(f"{what} must be numbers, got {array.dtype}")
    return array


def _check_shapes(observations: PyTree, domain: Domain, states: int, where: str) -> None:
    found = jax.tree.leaves(observations)
    for (path, blank), array in zip(jax.tree.leaves_with_path(domain.blank), found, strict=True):
        name = jax.tree_util.keystr(path, simple=True) or "observations"
        if array.shape != (states, *blank.shape):
            raise UserError(
                f"{where}: {name} has shape {array.shape}, level {domain.level} needs "
                f"{(states, *blank.shape)}"
            )


def exists(name: str) -> bool:
    """Whether a data set of that id is in the local Minari folder."""
    # A folder without data is a namespace: others may be below it.
    try:
        return (datasets_folder() / name / "data").exists()
    except OSError:  # no file may have that name, or nobody may look
        return False
