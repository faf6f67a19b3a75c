"""Star graphs as a `Domain`."""

import dataclasses
import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax.typing import Dtype

from leapjax.checks import check_range, check_types
from leapjax.domain import Augmentation, Augmentations, Domain, DomainType
from leapjax.domains.puzzles.common import demonstrate
from leapjax.domains.puzzles.stars import graphs
from leapjax.domains.puzzles.stars.graphs import Graph, StarAdapter
from leapjax.errors import UserError
from leapjax.models.config import ModelConfig, Sizes
from leapjax.models.encoder import Encoder
from leapjax.models.transformer import dense
from leapjax.types import Context

LARGE = 20  # nodes: in a larger graph it takes long to find out by itself which edge leads where


@dataclasses.dataclass(frozen=True)
class Settings:
    """Star graphs: augmentation, and the encoder.

    Attributes:
        augment: Draw the names of nodes and the order of edges anew in every training window, which
            makes it a new graph.
        fewer_arms: With `augment`: also leave out a random number of arms.
        neighbours: The token of a planned action also holds the actions beside it. Only LEAP with
            attention "full" has this.
    """

    augment: bool = True
    fewer_arms: bool = False
    neighbours: bool = False

    def __post_init__(self) -> None:
        check_types(self)


class GraphTokens(Encoder):
    """A token for each edge, and one for where the agent is and where it should be.

    Attributes:
        labels: number of names of nodes.
        width: D.
        neighbours: whether the token of an action also holds the actions beside it.
        dtype: type of matrix products.
    """

    labels: int
    width: int
    neighbours: bool = False
    dtype: Dtype = jnp.float32

    def setup(self) -> None:  # noqa: D102
        scale = (2 * self.width) ** -0.5
        self.names = nn.Embed(self.labels, self.width, embedding_init=nn.initializers.normal(1.0))
        self.edge = dense(self.width, scale=scale, dtype=self.dtype)
        self.task = dense(self.width, scale=scale, dtype=self.dtype)
        self.before = dense(self.width, use_bias=False, scale=self.width**-0.5)
        self.after = dense(self.width, use_bias=False, scale=self.width**-0.5)

    def __call__(self, context: Context) -> jax.Array:
        """Returns the tokens `[E + 1, D]`."""
        graph = context.observation
        edges = self.names(graph.edges).reshape(-1, 2 * self.width)
        task = self.names(jnp.stack([graph.node, graph.goal])).reshape(1, -1)
        return jnp.concatenate([self.edge(edges), self.task(task)])

    def place_actions(self, tokens: jax.Array, positions: jax.Array) -> jax.Array:
        """Adds to the token of each action its position, and the actions before and after it.

        One layer then finds the edge between an action and its neighbour. Otherwise a layer must
        learn to fetch the neighbour before the next can learn to use it (short convolutions: Fu et
        al., 2023, H3).
        """
        if not self.neighbours:
            return tokens + positions
        blank = jnp.zeros_like(tokens[:1])
        before = self.before(jnp.concatenate([blank, tokens[:-1]]))
        after = self.after(jnp.concatenate([tokens[1:], blank]))
        return tokens + before + after + positions


def make(name: str, settings: Settings) -> Domain:
    """Makes a level by name, such as Star3x5.

    Raises:
        UserError: there is no such level.
    """
    star = graphs.find_level(name)
    labels, make_adapter = star.labels, functools.partial(StarAdapter, star)
    augmentations: list[Augmentation] = []
    if settings.augment:
        augmentations.append(functools.partial(graphs.relabel, labels=labels))
    if settings.augment and settings.fewer_arms:  # applied first, as it keeps the order of edges
        augmentations.append(functools.partial(graphs.leave_out_arms, star=star))
    blank = Graph(
        np.zeros((star.nodes - 1, 2), np.int32), np.zeros((), np.int32), np.zeros((), np.int32)
    )

    def tokens(model: ModelConfig, sizes: Sizes) -> Encoder:
        del sizes
        if settings.neighbours and model.attention == "causal":
            raise UserError(
                "neighbours with attention 'causal': there a token may not hold a later action; "
                "use attention 'full'",
                "neighbours", "attention",
            )  # fmt: skip
        return GraphTokens(labels, model.width, settings.neighbours, model.dtype)

    return Domain(
        level=name,
        make_adapter=make_adapter,
        actions=(*(str(label) for label in range(labels)), "end"),
        max_steps=star.length,
        blank=blank,
        encoders={"leapjax": tokens},
        demonstrations=demonstrate(make_adapter, functools.partial(check_labels, labels=labels)),
        augmentations=Augmentations(augmentations),
        signature={"length": star.length, "labels": labels},  # any number of arms
    )


def check_labels(states: Graph, where: str, labels: int) -> None:
    """Checks that the labels of nodes are in range.

    Raises:
        UserError: a label is out of range.
    """
    for field, values in states._asdict().items():
        check_range(f"{where}: {field}", values, 0, labels - 1)


STARS = DomainType(Settings, make, graphs.LEVELS)
