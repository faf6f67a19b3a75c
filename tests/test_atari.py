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
    """The frames and transitions of a game whose actions go round."""
    seen, transitions = [adapter.reset(seed)], []
    while len(transitions) < steps and not (transitions and transitions[-1].truncated):
        transitions.append(adapter.step(len(transitions) % (adapter.num_actions - 1)))
        seen.append(transitions[-1].observation)
        if transitions[-1].terminated:
            break
    return np.stack(seen), transitions


def random_encode(encoder, context):
    """An encoder with random parameters, compiled."""
    params = random_like(jax.eval_shape(encoder.init, jax.random.key(0), context), 0.05)
    return functools.partial(jax.jit(encoder.apply), params)


def test_a_game_is_the_same_for_the_same_seed_alone():
    first, again, other, sticky = (
        play(AtariAdapter(BREAKOUT, stickiness, 27_000), seed, 60)[0]
        for seed, stickiness in ((3, 0.0), (3, 0.0), (4, 0.0), (3, 1.0))
    )
    assert first.shape == (61, 84, 84) and first.dtype == np.uint8
    same(first, again)
    same(first[0], sticky[0])
    assert (first != other).any() and (first != sticky).any()


def test_a_game_is_cut_off_where_it_is_asked_to_be():
    seen, transitions = play(AtariAdapter(PONG, 0.0, 40), 0, 100)
    assert transitions[-1].truncated and not transitions[-1].terminated
    assert 30 <= len(transitions) <= 40  # the no-ops at its start are of the game
    assert not transitions[-1].success and len(seen) == len(transitions) + 1


def test_a_planner_sees_clipped_rewards_and_scores_count():
    adapter = AtariAdapter(GAMES["Qbert"], 0.0, 27_000)
    _, transitions = play(adapter, 0, 300)
    scores = {t.score for t in transitions}
    assert scores <= {0.0, 25.0, 50.0, 75.0, 100.0, 300.0, 500.0} and len(scores) > 1
    assert all(t.reward == min(t.score, 1.0) for t in transitions)
    assert adapter.score == sum(t.score for t in transitions)


def test_success_is_the_score_of_a_gamer():
    easy = BREAKOUT._replace(human=0.0)
    over = [play(AtariAdapter(game, 0.0, 300), 0, 400)[1][-1].success for game in (easy, BREAKOUT)]
    assert over == [True, False]
    assert BREAKOUT.normalised(BREAKOUT.random) == 0
    assert BREAKOUT.normalised(BREAKOUT.human) == pytest.approx(100)


def test_a_state_is_the_last_four_frames():
    given = jnp.asarray(frames(6))
    states = np.asarray(encoders.stack_frames(given, 6))
    before = np.concatenate([np.zeros((3, 84, 84)), given])
    for index in range(6):
        same(states[index], np.moveaxis(before[index : index + 4], 0, -1))
    same(encoders.stack_frames(given, 1), states[-1:])
    same(encoders.stack_frames(given[:2], 1)[0], states[1])


@pytest.mark.parametrize("architecture", ["paper", "leapjax"])
def test_encoders_see_what_they_should(architecture):
    context = window(8, context=6).context
    made = domain.make("Breakout", domain.Settings())
    encode = random_encode(made.encoders[architecture](MODEL, 6), context)
    before = encode(context)
    assert before.shape == ((7, 16) if architecture == "paper" else (domain.TOKENS, 16))
    for changed in range(6):
        past = context.past.at[changed].set(255 - context.past[changed])
        differs = np.abs(encode(context._replace(past=past)) - before).max(axis=1) > 1e-6
        if architecture == "paper":  # of its own state, and of the three after it
            same(differs, (np.arange(7) >= changed) & (np.arange(7) < changed + encoders.STACK))
        else:
            assert differs.all() if changed >= 3 else not differs.any()


@pytest.mark.parametrize(("name", "past"), [("paper", 25), ("leapjax", 3)])
def test_as_many_states_are_encoded_while_playing_as_the_tables_say(name, past):
    encoder = domain.make("Breakout", domain.Settings()).encoders[name](MODEL, past)
    alone, whole = (window(past, context=n, length=30).context for n in (0, past))
    params = jax.eval_shape(encoder.init, jax.random.key(0), alone)
    one = matmul_flops(encoder.apply, params, alone)
    known = jnp.zeros((past, MODEL.width))  # the tokens of the states before
    encode_next = functools.partial(encoder.apply, method="encode_next")
    many = matmul_flops(encode_next, params, whole, known)
    assert many == ENCODED[name] * one > 0


def test_without_a_past_the_whole_frame_has_changed():
    context = window(8, context=0).context
    shown = encoders.compute_changes(encoders.stack_frames(encoders.join_frames(context), 1))[0]
    same(shown[..., 1:3], 0)
    np.testing.assert_allclose(shown[..., 3], encoders.CHANGES * shown[..., 0], rtol=1e-5)


@pytest.mark.parametrize("name", GAMES)
def test_every_other_window_is_in_a_mirror(name):
    game, drawn = GAMES[name], window(5)
    past = frames(6, seed=1)
    ids = jnp.arange(len(game.actions) + 3)  # the end action, MASK and PAD among them
    context = drawn.context._replace(observation=past[-1], past=past[:-1], actions=ids)
    drawn = drawn._replace(context=context, actions=ids[::-1])
    show = functools.partial(augmentation.mirror_window, mirror=game.mirror, actions=game.actions)
    shown = [jax.jit(show)(jax.random.key(seed), drawn) for seed in range(40)]
    as_played = [bool((each.actions == drawn.actions).all()) for each in shown]
    assert 8 < sum(as_played) < 32
    for each, kept in zip(shown, as_played, strict=True):
        expected = past if kept else np.stack([reflected(frame, game.mirror) for frame in past])
        same(each.context.past, expected[:-1])
        same(each.context.observation, expected[-1])
        same(each.context.actions, each.actions[::-1])
    swapped = shown[as_played.index(False)].actions[::-1]
    same(swapped[swapped], ids)  # twice in the mirror is as before
    same(swapped[len(game.actions) :], ids[len(game.actions) :])


def reflected(frame, mirror):
    """An oracle: line by line."""
    result = frame.copy()
    rows, columns = slice(*mirror.rows), slice(*mirror.columns)
    for line in range(*(mirror.columns if mirror.axis else mirror.rows)):
        if mirror.axis:
            result[rows, line] = frame[rows, sum(mirror.columns) - 1 - line]
        else:
            result[line, columns] = frame[sum(mirror.rows) - 1 - line, columns]
    return result


def same(found, expected):
    np.testing.assert_array_equal(found, expected)


# Where in memory a player is, along the axis of the mirror; and across it.
PLACES = {"Breakout": (72,), "Qbert": (43, 67), "Pong": (51,), "Seaquest": (70, 97)}


@pytest.mark.parametrize("name", GAMES)
def test_in_a_mirror_actions_do_the_opposite(name):
    game = GAMES[name]
    emulator = Emulator(game)
    emulator.reset(20)
    hops = [3, 3] if name == "Qbert" else []  # away from the top
    for action in [1] * 40 + hops + [0] * 20:
        emulator.step(action)
    start = emulator.save()

    def place():
        return np.array([int(emulator.ram()[place]) for place in PLACES[name]])

    def way(action):
        emulator.restore(start)
        before = place()
        for _ in range(6):
            emulator.step(game.actions.index(action))
        return place() - before

    pairs = {a: game.mirror.actions[a] for a in game.actions if a in game.mirror.actions}
    assert len(pairs) >= 2
    for ours, theirs in ((way(action), way(other)) for action, other in pairs.items()):
        assert ours[0] * theirs[0] < 0
        same(ours[1:], theirs[1:])


@pytest.fixture(scope="module")
def collected(tmp_path_factory):
    """A folder of a few short games, made by the real command."""
    folder = tmp_path_factory.mktemp("atari")
    command = ["collect", "--game", "Breakout", "--transitions", "900", "--longest", "80"]
    arguments = [*command, "--folder", str(folder), "--workers", "1"]
    assert atari.main(arguments) == 0
    return folder, arguments


def test_what_was_collected_is_what_was_played(collected):
    folder, _ = collected
    made = json.loads((folder / "Breakout" / "1" / "manifest.json").read_text())
    games = [game for manifest in made for game in manifest["games"]]
    found = replay.read(folder, BREAKOUT, 900, seed=0).demonstrations
    total = sum(game["transitions"] for game in games)
    assert 900 <= sum(len(d.actions) for d in found) <= total
    assert {game["noise"] for game in games} == {0.1, 0.3, 0.5}
    assert all(len(d.actions) <= 80 and d.observations.shape[1:] == (84, 84) for d in found)
    assert max(game["score"] for game in games) > 0


def cost_planner(horizon):
    """An action costs its number and the steps before its window cost 100 each, times `params`."""
    planner, origin = SimpleNamespace(horizon=horizon), Origin("", 0, 0, None)
    specification = SimpleNamespace(level="Pong", context=0, planner=planner, origin=origin)

    def total(params, step, actions):
        return params * (actions + 100 * step).sum()

    energy = Energy(lambda params, context: context.step, None, total, 5)
    return SimpleNamespace(specification=specification, energy=energy, params=jnp.float32(2))


def game_of(actions, reward):
    """A game whose last step is rewarded."""
    rewards = np.where(np.arange(len(actions)) == len(actions) - 1, reward, 0).astype(np.float32)
    actions = np.array(actions, np.int32)
    return Demonstration(frames(len(actions) + 1), actions, rewards, True, False, -1)


def test_energies_of_games_are_those_of_their_windows():
    # Games as long as a plan have one window each; one that is shorter has none.
    played = [[0, 1, 2], [3, 3, 0], [2, 3, 3], [1, 0, 0], [3, 3]]
    means = [2 * sum(actions) / 3 for actions in played[:4]]
    games = [game_of(*each) for each in zip(played, [*np.negative(means), 50], strict=True)]
    found = atari_energy.correlate(cost_planner(3), games, 4)
    np.testing.assert_allclose(found["energies"], means, rtol=1e-6)
    np.testing.assert_allclose(found["returns"], np.negative(means), rtol=1e-6)
    assert found["correlation"] == pytest.approx(-1)
    # A longer one has as many as asked for, each within it: from its first step or its second.
    longer = game_of([1, 1, 1, 1], 1.0)
    found = atari_energy.correlate(cost_planner(3), [longer, games[0]], 64)
    assert 40 < (found["energies"][0] - 2) / 2 < 60
    with pytest.raises(UserError, match="all 3 trajectories of Pong have one reward"):
        atari_energy.correlate(cost_planner(2), [game_of([0, 1, 2], 0.0)] * 3, 2)


@only_long
def test_collecting_goes_on_where_it_was_stopped(collected):
    folder, arguments = collected
    logs = replay.replay_logs(folder, BREAKOUT, 1)
    shard = logs / "$store$_observation_ckpt.0.gz"
    before, when = shard.read_bytes(), shard.stat().st_mtime_ns
    assert collect.is_whole(folder, BREAKOUT, 900, 1, 80)
    assert not collect.is_whole(folder, BREAKOUT, 100_000, 1, 80)
    assert atari.main(arguments) == 0
    assert shard.stat().st_mtime_ns == when  # nothing was left to do
    (logs / "manifest.0.json").unlink()  # as if it had been killed before its end
    assert not collect.is_whole(folder, BREAKOUT, 900, 1, 80)
    assert atari.main(arguments) == 0
    assert shard.stat().st_mtime_ns > when and shard.read_bytes() == before


def test_what_others_have_made_is_not_replaced(collected, tmp_path, capsys):
    folder, arguments = collected
    theirs = replay.replay_logs(tmp_path, BREAKOUT, 1)
    theirs.mkdir(parents=True)
    for path in replay.replay_logs(folder, BREAKOUT, 1).glob("*.gz"):
        shutil.copy(path, theirs)
    assert atari.main([*arguments, "--folder", str(tmp_path)]) == 2
    assert "holds files that were not made here" in capsys.readouterr().err
    assert not list(theirs.glob("manifest*"))


def test_games_by_other_rules_are_not_gone_on_with(collected, tmp_path, monkeypatch, capsys):
    folder, arguments = collected
    shutil.copytree(folder, tmp_path / "copy")
    arguments = [*arguments, "--folder", str(tmp_path / "copy")]
    path = replay.replay_logs(tmp_path / "copy", BREAKOUT, 1) / "manifest.0.json"
    manifest = json.loads(path.read_text())
    assert (manifest.pop("demonstrator"), manifest.pop("rules")) == ("Paddle", 1)
    path.write_text(json.dumps({**manifest, "demonstrator": "Somebody", "rules": 1}))
    assert atari.main(arguments) == 2
    assert "Somebody with rules 1, and today's is Paddle with rules 1" in capsys.readouterr().err
    # What was made before manifests said so was made by the first rules.
    path.write_text(json.dumps(manifest))
    assert atari.main(arguments) == 0
    monkeypatch.setitem(playing.RULES, "Breakout", 2)
    assert atari.main(arguments) == 2
    assert "with rules 1, and today's is Paddle with rules 2" in capsys.readouterr().err
    # To learn from them is another matter.
    assert collect.find_shards(tmp_path / "copy", BREAKOUT, 100, 1) == range(1)


def test_a_folder_under_another_name_is_refused(collected, tmp_path, capsys):
    folder, arguments = collected
    shutil.copytree(folder / "Breakout" / "1", tmp_path / "Pong" / "1")
    assert atari.main([*arguments, "--folder", str(tmp_path), "--game", "Pong"]) == 2
    assert "games of Breakout, seed 1, not of Pong, seed 1" in capsys.readouterr().err
    with pytest.raises(UserError, match="of Breakout, seed 1, not of Pong, seed 1"):
        domain.make_source(PONG, domain.Settings(transitions=100)).load(str(tmp_path), 0)


def test_leap_trains_on_them_and_plays(collected, tmp_path, monkeypatch, capsys, quick_begin):
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
    # What was trained says how likely what was played is.
    assert atari_energy.main(["--checkpoint", str(trained), "--windows", "4"]) == 0
    found = json.loads(Path("runs/atari-energy.json").read_text())["Breakout"]
    assert len(found["energies"]) == len(found["returns"]) > 8
    assert -1 <= found["correlation"] <= 1 and min(found["energies"]) > 0
    assert "rank correlation" in capsys.readouterr().out


WAYS = [f"--method {method}" for method in ("dt", "cql", "bc", "qr_dqn", "rem")]


@only_long
@pytest.mark.parametrize("options", [*WAYS, "--preset paper --consecutive 2 --context 4"])
def test_every_way_to_learn_trains_and_plays(
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
    assert row["plans"] == row["mean_length"] > 0  # each executes one action


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--game", "pongg"], "unknown game 'pongg'"),
        (["--game", "Pong", "--demonstrations", "nowhere"], "nowhere"),
        (["collect", "--game", "Pongg"], "did you mean Pong"),
        (["collect", "--game", "Pong", "--transitions", "0"], "--transitions must be at least 1"),
    ],
)
def test_mistakes_are_one_line(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert atari.main(arguments) == 2
    said = capsys.readouterr().err
    assert message in said and len(said.splitlines()) == 1


def test_a_step_that_was_begun_is_waited_for():
    adapter, other = (AtariAdapter(BREAKOUT, 0.0, 27_000) for _ in range(2))
    assert isinstance(adapter, Eager)
    same(adapter.reset(3), other.reset(3))
    for index in range(30):
        adapter.begin(index % 4)
        begun, stepped = adapter.step(index % 4), other.step(index % 4)
        same(begun.observation, stepped.observation)
        assert begun[1:] == stepped[1:]
    adapter.begin(1)
    with pytest.raises(ValueError, match="action 1 was begun, not 2"):
        adapter.step(2)
    # What it was busy with is not of the next game.
    same(adapter.reset(4), other.reset(4))
    for action in [2, 1, 0, 3, 1]:
        same(adapter.step(action)[0], other.step(action)[0])
