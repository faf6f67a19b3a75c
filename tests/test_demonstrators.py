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
def play_once(name: str, seed: int = 0, noise: float = 0.0, most_steps: int = 12) -> PlayedGame:
    return play(GAMES[name], seed, noise, most_steps)


def play_at_random(name: str, steps: int) -> float:
    emulator, rng = Emulator(GAMES[name]), np.random.default_rng(0)
    return sum(emulator.step(int(rng.integers(emulator.num_actions))) for _ in range(steps))


def are_equal(first_game: PlayedGame, second_game: PlayedGame) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(first_game, second_game, strict=True))


@games
def test_frames_and_rewards_match_the_native_environment(name):
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
        if emulator.over:  # the native environment stops within the last four frames
            break
        observations, rewards, *_ = native.step(np.array([action]))
        assert reward == rewards[0]
        np.testing.assert_array_equal(emulator.frame(), observations[0, -1])
    native.close()


@games
def test_a_restored_game_continues_identically(name):
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
def test_seed_and_noise_determine_a_game(name):
    game, noisy = play_once(name, noise=0.5), play_once(name, noise=1.0)
    assert game.frames.shape == (12, 84, 84) and game.frames.dtype == np.uint8
    assert game.actions.dtype == np.int32 and game.rewards.dtype == np.float32
    assert game.score == game.rewards.sum()
    assert are_equal(game, play(GAMES[name], 0, 0.5, 12))
    assert not are_equal(game, play_once(name, seed=1, noise=0.5))
    assert len(set(noisy.actions)) >= 4 and not are_equal(play_once(name), noisy)
    levels = [choose_noise(GAMES[name], number) for number in range(6)]
    assert levels[:3] == levels[3:] == sorted(set(levels)) and 0 < levels[0] < levels[2] <= 0.7
    emulator = Emulator(GAMES[name])
    starts = np.random.default_rng(np.random.SeedSequence(0).spawn(3)[0])
    emulator.reset(int(starts.integers(31)))
    for frame, action, reward in zip(game.frames, game.actions, game.rewards, strict=True):
        np.testing.assert_array_equal(emulator.frame(), frame)
        assert emulator.step(int(action)) == reward


@games
def test_recorded_games_are_reproduced(name):
    """Raise a game's version in `RULES` if its demonstrator was changed and this fails."""
    recorded = json.loads((ROOT / "results/atari-data.json").read_text())[name]
    shortest = min(recorded, key=lambda game: game["transitions"])
    game = play(GAMES[name], shortest["seed"], shortest["noise"], LONGEST)
    assert (len(game.actions), game.score) == (shortest["transitions"], shortest["score"])


def test_demonstrators_play_well_and_never_wait():
    """Agents that learn to wait never stop waiting, so demonstrators always act."""
    assert not (play_once("Pong", most_steps=200).rewards < 0).any()
    assert play_at_random("Pong", 200) < 0
    for name, seed, steps, score, lowest_action in (
        ("Breakout", 0, 250, 8, 1),
        ("Qbert", 0, 80, 100, 2),
        ("Seaquest", 1, 1500, 1500, 1),  # shoots, collects divers, stays alive
    ):
        game = play_once(name, seed=seed, most_steps=steps)
        assert game.score >= score and (game.actions >= lowest_action).all()
    assert len(game.actions) == 1500 and play_at_random("Seaquest", 1500) < 500


def test_read_scene_matches_the_screen_of_seaquest():
    emulator, demonstrator = Emulator(GAMES["Seaquest"]), make_demonstrator(GAMES["Seaquest"])
    emulator.reset(0)
    checked = 0
    for step in range(600):
        emulator.step(demonstrator(emulator, np.random.default_rng(0)))
        scene = read_scene(emulator.ram())
        for across, lane, _ in scene.enemies + scene.divers if step % 15 == 14 else ():
            rows, column = slice(56 - 10 * lane, 62 - 10 * lane), across * 84 // 160
            assert emulator.frame()[rows, max(column - 2, 0) : column + 9].max() > 40  # water: 32
            checked += 1
    assert checked > 20
