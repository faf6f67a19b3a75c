import functools
import json

import numpy as np
import pytest

pytest.importorskip("ale_py")  # an extra

from ale_py.vector_env import AtariVectorEnv

from leapjax.domains.atari.demonstrators.playing import (
    PlayedGame,
    choose_noise,
    make_demonstrator,
    play,
)
from leapjax.domains.atari.demonstrators.seaquest import read_scene
from leapjax.domains.atari.domain import LONGEST
from leapjax.domains.atari.emulator import Emulator
from leapjax.domains.atari.games import GAMES
from tests.programs import ROOT

games = pytest.mark.parametrize("name", GAMES)


@functools.cache
def played(name: str, seed: int = 0, noise: float = 0.0, most_steps: int = 12) -> PlayedGame:
    return play(GAMES[name], seed, noise, most_steps)


def play_at_random(name: str, steps: int) -> float:
    emulator, rng = Emulator(GAMES[name]), np.random.default_rng(0)
    return sum(emulator.step(int(rng.integers(emulator.num_actions))) for _ in range(steps))


def same(one: PlayedGame, other: PlayedGame) -> bool:
    return all(np.array_equal(mine, yours) for mine, yours in zip(one, other, strict=True))


@games
def test_frames_and_rewards_are_those_of_the_native_environment(name):
    game = GAMES[name]
    native = AtariVectorEnv(
        game.rom, 1, noop_max=0, use_fire_reset=False, reward_clipping=False, num_threads=1
    )
    emulator = Emulator(game)
    assert emulator.num_actions == native.single_action_space.n == len(game.actions)
    observations, _ = native.reset(seed=0)
    np.testing.assert_array_equal(emulator.frame(), observations[0, -1])
    for action in np.random.default_rng(0).integers(emulator.num_actions, size=200).tolist():
        reward = emulator.step(action)
        if emulator.over:  # the native one stops in the middle of the last four frames
            break
        observations, rewards, *_ = native.step(np.array([action]))
        assert reward == rewards[0]
        np.testing.assert_array_equal(emulator.frame(), observations[0, -1])
    native.close()


@games
def test_a_restored_game_goes_on_the_same(name):
    emulator = Emulator(GAMES[name])
    actions = np.random.default_rng(0).integers(emulator.num_actions, size=60).tolist()
    for action in actions[:30]:
        emulator.step(action)
    saved, frame = emulator.save(), emulator.frame()

    def future(step):
        emulator.restore(saved)
        assert emulator.action == actions[29]
        np.testing.assert_array_equal(emulator.frame(), frame)
        return [(step(action), emulator.lives, *emulator.ram()) for action in actions[30:]]

    first, last = future(emulator.step), emulator.frame()
    assert future(emulator.advance) == first == future(emulator.step)
    np.testing.assert_array_equal(emulator.frame(), last)


@games
def test_a_game_is_what_its_seed_and_noise_say_and_can_be_played_again(name):
    game, noisy = played(name, noise=0.5), played(name, noise=1.0)
    assert game.frames.shape == (12, 84, 84) and game.frames.dtype == np.uint8
    assert game.actions.dtype == np.int32 and game.rewards.dtype == np.float32
    assert game.score == game.rewards.sum()
    assert same(game, play(GAMES[name], 0, 0.5, 12))
    assert not same(game, played(name, seed=1, noise=0.5))
    assert len(set(noisy.actions)) >= 4 and not same(played(name), noisy)
    levels = [choose_noise(GAMES[name], number) for number in range(6)]
    assert levels[:3] == levels[3:] == sorted(set(levels)) and 0 < levels[0] < levels[2] <= 0.7
    emulator = Emulator(GAMES[name])
    starts = np.random.default_rng(np.random.SeedSequence(0).spawn(3)[0])
    emulator.reset(int(starts.integers(31)))
    for frame, action, reward in zip(game.frames, game.actions, game.rewards, strict=True):
        np.testing.assert_array_equal(emulator.frame(), frame)
        assert emulator.step(int(action)) == reward


@games
def test_recorded_games_are_played_again(name):
    """If this fails because a rule was changed, `_RULES` is to be raised."""
    recorded = json.loads((ROOT / "results/atari-data.json").read_text())[name]
    shortest = min(recorded, key=lambda game: game["transitions"])
    game = play(GAMES[name], shortest["seed"], shortest["noise"], LONGEST)
    assert (len(game.actions), game.score) == (shortest["transitions"], shortest["score"])


def test_demonstrators_play_well_and_never_wait():
    """To do nothing asks for something, too: it shall not be learned as a moment apart."""
    assert not (played("Pong", most_steps=200).rewards < 0).any()
    assert play_at_random("Pong", 200) < 0
    for name, seed, steps, score, least in (
        ("Breakout", 0, 250, 8, 1),
        ("Qbert", 0, 80, 100, 2),
        ("Seaquest", 1, 1500, 1500, 1),  # it shoots, fetches divers and stays alive
    ):
        game = played(name, seed=seed, most_steps=steps)
        assert game.score >= score and (game.actions >= least).all()
    assert len(game.actions) == 1500 and play_at_random("Seaquest", 1500) < 500


def test_seaquest_sees_what_is_on_the_screen():
    emulator, demonstrator = Emulator(GAMES["Seaquest"]), make_demonstrator(GAMES["Seaquest"])
    emulator.reset(0)
    seen = 0
    for step in range(600):
        emulator.step(demonstrator(emulator, np.random.default_rng(0)))
        scene = read_scene(emulator.ram())
        for across, lane, _ in scene.enemies + scene.divers if step % 15 == 14 else ():
            rows, column = slice(56 - 10 * lane, 62 - 10 * lane), across * 84 // 160
            assert emulator.frame()[rows, max(column - 2, 0) : column + 9].max() > 40  # water: 32
            seen += 1
    assert seen > 20
