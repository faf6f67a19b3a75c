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
from leapjax.domains.puzzles.common import PuzzleAdapter
from leapjax.domains.puzzles.names import read_numbers
from leapjax.errors import UserError
from leapjax.types import Array, Window

LEVELS = ("Star3x5", "Star5x10")
MOST_NODES = 1000


class Star(NamedTuple):
    """A level.

    Attributes:
        arms: number of arms.
        length: edges of each arm.
    """

    arms: int
    length: int

    @property
    def nodes(self) -> int:
        """Number of nodes, the centre included; there is one edge less."""
        return 1 + self.arms * self.length

    @property
    def labels(self) -> int:
        """Number of labels for nodes: the smallest multiple of 50 that is enough."""
        return 50 * -(-self.nodes // 50)


class Graph(NamedTuple):
    """An observation. Nodes have labels in `0 .. labels - 1`.

    Attributes:
        edges: `[E, 2]` int32, each from a node to the next node away from the centre.
        node: `[]` int32, where the agent is.
        goal: `[]` int32.
    """

    edges: Array
    node: Array
    goal: Array


def find_level(name: str) -> Star:
    """Reads a level's name, such as Star3x5: three arms of five edges.

    Raises:
        UserError: the level does not exist.
    """
    pattern, expected = r"Star([1-9]\d{0,3})x([1-9]\d{0,3})", "Star<arms>x<edges of an arm>"
    star = Star(*read_numbers(name, pattern, expected, LEVELS))
    if star.nodes > MOST_NODES:
        raise UserError(f"level {name} has {star.nodes} nodes: at most {MOST_NODES} are possible")
    return star


def draw(star: Star, seed: int) -> tuple[Graph, np.ndarray]:
    """Draws the graph of a seed, and the nodes `[length]` of the path to its goal."""
    rng = np.random.default_rng(check_seed(seed))
    names = rng.permutation(star.labels)[: star.nodes].astype(np.int32)
    arms = names[1:].reshape(star.arms, star.length)
    ways = np.concatenate([np.full((star.arms, 1), names[0]), arms], axis=1)
    edges = np.stack([ways[:, :-1], ways[:, 1:]], axis=-1).reshape(-1, 2)
    path = arms[rng.integers(star.arms)]
    return Graph(rng.permutation(edges), names[0], path[-1]), path


class StarAdapter(PuzzleAdapter[Graph]):
    """A star graph as the rollout sees it: an action is the label of the node to go to.

    A step along an edge is a step; any other ends the episode. At the goal it ends with success.
    """

    def __init__(self, star: Star) -> None:
        self.star = star
        self.num_actions = star.labels + 1

    def draw(self, seed: int) -> tuple[Graph, np.ndarray]:
        """Draws the graph of a seed, and the path to its goal."""
        return draw(self.star, seed)

    def move(self, graph: Graph, action: int) -> tuple[Graph, bool | None]:
        """Goes to a node."""
        if not (graph.edges == (graph.node, action)).all(axis=1).any():
            return graph, False
        return graph._replace(node=np.int32(action)), True if action == graph.goal else None


def relabel(key: jax.Array, window: Window, labels: int) -> Window:
    """Draws the labels of a window's nodes and the order of its edges anew.

    Graphs of a level differ only in these, so this makes a window of a new graph.
    """
    name_key, order_key = jax.random.split(key)
    names = jax.random.permutation(name_key, labels).astype(jnp.int32)
    order = jax.random.permutation(order_key, window.context.observation.edges.shape[0])

    def rename(actions: jax.Array) -> jax.Array:
        return jnp.where(actions < labels, names[jnp.minimum(actions, labels - 1)], actions)

    def redraw(graph: Graph) -> Graph:
        return Graph(names[graph.edges[..., order, :]], names[graph.node], names[graph.goal])

    context = window.context._replace(
        observation=redraw(window.context.observation),
        past=redraw(window.context.past),
        actions=rename(window.context.actions),
    )
    return window._replace(context=context, actions=rename(window.actions))


def leave_out_arms(key: jax.Array, window: Window, star: Star) -> Window:
    """Leaves out a random number of the arms that do not lead to a window's goal.

    The remaining edges are repeated, so their number stays. In a smaller graph it is easier to
    learn that an edge continues where another ends.
    """
    count_key, arm_key = jax.random.split(key)
    graph = window.context.observation
    # The next node of each node's arm; the centre has any, but no edge ends there.
    following = jnp.arange(star.labels).at[graph.edges[:, 0]].set(graph.edges[:, 1])
    # Where the arm of each edge ends. (XLA would nest unrolled steps, and compile for minutes.)
    ends = jax.lax.fori_loop(0, star.length - 1, lambda _, at: following[at], graph.edges[:, 1])
    rank = jax.random.uniform(arm_key, (star.labels,)).at[graph.goal].set(-1.0)
    by_arm = jnp.argsort(rank[ends])  # the goal's comes first
    kept = star.length * jax.random.randint(count_key, (), 1, star.arms + 1)
    edges = by_arm[jnp.arange(len(ends)) % kept]

    def prune(graph: Graph) -> Graph:
        return graph._replace(edges=graph.edges[..., edges, :])

    context = window.context
    return window._replace(
        context=context._replace(observation=prune(context.observation), past=prune(context.past))
    )
