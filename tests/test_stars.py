"""Star graphs: the path to the goal agrees with an oracle, also in augmented windows."""

import dataclasses
import functools
from collections import Counter

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from experiments import stars
from experiments.common import searches
from leapjax.data import windows
from leapjax.domain import blank_context
from leapjax.domains.puzzles.stars import graphs
from leapjax.domains.puzzles.stars.domain import Settings, make
from leapjax.domains.puzzles.stars.graphs import Star, StarAdapter
from leapjax.errors import UserError
from leapjax.models.config import ModelConfig
from leapjax.running import results
from leapjax.types import pad_token
from tests.parameters import make_leap_agent, random_parameters
from tests.programs import only_long

STAR = Star(arms=3, length=4)
LABELS = STAR.labels
DOMAIN = make("Star3x4", Settings())
assert_equal = np.testing.assert_array_equal


def find_path(graph):
    """Finds the path from the goal back to the agent: a single edge leads to each node."""
    parents = {int(child): int(parent) for parent, child in np.asarray(graph.edges)}
    nodes = [int(graph.goal)]
    while parents[nodes[-1]] != int(graph.node):
        nodes.append(parents[nodes[-1]])
    return nodes[::-1]


@pytest.mark.parametrize("star", [Star(1, 1), STAR, Star(5, 10)])
def test_a_graph_is_a_star_and_its_path_leads_to_the_goal(star):
    for seed in range(20):
        graph, path = graphs.draw(star, seed)
        assert graph.edges.shape == (star.nodes - 1, 2)
        starts, ends = graph.edges.T
        assert len(set(ends)) == star.nodes - 1 and graph.node not in ends
        assert ((graph.edges >= 0) & (graph.edges < star.labels)).all()
        out = np.bincount(starts, minlength=star.labels)
        assert out[graph.node] == star.arms and np.delete(out, graph.node).max(initial=0) <= 1
        assert path.tolist() == find_path(graph) and len(path) == star.length


def count_places(edges, goals):
    """Counts how often the edge to the goal is at each place of the list."""
    _, places = np.nonzero(np.asarray(edges)[:, :, 1] == np.asarray(goals)[:, None])
    return np.bincount(places, minlength=STAR.nodes - 1)


def test_labels_arms_and_edge_order_are_uniform():
    drawn = [graphs.draw(STAR, seed)[0] for seed in range(600)]
    centres = np.bincount([int(graph.node) for graph in drawn], minlength=LABELS)
    assert len(centres) == LABELS and centres.max() < 5 * 600 / LABELS
    counts = count_places([graph.edges for graph in drawn], [graph.goal for graph in drawn])
    assert counts.min() > 600 / 12 / 2 and counts.max() < 600 / 12 * 2


def test_the_path_is_rewarded_and_illegal_steps_end_the_episode():
    adapter = StarAdapter(STAR)
    graph, path = adapter.reset(3), adapter.solution
    steps = [adapter.step(int(node)) for node in path]
    found = [(step.reward, step.terminated, step.success) for step in steps]
    assert found == [(0, False, False)] * 3 + [(1, True, True)]
    adapter.reset(3)
    others = [child for parent, child in graph.edges if parent == graph.node and child != path[0]]
    step = adapter.step(int(others[0]))  # into another arm: legal, but it misses the goal
    assert not step.terminated and int(step.observation.node) == others[0]
    step = adapter.step(int(path[1]))
    assert step.terminated and not step.success and step.reward == 0
    adapter.reset(3)
    assert adapter.step(int(graph.node)).terminated  # a step to its own node


def collect_episodes():
    return DOMAIN.demonstrations.collect(4, 0, lambda done: None).demonstrations


def augment(change, keys):
    """Yields windows of two graphs before and after an augmentation; checks their paths."""
    steps = jax.tree.map(jnp.asarray, windows.concatenate(collect_episodes()))
    cut = jax.jit(lambda index: windows.window(steps, index, 2, STAR.length, LABELS))
    change = jax.jit(change)
    for index in range(8):
        window = jax.device_get(cut(index))
        for seed in range(keys):
            new = jax.device_get(change(jax.random.key(10 * index + seed), window))
            known = window.actions < LABELS
            assert new.actions[known].tolist() == find_path(new.context.observation)
            assert (new.actions[~known] == LABELS).all()  # the end action keeps its number
            if window.context.step:
                assert_equal(new.context.past.edges[-1], new.context.observation.edges)
            yield window, new


def test_relabelled_windows_are_consistent():
    goals = set()
    for window, new in augment(lambda key, window: graphs.relabel(key, window, LABELS), 3):
        padded = window.context.actions == pad_token(LABELS + 1)
        assert (new.context.actions[padded] == pad_token(LABELS + 1)).all()
        if not padded.all():  # the previous action led to the agent's node
            assert new.context.actions[-1] == new.context.observation.node
        goals.add(int(new.context.observation.goal))
    assert len(goals) > 10


def test_leaving_out_arms_keeps_the_path_and_whole_arms():
    arms, dropped = set(), set()
    for window, new in augment(lambda key, window: graphs.leave_out_arms(key, window, STAR), 6):
        before, after = (x.context.observation.edges.tolist() for x in (window, new))
        edges = set(map(tuple, after))
        assert len(before) == len(after) and edges <= set(map(tuple, before))
        # Whole arms remain, as many as edges leave the centre.
        count, odd = divmod(len(edges), STAR.length)
        starts = Counter(start for start, _ in edges)
        assert not odd and starts.most_common(1)[0][1] == count
        arms.add(count)
        dropped.add(frozenset(map(tuple, before)) - edges)
    # In two graphs: either of the other two arms is dropped, or both; or all arms stay.
    assert arms == {1, 2, 3} and len(dropped) == 2 * 3 + 1


def test_training_batches_shuffle_edges():
    """Leaving out arms puts the goal's arm first, so batches must shuffle the edges again."""
    agent = make_leap_agent("stars", make("Star3x4", Settings(fewer_arms=True)))
    steps = jax.tree.map(jnp.asarray, windows.concatenate(collect_episodes()))
    graph = jax.device_get(jax.jit(agent.batch)(jax.random.key(0), steps)).context.observation
    kept = {len(np.unique(edges, axis=0)) for edges in graph.edges}
    assert kept == {STAR.length, 2 * STAR.length, 3 * STAR.length}
    counts = count_places(graph.edges, graph.goal)
    assert counts.min() > 0 and counts.max() < 3 * counts.mean()


def test_network_ignores_the_order_of_edges():
    agent, context = make_leap_agent("stars", DOMAIN), blank_context(DOMAIN, 0)
    params = random_parameters(agent)
    graph, _ = graphs.draw(STAR, 0)
    blank = np.full(STAR.length, DOMAIN.num_actions)

    @jax.jit
    def energies(graph):
        memory = agent.energy.encode(params, context._replace(observation=graph))
        return agent.energy.conditional(params, memory, blank, np.arange(STAR.length))

    found = energies(graph)
    shuffled = graph._replace(edges=graph.edges[::-1])
    flipped = graph._replace(edges=graph.edges[:, ::-1])
    np.testing.assert_allclose(energies(shuffled), found, rtol=1e-4)
    assert np.abs(energies(flipped) - found)[:, :LABELS].max() > 1e-4


def test_unknown_presets_and_invalid_data_raise_an_error(capsys):
    assert stars.main(["--preset", "paper"]) == 2
    assert "no encoder for architecture 'paper': expected one of leapjax" in capsys.readouterr().err
    states, check = collect_episodes()[0].observations, DOMAIN.demonstrations.check
    check(states, "here")
    with pytest.raises(UserError, match="here: goal run from 50 to 50, expected 0 to 49"):
        check(states._replace(goal=np.full(5, 50)), "here")


@only_long
def test_every_search_records_a_row(tmp_path, monkeypatch, capsys, quick_begin):
    monkeypatch.chdir(tmp_path)
    few = [s for s in searches.SEARCHES if s.name in ("all at once", "most certain first")]
    monkeypatch.setattr(searches, "SEARCHES", few)
    toy = (
        "--level Star2x2 --steps 2 --demos 2 --episodes 4 --batch 2 --width 8 --heads 2 --layers 1"
    )
    arguments = toy.split()
    assert stars.main(arguments) == 0
    (folder,) = (tmp_path / "runs").glob("stars-*")
    with Image.open(folder / "plan.gif") as animation:
        assert animation.n_frames == 3 * 2  # graphs, passes
    rows = results.read(tmp_path / "runs" / "stars.jsonl")
    found = [(row["train_steps"], results.name_planner(row)) for row in rows]
    assert found == [(2, "N = 2, confident"), (0, "N = 1"), (0, "N = 2, confident")]
    assert rows[0]["successes"] == rows[2]["successes"]  # the same planner, played again
    # Without its folder, a recorded run cannot be searched in further ways.
    (tmp_path / "results").mkdir()
    results.record(tmp_path / "results" / "stars.jsonl", rows[0])
    assert stars.main([*arguments, "--record", "--runs", "elsewhere"]) == 2
    error = capsys.readouterr().err
    assert "2 of 2 ways to search with it are not" in error and "--force" in error
    # A planner for graphs of two arms can play more arms of equal length.
    again = [*arguments, "--no-pictures", "--checkpoint", str(folder), "--play"]
    assert stars.main([*again, "Star5x2"]) == 0
    (*_, row) = results.read(tmp_path / "runs" / "stars.jsonl")
    assert (row["level"], row["played"]) == ("Star2x2", "Star5x2")
    assert stars.main([*again, "Star2x3"]) == 2
    message = "whose length is 2: it cannot play Star2x3, where it is 3"
    assert message in capsys.readouterr().err


def test_setting_neighbours_mixes_tokens_of_adjacent_actions():
    config = ModelConfig(layers=1, heads=1, width=8, dropout=0.0)
    tokens = jax.random.normal(jax.random.key(0), (4, 8))
    for neighbours, changed in ((False, [1]), (True, [0, 1, 2])):
        encoder = make("Star3x4", Settings(neighbours=neighbours)).encoders["leapjax"](config, 0)
        place = functools.partial(encoder.apply, method="place_actions")
        params = encoder.init(jax.random.key(1), tokens, 0.5, method="place_actions")
        mix, after = (place(params, each, 0.5) for each in (tokens, tokens.at[1].add(1.0)))
        assert_equal(np.flatnonzero(np.any(mix != after, axis=1)), changed)
    causal = dataclasses.replace(config, attention="causal")
    with pytest.raises(UserError, match="neighbours with attention 'causal'"):
        make("Star3x4", Settings(neighbours=True)).encoders["leapjax"](causal, 0)
