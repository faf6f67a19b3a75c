import functools
import itertools
from collections import Counter
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from minigrid.envs.babyai.core.verifier import AfterInstr, BeforeInstr

from leapjax.domains.babyai import demonstrations, levels, symmetries, vocabulary
from leapjax.domains.babyai.adapter import BabyAIAdapter
from leapjax.domains.babyai.observations import Observation
from leapjax.domains.babyai.symmetries import Renaming
from tests.dynamics import FRONT, stepped
from tests.oracles import assert_same_observation

LEFT, RIGHT, FORWARD, PICKUP, DROP, TOGGLE = range(6)
EMPTY, DOOR, KEY, BALL, BOX, AGENT = 1, 4, 5, 6, 7, 10
OPEN, CLOSED, LOCKED = 0, 1, 2
# Rooms, open doors, closed doors, locked doors with a key, things to pick up.
LEVELS = (
    "GoToLocalS8N7",
    "GoToObjMazeS4",
    "GoToObjMazeS4R2Close",
    "PickUpLoc",
    "GoToSeqS5R2",
    "BabyAI-KeyCorridorS3R3-v0",
)
MIRRORED = jnp.asarray(vocabulary.mirrored_words())

rotate = jax.jit(symmetries.rotate)
reflect = jax.jit(symmetries.reflect)
rename = jax.jit(symmetries.rename)
rotate_all, reflect_all, rename_all = (
    jax.jit(jax.vmap(transform, in_axes=(0, None)))
    for transform in (symmetries.rotate, symmetries.reflect, symmetries.rename)
)


def front(observation: Observation) -> np.ndarray:
    """Returns the cell that the agent faces: object, colour and state."""
    x, y, direction = (int(v) for v in observation.pose)
    return observation.grid[x + FRONT[direction][0], y + FRONT[direction][1]]


def wander(adapter: BabyAIAdapter, rng: np.random.Generator) -> int:
    """Draws an action of a random walk that prefers to meet, carry, drop and open things."""
    faced = adapter.env.grid.get(*adapter.env.front_pos)
    if faced is not None and faced.type != "wall" and rng.random() < 0.7:
        return TOGGLE if faced.type == "door" else PICKUP
    if adapter.env.carrying and faced is None and rng.random() < 0.15:
        return DROP
    return int(rng.choice([LEFT, RIGHT, FORWARD, FORWARD]))


@functools.cache
def states(name: str) -> list[Observation]:
    """Samples states of random walks, and of the bot, which unlocks doors."""
    rng = np.random.default_rng(0)
    adapter = BabyAIAdapter(levels.find_level(name))
    found = []
    for seed in range(14):
        found.append(adapter.reset(seed))
        bot = demonstrations.FullViewBot(adapter.env) if seed >= 10 else None
        for _ in range(60):
            transition = adapter.step(int(bot.replan()) if bot else wander(adapter, rng))
            if transition.terminated:
                break
            found.append(transition.observation)
    # Interesting states are rare, so each kind is drawn separately.
    rare = (
        lambda o: front(o)[0] == DOOR,
        lambda o: front(o)[0] in (KEY, BALL, BOX) and not o.carried[0],
        lambda o: front(o)[0] == EMPTY and o.carried[0],
        lambda o: front(o)[2] == LOCKED and o.carried[0],
        lambda o: True,
    )
    chosen = set()
    for matches in rare:
        chosen.update(rng.permutation([i for i, o in enumerate(found) if matches(o)])[:8].tolist())
    return [found[int(i)] for i in sorted(chosen)]


def stack(trees: list) -> Observation:
    return jax.tree.map(lambda *leaves: np.stack(leaves), *trees)


def unstack(tree: Observation) -> list[Observation]:
    tree = jax.device_get(tree)
    return [jax.tree.map(lambda x, i=i: x[i], tree) for i in range(len(tree.pose))]


@functools.cache
def successors(name: str) -> list[list[Observation]]:
    """Returns the successors of `states` for each of the six actions."""
    return [[stepped(state, action) for state in states(name)] for action in range(6)]


def assert_equivariant(
    name: str,
    transform: Callable[[Observation], Observation],
    actions: Sequence[int] = range(6),
    skip: Callable[[Observation, int], bool] = lambda state, action: False,
) -> None:
    """Asserts that transforming then stepping equals stepping then transforming, in all states."""
    transformed = unstack(transform(stack(states(name))))
    for action in range(6):
        expected = unstack(transform(stack(successors(name)[action])))
        for before, state, after in zip(states(name), transformed, expected, strict=True):
            if not skip(before, action):
                assert_same_observation(stepped(state, actions[action]), after)


def test_states_exercise_every_action():
    changed, doors = Counter(), Counter()
    for name, action in itertools.product(LEVELS, range(6)):
        for before, after in zip(states(name), successors(name)[action], strict=True):
            changed[action] += not np.array_equal(after.grid, before.grid)
            is_door = before.grid[..., 0] == DOOR
            doors.update(zip(before.grid[is_door][:, 2], after.grid[is_door][:, 2], strict=True))
    assert all(changed[action] > 15 for action in range(6)), changed
    assert doors[LOCKED, OPEN] and doors[CLOSED, OPEN] and doors[OPEN, CLOSED]
    assert {int(state.carried[0]) for state in states("PickUpLoc")} == {0, KEY, BALL, BOX}


@pytest.mark.parametrize("name", LEVELS)
def test_rotating_reflecting_and_recolouring_commute_with_stepping(name):
    for quarters in (1, 2, 3):
        assert_equivariant(name, lambda batch, by=quarters: rotate_all(batch, by))
    swapped = symmetries.reflect_actions(jnp.arange(9)).tolist()
    assert swapped == [RIGHT, LEFT, 2, 3, 4, 5, 6, 7, 8]  # end, MASK and PAD included
    assert_equivariant(name, lambda batch: reflect_all(batch, MIRRORED), swapped)
    renaming = make_renaming([1, 2, 0, 5, 3, 4], {})
    assert_equivariant(name, lambda batch: rename_all(batch, renaming))
    # Rotating by the agent's direction makes the agent face right.
    batch = stack(states(name))
    turned = unstack(jax.jit(jax.vmap(symmetries.rotate))(batch, batch.pose[:, 2]))
    for before, after in zip(states(name), turned, strict=True):
        x, y, direction = after.pose
        assert direction == 0 and tuple(after.grid[x, y]) == (AGENT, 0, 0)
        assert front(after)[0] == front(before)[0]


def make_renaming(colours: Sequence[int], objects: dict[int, int]) -> Renaming:
    kinds = np.arange(11)
    words = np.arange(vocabulary.SIZE)
    words[vocabulary.colour_words()] = vocabulary.colour_words()[list(colours)]
    for old, new in objects.items():
        kinds[old] = new
        words[vocabulary.object_words((old,))] = vocabulary.object_words((new,))
    return Renaming(*(jnp.asarray(x, jnp.int32) for x in (colours, kinds, words)))


@pytest.mark.parametrize("name", LEVELS[:5])
@pytest.mark.parametrize("order", [(BALL, BOX, KEY), (KEY, BOX, BALL)])
def test_renaming_objects_commutes_with_stepping_without_locked_doors(name, order):
    renaming = make_renaming([5, 4, 3, 2, 1, 0], dict(zip((KEY, BALL, BOX), order, strict=True)))

    def opens_a_box(state: Observation, action: int) -> bool:
        # Only a box vanishes when toggled: it opens.
        return action == TOGGLE and front(state)[0] in (KEY, BALL, BOX)

    assert_equivariant(name, lambda batch: rename_all(batch, renaming), skip=opens_a_box)


def random_observation(seed: int, side: int, no_goal: bool) -> Observation:
    rng = np.random.default_rng(seed)
    x, y, direction = pose = (*rng.integers(0, side, 2), rng.integers(0, 4))
    grid = np.stack([rng.integers(0, high, (side, side)) for high in (10, 6, 3)], axis=-1)
    grid[x, y] = 10, 0, direction
    return Observation(
        grid.astype(np.uint8),
        np.array(pose, np.int32),
        np.array([rng.integers(5, 8), rng.integers(0, 6)], np.int32),
        np.array((-1, -1) if no_goal else rng.integers(0, side, 2), np.int32),
        rng.integers(0, vocabulary.SIZE, 6).astype(np.int32),
    )


any_observation = st.builds(
    random_observation, st.integers(0, 10**6), st.sampled_from([5, 8]), st.booleans()
)


@settings(max_examples=40, deadline=None)
@given(any_observation, st.integers(0, 3), st.integers(0, 7))
def test_rotations_and_reflections_form_a_group(state, first, second):
    assert_same_observation(rotate(rotate(state, first), second), rotate(state, first + second))
    assert_same_observation(rotate(state, 4), state)
    mirrored = jax.device_get(reflect(state, MIRRORED))
    assert_same_observation(reflect(mirrored, MIRRORED), state)
    # Reflecting reverses rotations.
    one = reflect(rotate(state, first), MIRRORED)
    assert_same_observation(one, rotate(mirrored, -first % 4))
    # The goal moves with its cell.
    for moved in (jax.device_get(rotate(state, first)), mirrored):
        if state.goal[0] < 0:
            assert tuple(moved.goal) == (-1, -1)
        else:
            np.testing.assert_array_equal(
                moved.grid[tuple(moved.goal)][:2], state.grid[tuple(state.goal)][:2]
            )


restate = jax.jit(lambda ids: symmetries.restate(ids, *vocabulary.joining_words()))


def test_restated_sequences_keep_their_meaning():
    """MiniGrid judges the original and the restated instruction alike at every step."""
    one, other = (BabyAIAdapter(levels.find_level("GoToSeqS5R2")) for _ in range(2))
    compared = 0
    for seed in range(40):
        state, task = one.reset(seed), one.env.instrs
        other.reset(seed)
        restated = np.asarray(restate(state.instruction))
        if not isinstance(task, BeforeInstr | AfterInstr):
            np.testing.assert_array_equal(restated, state.instruction)
            continue
        swapped = AfterInstr if isinstance(task, BeforeInstr) else BeforeInstr
        other.env.instrs = swapped(other.env.instrs.instr_b, other.env.instrs.instr_a)
        other.env.instrs.reset_verifier(other.env)
        assert vocabulary.decode(restated) == other.env.instrs.surface(other.env)
        bot, transition = demonstrations.FullViewBot(one.env), None
        while transition is None or not (transition.terminated or transition.truncated):
            action = int(bot.replan())
            transition, twin = one.step(action), other.step(action)
            assert (transition.terminated, transition.success) == (twin.terminated, twin.success)
        compared += transition.success
    assert compared > 10
