"""Star graphs: find the arm that leads to the goal (Bachmann and Nagarajan, 2024).

From a centre start arms of equal length. An agent sees all edges, in no order, where it is, and
its goal, the end of one arm. Which first step is right can only be told by following the arms:
'The pitfalls of next-token prediction' (arXiv 2403.06963) shows that models which learn the next
step from the steps before it do not learn to look ahead.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from leapjax.checks import check_seed
from leapjax.domains.puzzles.names import read_numbers
from leapjax.environments import Transition
from leapjax.errors import UserError
from leapjax.types import Array, Window

LEVELS = ("Star3x5", "Star5x10")
MOST_NODES = 1000


class Star(NamedTuple):
    """A level: how many arms of how many edges."""

    arms: int
    length: int

    @property
    def nodes(self) -> int:
        """How many there are, the centre included; edges are one less."""
        return 1 + self.arms * self.length

    @property
    def labels(self) -> int:
        """How many names there are for nodes: 50, or as many fifties as are needed."""
        return 50 * -(-self.nodes // 50)


class Graph(NamedTuple):
    """What the agent sees. Nodes are known by their labels, `0 .. labels - 1`."""

    edges: Array  # [E, 2] int32: from a node to the next one farther from the centre
    node: Array  # [] int32: where the agent is
    goal: Array  # [] int32


def find_level(name: str) -> Star:
    """The level of a name such as Star3x5: three arms of five edges.

    Raises:
        UserError: it is none.
    """
    pattern, expected = r"Star([1-9]\d{0,3})x([1-9]\d{0,3})", "Star<arms>x<edges of an arm>"
    star = Star(*read_numbers(name, pattern, expected, LEVELS))
    if star.nodes > MOST_NODES:
        raise UserError(f"level {name} has {star.nodes} nodes: at most {MOST_NODES} are possible")
    return star


def draw(star: Star, seed: int) -> tuple[Graph, np.ndarray]:
    """The graph of a seed, and the nodes `[length]` that lead to its goal."""
    rng = np.random.default_rng(check_seed(seed))
    names = rng.permutation(star.labels)[: star.nodes].astype(np.int32)
    arms = names[1:].reshape(star.arms, star.length)
    ways = np.concatenate([np.full((star.arms, 1), names[0]), arms], axis=1)
    edges = np.stack([ways[:, :-1], ways[:, 1:]], axis=-1).reshape(-1, 2)
    path = arms[rng.integers(star.arms)]
    return Graph(rng.permutation(edges), names[0], path[-1]), path


class StarAdapter:
    """A star graph as the rollout sees it: an action is the label of the node to go to.

    A step along an edge is a step; any other ends the episode. At the goal it ends with success.
    """

    def __init__(self, star: Star) -> None:
        self.star = star
        self.num_actions = star.labels + 1
        self.path = np.zeros(0, np.int32)  # of the current graph

    def reset(self, seed: int) -> Graph:
        """Draws the graph of a seed."""
        self._graph, self.path = draw(self.star, seed)
        return self._graph

    def step(self, action: int) -> Transition:
        """Goes to a node."""
        before = self._graph
        moved = bool((before.edges == (before.node, action)).all(axis=1).any())
        if moved:
            self._graph = before._replace(node=np.int32(action))
        success = moved and action == before.goal
        return Transition(self._graph, float(success), success or not moved, False, success)


def relabel(key: jax.Array, window: Window, labels: int) -> Window:
    """The same window with other names for nodes, and its edges in another order.

    All graphs of a level are one but for these, so a window becomes that of a new graph.
    """
    name_key, order_key = jax.random.split(key)
    names = jax.random.permutation(name_key, labels).astype(jnp.int32)
    order = jax.random.permutation(order_key, window.context.observation.edges.shape[0])

    def renamed(actions: jax.Array) -> jax.Array:
        return jnp.where(actions < labels, names[jnp.minimum(actions, labels - 1)], actions)

    def redrawn(graph: Graph) -> Graph:
        return Graph(names[graph.edges[..., order, :]], names[graph.node], names[graph.goal])

    context = window.context._replace(
        observation=redrawn(window.context.observation),
        past=redrawn(window.context.past),
        actions=renamed(window.context.actions),
    )
    return window._replace(context=context, actions=renamed(window.actions))


def leave_out_arms(key: jax.Array, window: Window, star: Star) -> Window:
    """The same window without some of the arms that do not lead to its goal.

    How many are left is drawn evenly. Edges that are left are seen several times, so that there
    are as many as before. In a smaller graph it is easier to find out that an edge leads on from
    where another ends.
    """
    count_key, arm_key = jax.random.split(key)
    graph = window.context.observation
    # From each node to the next one of its arm; from the centre to any, but no edge ends there.
    following = jnp.arange(star.labels).at[graph.edges[:, 0]].set(graph.edges[:, 1])
    # Where the arm of each edge ends. (XLA would nest unrolled steps, and compile for minutes.)
    ends = jax.lax.fori_loop(0, star.length - 1, lambda _, at: following[at], graph.edges[:, 1])
    rank = jax.random.uniform(arm_key, (star.labels,)).at[graph.goal].set(-1.0)
    by_arm = jnp.argsort(rank[ends])  # the goal's comes first
    kept = star.length * jax.random.randint(count_key, (), 1, star.arms + 1)
    edges = by_arm[jnp.arange(len(ends)) % kept]

    def pruned(graph: Graph) -> Graph:
        return graph._replace(edges=graph.edges[..., edges, :])

    context = window.context
    return window._replace(
        context=context._replace(observation=pruned(context.observation), past=pruned(context.past))
    )
