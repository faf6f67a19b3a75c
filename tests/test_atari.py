import functools
import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.flops import matmul_flops
from experiments import atari, atari_energy
from experiments.tables.atari import ENCODED
from leapjax.data import windows
from leapjax.domains.atari import augmentation, domain, encoders, replay
from leapjax.domains.atari.adapter import AtariAdapter
from leapjax.domains.atari.demonstrators import collect, playing
from leapjax.domains.atari.emulator import Emulator
from leapjax.domains.atari.games import GAMES
from leapjax.environments import Eager
from leapjax.errors import UserError
from leapjax.models.config import ModelConfig
from leapjax.pretrained import Origin
from leapjax.types import Demonstration, Energy
from tests.parameters import random_like
from tests.programs import only_long

PONG, BREAKOUT = GAMES["Pong"], GAMES["Breakout"]
MODEL = ModelConfig(width=16, layers=1, heads=1, dropout=0.0)


def frames(count, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (count, 84, 84)).astype(np.uint8)


def demonstration(length, seed=0):
    rng = np.random.default_rng(seed)
    actions = rng.integers(0, 4, length).astype(np.int32)
    rewards = rng.integers(0, 2, length).astype(np.float32)
    return Demonstration(frames(length + 1, seed), actions, rewards, True, False, -1)


def window(index, context=3, length=9):
    steps = jax.tree.map(jnp.asarray, windows.concatenate([demonstration(length)]))
    return windows.window(steps, index, context, 2, 4)


def play(adapter, seed, steps):
    """Plays a game with all actions in turn; returns its frames and transitions."""
    images, transitions = [adapter.reset(seed)], []
    while len(transitions) < steps and not (transitions and transitions[-1].truncated):
        transitions.append(adapter.step(len(transitions) % (adapter.num_actions - 1)))
        images.append(transitions[-1].observation)
        if transitions[-1].terminated:
            break
    return np.stack(images), transitions


def compile_encoder(encoder, context):
    """Compiles an encoder with random parameters."""
    params = random_like(jax.eval_shape(encoder.init, jax.random.key(0), context), 0.05)
    return functools.partial(jax.jit(encoder.apply), params)


def test_seed_and_stickiness_determine_a_game():
    first, again, other, sticky = (
        play(AtariAdapter(BREAKOUT, stickiness, 27_000), seed, 60)[0]
        for seed, stickiness in ((3, 0.0), (3, 0.0), (4, 0.0), (3, 1.0))
    )
    assert first.shape == (61, 84, 84) and first.dtype == np.uint8
    assert_equal(first, again)
    assert_equal(first[0], sticky[0])
    assert (first != other).any() and (first != sticky).any()


def test_games_are_truncated_at_the_maximum_length():
    images, transitions = play(AtariAdapter(PONG, 0.0, 40), 0, 100)
    assert transitions[-1].truncated and not transitions[-1].terminated
    assert 30 <= len(transitions) <= 40  # the no-ops at the start count too
    assert not transitions[-1].success and len(images) == len(transitions) + 1


def test_rewards_are_clipped_and_scores_are_not():
    adapter = AtariAdapter(GAMES["Qbert"], 0.0, 27_000)
    _, transitions = play(adapter, 0, 300)
    scores = {t.score for t in transitions}
    assert scores <= {0.0, 25.0, 50.0, 75.0, 100.0, 300.0, 500.0} and len(scores) > 1
    assert all(t.reward == min(t.score, 1.0) for t in transitions)
    assert adapter.score == sum(t.score for t in transitions)


def test_success_requires_the_score_of_a_human():
    easy = BREAKOUT._replace(human=0.0)
    over = [play(AtariAdapter(game, 0.0, 300), 0, 400)[1][-1].success for game in (easy, BREAKOUT)]
    assert over == [True, False]
    assert BREAKOUT.normalised(BREAKOUT.random) == 0
    assert BREAKOUT.normalised(BREAKOUT.human) == pytest.approx(100)


def test_a_state_is_the_last_four_frames():
    recorded = jnp.asarray(frames(6))
    states = np.asarray(encoders.stack_frames(recorded, 6))
    before = np.concatenate([np.zeros((3, 84, 84)), recorded])
    for index in range(6):
        assert_equal(states[index], np.moveaxis(before[index : index + 4], 0, -1))
    assert_equal(encoders.stack_frames(recorded, 1), states[-1:])
    assert_equal(encoders.stack_frames(recorded[:2], 1)[0], states[1])


@pytest.mark.parametrize("architecture", ["paper", "leapjax"])
def test_tokens_depend_only_on_the_four_frames_of_their_state(architecture):
    context = window(8, context=6).context
    made = domain.make("Breakout", domain.Settings())
    encode = compile_encoder(made.encoders[architecture](MODEL, 6), context)
    before = encode(context)
    assert before.shape == ((7, 16) if architecture == "paper" else (domain.TOKENS, 16))
    for i in range(6):
        past = context.past.at[i].set(255 - context.past[i])
        differs = np.abs(encode(context._replace(past=past)) - before).max(axis=1) > 1e-6
        if architecture == "paper":  # tokens of its own state and the next three
            assert_equal(differs, (np.arange(7) >= i) & (np.arange(7) < i + encoders.STACK))
        else:
            assert differs.all() if i >= 3 else not differs.any()


@pytest.mark.parametrize(("name", "past"), [("paper", 25), ("leapjax", 3)])
def test_table_counts_of_encoded_states_match_flops(name, past):
    encoder = domain.make("Breakout", domain.Settings()).encoders[name](MODEL, past)
    alone, whole = (window(past, context=n, length=30).context for n in (0, past))
    params = jax.eval_shape(encoder.init, jax.random.key(0), alone)
    single = matmul_flops(encoder.apply, params, alone)
    cache = jnp.zeros((past, MODEL.width))  # tokens of the earlier states
    encode_next = functools.partial(encoder.apply, method="encode_next")
    cached = matmul_flops(encode_next, params, whole, cache)
    assert cached == ENCODED[name] * single > 0


def test_without_past_frames_every_pixel_counts_as_changed():
    context = window(8, context=0).context
    outputs = encoders.compute_changes(encoders.stack_frames(encoders.join_frames(context), 1))[0]
    assert_equal(outputs[..., 1:3], 0)
    np.testing.assert_allclose(outputs[..., 3], encoders.CHANGES * outputs[..., 0], rtol=1e-5)


@pytest.mark.parametrize("name", GAMES)
def test_half_of_the_windows_are_mirrored(name):
    game, original = GAMES[name], window(5)
    past = frames(6, seed=1)
    ids = jnp.arange(len(game.actions) + 3)  # the end action, MASK and PAD included
    context = original.context._replace(observation=past[-1], past=past[:-1], actions=ids)
    original = original._replace(context=context, actions=ids[::-1])
    flip = functools.partial(augmentation.mirror_window, mirror=game.mirror, actions=game.actions)
    outputs = [jax.jit(flip)(jax.random.key(seed), original) for seed in range(40)]
    unchanged = [bool((each.actions == original.actions).all()) for each in outputs]
    assert 8 < sum(unchanged) < 32
    for each, equal in zip(outputs, unchanged, strict=True):
        expected = past if equal else np.stack([reflect(frame, game.mirror) for frame in past])
        assert_equal(each.context.past, expected[:-1])
        assert_equal(each.context.observation, expected[-1])
        assert_equal(each.context.actions, each.actions[::-1])
    mirrored = outputs[unchanged.index(False)].actions[::-1]
    assert_equal(mirrored[mirrored], ids)  # mirroring twice restores the actions
    assert_equal(mirrored[len(game.actions) :], ids[len(game.actions) :])


def reflect(frame, mirror):
    """Reflects a frame line by line: an oracle."""
    result = frame.copy()
    rows, columns = slice(*mirror.rows), slice(*mirror.columns)
    for line in range(*(mirror.columns if mirror.axis else mirror.rows)):
        if mirror.axis:
            result[rows, line] = frame[rows, sum(mirror.columns) - 1 - line]
        else:
            result[line, columns] = frame[sum(mirror.rows) - 1 - line, columns]
    return result


def assert_equal(found, expected):
    np.testing.assert_array_equal(found, expected)


# RAM addresses of a player's position: along the mirrored axis, then across it.
ADDRESSES = {"Breakout": (72,), "Qbert": (43, 67), "Pong": (51,), "Seaquest": (70, 97)}


@pytest.mark.parametrize("name", GAMES)
def test_mirrored_actions_move_in_opposite_directions(name):
    game = GAMES[name]
    emulator = Emulator(game)
    emulator.reset(20)
    hops = [3, 3] if name == "Qbert" else []  # away from the top
    for action in [1] * 40 + hops + [0] * 20:
        emulator.step(action)
    start = emulator.save()

    def position():
        return np.array([int(emulator.ram()[position]) for position in ADDRESSES[name]])

    def move(action):
        emulator.restore(start)
        before = position()
        for _ in range(6):
            emulator.step(game.actions.index(action))
        return position() - before

    pairs = {a: game.mirror.actions[a] for a in game.actions if a in game.mirror.actions}
    assert len(pairs) >= 2
    for ours, theirs in ((move(action), move(other)) for action, other in pairs.items()):
        assert ours[0] * theirs[0] < 0
        assert_equal(ours[1:], theirs[1:])


@pytest.fixture(scope="module")
def collected(tmp_path_factory):
    """Collects a few short games with the real command; returns their folder and its arguments."""
    folder = tmp_path_factory.mktemp("atari")
    command = ["collect", "--game", "Breakout", "--transitions", "900", "--longest", "80"]
    arguments = [*command, "--folder", str(folder), "--workers", "1"]
    assert atari.main(arguments) == 0
    return folder, arguments


def test_collected_games_match_their_manifest(collected):
    folder, _ = collected
    made = json.loads((folder / "Breakout" / "1" / "manifest.json").read_text())
    games = [game for manifest in made for game in manifest["games"]]
    found = replay.read(folder, BREAKOUT, 900, seed=0).demonstrations
    total = sum(game["transitions"] for game in games)
    assert 900 <= sum(len(d.actions) for d in found) <= total
    assert {game["noise"] for game in games} == {0.1, 0.3, 0.5}
    assert all(len(d.actions) <= 80 and d.observations.shape[1:] == (84, 84) for d in found)
    assert max(game["score"] for game in games) > 0


def make_planner(horizon):
    """An action costs its number plus 100 for each step before the window, times `params`."""
    planner, origin = SimpleNamespace(horizon=horizon), Origin("", 0, 0, None)
    specification = SimpleNamespace(level="Pong", context=0, planner=planner, origin=origin)

    def total(params, step, actions):
        return params * (actions + 100 * step).sum()

    energy = Energy(lambda params, context: context.step, None, total, 5)
    return SimpleNamespace(specification=specification, energy=energy, params=jnp.float32(2))


def make_game(actions, reward):
    """Makes a game with a reward for its last step."""
    rewards = np.where(np.arange(len(actions)) == len(actions) - 1, reward, 0).astype(np.float32)
    actions = np.array(actions, np.int32)
    return Demonstration(frames(len(actions) + 1), actions, rewards, True, False, -1)


def test_the_energy_of_a_game_is_the_mean_over_its_windows():
    # A game as long as a plan has a single window, and a shorter game is left out.
    played = [[0, 1, 2], [3, 3, 0], [2, 3, 3], [1, 0, 0], [3, 3]]
    means = [2 * sum(actions) / 3 for actions in played[:4]]
    games = [make_game(*each) for each in zip(played, [*np.negative(means), 50], strict=True)]
    found = atari_energy.correlate(make_planner(3), games, 4)
    np.testing.assert_allclose(found["energies"], means, rtol=1e-6)
    np.testing.assert_allclose(found["returns"], np.negative(means), rtol=1e-6)
    assert found["correlation"] == pytest.approx(-1)
    # A longer game has as many windows as requested: each starts at its first or second step.
    longer = make_game([1, 1, 1, 1], 1.0)
    found = atari_energy.correlate(make_planner(3), [longer, games[0]], 64)
    assert 40 < (found["energies"][0] - 2) / 2 < 60
    with pytest.raises(UserError, match="all 3 trajectories of Pong have one reward"):
        atari_energy.correlate(make_planner(2), [make_game([0, 1, 2], 0.0)] * 3, 2)


@only_long
def test_collecting_resumes_where_it_stopped(collected):
    folder, arguments = collected
    logs = replay.replay_logs(folder, BREAKOUT, 1)
    shard = logs / "$store$_observation_ckpt.0.gz"
    before, modified = shard.read_bytes(), shard.stat().st_mtime_ns
    assert collect.is_whole(folder, BREAKOUT, 900, 1, 80)
    assert not collect.is_whole(folder, BREAKOUT, 100_000, 1, 80)
    assert atari.main(arguments) == 0
    assert shard.stat().st_mtime_ns == modified  # all games were there already
    (logs / "manifest.0.json").unlink()  # as if the program had been killed
    assert not collect.is_whole(folder, BREAKOUT, 900, 1, 80)
    assert atari.main(arguments) == 0
    assert shard.stat().st_mtime_ns > modified and shard.read_bytes() == before


def test_collecting_does_not_replace_files_made_elsewhere(collected, tmp_path, capsys):
    folder, arguments = collected
    theirs = replay.replay_logs(tmp_path, BREAKOUT, 1)
    theirs.mkdir(parents=True)
    for path in replay.replay_logs(folder, BREAKOUT, 1).glob("*.gz"):
        shutil.copy(path, theirs)
    assert atari.main([*arguments, "--folder", str(tmp_path)]) == 2
    assert "holds files that were not made here" in capsys.readouterr().err
    assert not list(theirs.glob("manifest*"))


def test_collecting_rejects_games_with_other_rules(collected, tmp_path, monkeypatch, capsys):
    folder, arguments = collected
    shutil.copytree(folder, tmp_path / "copy")
    arguments = [*arguments, "--folder", str(tmp_path / "copy")]
    path = replay.replay_logs(tmp_path / "copy", BREAKOUT, 1) / "manifest.0.json"
    manifest = json.loads(path.read_text())
    assert (manifest.pop("demonstrator"), manifest.pop("rules")) == ("Paddle", 1)
    path.write_text(json.dumps({**manifest, "demonstrator": "Somebody", "rules": 1}))
    assert atari.main(arguments) == 2
    assert "Somebody with rules 1, and today's is Paddle with rules 1" in capsys.readouterr().err
    # Early manifests lack these fields: their games follow the first rules.
    path.write_text(json.dumps(manifest))
    assert atari.main(arguments) == 0
    monkeypatch.setitem(playing.RULES, "Breakout", 2)
    assert atari.main(arguments) == 2
    assert "with rules 1, and today's is Paddle with rules 2" in capsys.readouterr().err
    # Training still accepts these games.
    assert collect.find_shards(tmp_path / "copy", BREAKOUT, 100, 1) == range(1)


def test_a_folder_of_another_game_raises_an_error(collected, tmp_path, capsys):
    folder, arguments = collected
    shutil.copytree(folder / "Breakout" / "1", tmp_path / "Pong" / "1")
    assert atari.main([*arguments, "--folder", str(tmp_path), "--game", "Pong"]) == 2
    assert "games of Breakout, seed 1, not of Pong, seed 1" in capsys.readouterr().err
    with pytest.raises(UserError, match="of Breakout, seed 1, not of Pong, seed 1"):
        domain.make_source(PONG, domain.Settings(transitions=100)).load(str(tmp_path), 0)


def test_leap_trains_on_games_and_plays(collected, tmp_path, monkeypatch, capsys, quick_begin):
    folder, _ = collected
    monkeypatch.chdir(tmp_path)
    options = {
        "game": "Breakout", "demonstrations": folder, "transitions": 900,
        "steps": 20, "batch": 4, "episodes": 2, "max-steps": 30, "layers": 1, "width": 16,
        "heads": 1,
    }  # fmt: skip
    arguments = [str(part) for name, value in options.items() for part in (f"--{name}", value)]
    assert atari.main(arguments) == 0
    (row,) = [json.loads(line) for line in Path("runs/atari.jsonl").read_text().splitlines()]
    assert row["level"] == "Breakout" and row["episodes"] == 2 and row["return_error"] is not None
    assert 20 <= row["mean_length"] <= 30
    (trained,) = Path("runs").glob("atari-Breakout-*")
    assert all((trained / name).stat().st_size > 0 for name in ("loss.png", "plan.gif"))
    # The trained model computes the energy of the collected games.
    assert atari_energy.main(["--checkpoint", str(trained), "--windows", "4"]) == 0
    found = json.loads(Path("runs/atari-energy.json").read_text())["Breakout"]
    assert len(found["energies"]) == len(found["returns"]) > 8
    assert -1 <= found["correlation"] <= 1 and min(found["energies"]) > 0
    assert "rank correlation" in capsys.readouterr().out


METHODS = [f"--method {method}" for method in ("dt", "cql", "bc", "qr_dqn", "rem")]


@only_long
@pytest.mark.parametrize("options", [*METHODS, "--preset paper --consecutive 2 --context 4"])
def test_other_methods_and_the_paper_preset_train_and_play(
    collected, tmp_path, monkeypatch, quick_begin, options
):
    folder, _ = collected
    monkeypatch.chdir(tmp_path)
    toy = (
        f"--game Breakout --demonstrations {folder} --transitions 400 --steps 2 --batch 4 "
        "--episodes 1 --max-steps 30 --layers 1 --width 16 --heads 1 --features 2 --no-pictures"
    )
    assert atari.main([*toy.split(), *options.split()]) == 0
    (row,) = [json.loads(line) for line in Path("runs/atari.jsonl").read_text().splitlines()]
    assert row["train_steps"] == 2 and np.isfinite(row["mean_return"])
    assert row["plans"] == row["mean_length"] > 0  # each plan executes one action


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--game", "pongg"], "unknown game 'pongg'"),
        (["--game", "Pong", "--demonstrations", "nowhere"], "nowhere"),
        (["collect", "--game", "Pongg"], "did you mean Pong"),
        (["collect", "--game", "Pong", "--transitions", "0"], "--transitions must be at least 1"),
    ],
)
def test_user_errors_are_one_line(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert atari.main(arguments) == 2
    stderr = capsys.readouterr().err
    assert message in stderr and len(stderr.splitlines()) == 1


def test_a_step_begun_early_equals_an_ordinary_step():
    adapter, other = (AtariAdapter(BREAKOUT, 0.0, 27_000) for _ in range(2))
    assert isinstance(adapter, Eager)
    assert_equal(adapter.reset(3), other.reset(3))
    for index in range(30):
        adapter.begin(index % 4)
        begun, stepped = adapter.step(index % 4), other.step(index % 4)
        assert_equal(begun.observation, stepped.observation)
        assert begun[1:] == stepped[1:]
    adapter.begin(1)
    with pytest.raises(ValueError, match="action 1 was begun, not 2"):
        adapter.step(2)
    # A reset drops the step that has begun.
    assert_equal(adapter.reset(4), other.reset(4))
    for action in [2, 1, 0, 3, 1]:
        assert_equal(adapter.step(action)[0], other.step(action)[0])
