"""Star graphs as a `Domain`."""

import dataclasses
import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax.typing import Dtype

from leapjax.checks import check_range, check_types
from leapjax.data.solved import collect_solved
from leapjax.domain import Augmentation, Augmentations, Demonstrations, Domain, DomainType
from leapjax.domains.puzzles.stars import graphs
from leapjax.domains.puzzles.stars.graphs import Graph, StarAdapter
from leapjax.models.config import ModelConfig
from leapjax.models.encoder import Encoder
from leapjax.models.transformer import dense
from leapjax.types import Context

LARGE = 20  # nodes: in a larger graph it takes long to find out by itself which edge leads where


@dataclasses.dataclass(frozen=True)
class Settings:
    """Star graphs: augmentation.

    Attributes:
        augment: Draw the names of nodes and the order of edges anew in every training window, which
            makes it a new graph.
        fewer_arms: With `augment`: also leave out a random number of arms.
    """

    augment: bool = True
    fewer_arms: bool = False

    def __post_init__(self) -> None:
        check_types(self)


class GraphTokens(Encoder):
    """A token for each edge, and one for where the agent is and where it should be."""

    labels: int
    width: int
    dtype: Dtype = jnp.float32

    @nn.compact
    def __call__(self, context: Context) -> jax.Array:
        """Tokens `[E + 1, D]`."""
        graph = context.observation
        names = nn.Embed(self.labels, self.width, embedding_init=nn.initializers.normal(1.0))
        scale = (2 * self.width) ** -0.5
        edges = names(graph.edges).reshape(-1, 2 * self.width)
        task = names(jnp.stack([graph.node, graph.goal])).reshape(1, -1)
        read = [
            dense(self.width, scale=scale, name=name, dtype=self.dtype)(tokens)
            for name, tokens in {"edge": edges, "task": task}.items()
        ]
        return jnp.concatenate(read)


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

    def tokens(model: ModelConfig, context: int) -> Encoder:
        del context
        return GraphTokens(labels, model.width, model.dtype)

    return Domain(
        level=name,
        make_adapter=make_adapter,
        actions=(*(str(label) for label in range(labels)), "end"),
        max_steps=star.length,
        blank=blank,
        encoders={"leapjax": tokens},
        demonstrations=Demonstrations(
            functools.partial(collect_solved, make_adapter, lambda adapter: adapter.path),
            check=functools.partial(check_labels, labels=labels),
        ),
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
