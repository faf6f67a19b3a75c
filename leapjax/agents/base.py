"""The types that every method shares: `TrainingConfig`, `Setup` and `Method`."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from leapjax.checks import check_at_least, check_types, check_within
from leapjax.data import windows
from leapjax.domain import Domain
from leapjax.errors import UserError
from leapjax.models.config import ModelConfig, Sizes
from leapjax.models.encoder import Encoder
from leapjax.models.policy import PolicyModel
from leapjax.planners import GibbsConfig
from leapjax.types import Agent, Energy, PyTree, TrainState

# Training settings that change how a step is computed, but not its result. The names of runs and
# checkpoints leave them out.
UNNAMED = ("microbatch",)


@dataclasses.dataclass(frozen=True)
class TrainingConfig:
    """How a network is trained. The defaults are the paper's (appendix, table 6).

    1600 steps are 200 epochs of one window for each of 500 demonstrations.

    Attributes:
        steps: Training steps.
        batch: Training windows in a step.
        learning_rate: Learning rate of AdamW after the warm-up.
        warmup: Steps of linear warm-up, at most a tenth of all; cosine decay follows.
        final_fraction: Share of the learning rate that is left at the end.
        betas: Decay rates of AdamW's two moments.
        weight_decay: Weight decay of all parameters but embeddings, norms and biases.
        clip: Largest global norm of the gradient; inf for no clipping.
        windows: Where training windows start. "episode": a random step of a random episode. "step":
            a random step of all episodes. "start": the first step of a random episode.
        microbatch: Windows whose loss a device computes at a time; 0 for all of its share.
        consecutive: Consecutive windows in a training example, which encodes each of their states
            once; 1 draws each window by itself.
    """

    steps: int = 1600
    batch: int = 64
    learning_rate: float = 6e-4
    warmup: int = 100
    final_fraction: float = 0.1
    betas: tuple[float, float] = (0.9, 0.95)
    weight_decay: float = 0.1
    clip: float = 1.0
    windows: str = "episode"
    microbatch: int = 0
    consecutive: int = 1

    def __post_init__(self) -> None:
        check_types(self, "clip")
        check_at_least(self, 0, "steps", "microbatch", "warmup")
        check_at_least(self, 1, "batch", "consecutive")
        check_within(self, 0, 10, "learning_rate")
        check_within(self, 0, 100, "weight_decay")
        check_within(self, 0, 1, "final_fraction")
        if self.clip <= 0:
            raise ValueError(f"clip must be positive, got {self.clip}: nothing would be learned")
        if not all(0 <= beta < 1 for beta in self.betas):
            raise ValueError(f"betas must be in [0, 1), got {self.betas}")
        if self.batch % self.consecutive:
            raise ValueError(
                f"a batch of {self.batch} windows is not a multiple of {self.consecutive} "
                "consecutive windows"
            )
        if self.windows not in windows.SAMPLINGS:
            known = ", ".join(windows.SAMPLINGS)
            raise ValueError(f"unknown windows {self.windows!r}: expected one of {known}")


class Setup(NamedTuple):
    """The arguments of a method's `make_agent`.

    Attributes:
        domain: level to learn.
        context: K, number of past steps that the network sees.
        horizon: T, number of planned actions.
        model: size of the network.
        training: how the network is trained.
        settings: options of the method, an instance of `Method.settings`.
    """

    domain: Domain
    context: int
    horizon: int
    model: ModelConfig
    training: TrainingConfig
    settings: Any

    @property
    def sizes(self) -> Sizes:
        """The sizes of plans and contexts, for the network."""
        domain = self.domain
        return Sizes(domain.num_actions, self.context, self.horizon, domain.max_steps)

    def make_encoder(self) -> Encoder:
        """Makes the domain's encoder for the model's architecture.

        Raises:
            UserError: the domain has no encoder for this architecture.
        """
        name = self.model.architecture
        if name not in self.domain.encoders:
            raise UserError(
                f"{self.domain.level} has no encoder for architecture {name!r}: "
                f"expected one of {', '.join(self.domain.encoders)}"
            )
        return self.domain.encoders[name](self.model, self.sizes)

    def make_policy(self, *heads: tuple[str, int], conditioned: bool = False) -> PolicyModel:
        """Makes the network of a method that chooses one action at a time.

        Args:
            heads: name and number of outputs of each head.
            conditioned: whether the network is conditioned on returns to go.

        Raises:
            UserError: the horizon is not 1.
        """
        self.check_single_action()
        return PolicyModel(self.model, self.sizes, self.make_encoder(), heads, conditioned)

    def check_single_action(self) -> None:
        """Checks that plans have one action.

        Raises:
            UserError: the horizon is not 1.
        """
        if self.horizon != 1:
            raise UserError(
                f"a horizon of {self.horizon}: this method chooses one action at a time, so its "
                "horizon is 1",
                "horizon",
            )


class Method(NamedTuple):
    """A way to learn and to act: an entry of `leapjax.methods.METHODS`.

    Attributes:
        settings: frozen dataclass of the options that only this method has.
        make_agent: (setup, mesh of devices to train on) -> agent; `None` for one device.
        rewards: whether the method learns from rewards, and so rejects data without them.
        planner: frozen dataclass of the planner's settings.
        everywhere: whether the method works in every domain, so that `--method all` includes it.
    """

    settings: type
    make_agent: Callable[[Setup, Mesh | None], Agent]
    rewards: bool = False
    planner: type = GibbsConfig
    everywhere: bool = True


def make_untrained_agent(energy: Energy) -> Agent:
    """Makes an agent from an energy with parameters `()`; training changes only the step count."""

    def init(key: jax.Array) -> TrainState:
        del key
        return TrainState((), (), jnp.int32(0))

    def update(
        state: TrainState, batch: PyTree, key: jax.Array
    ) -> tuple[TrainState, dict[str, jax.Array]]:
        del batch, key
        return state._replace(step=state.step + 1), {"loss": jnp.zeros(())}

    return Agent(init, lambda key, steps: (), update, energy)
