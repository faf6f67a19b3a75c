"""Networks, training and search by method, which the presets of all domains share."""

from collections.abc import Mapping
from typing import Any

from leapjax.agents import leap
from leapjax.agents.base import TrainingConfig
from leapjax.configuration import AnyConfig, Config
from leapjax.methods import find_method
from leapjax.models.config import ModelConfig
from leapjax.planners import BeamConfig, GibbsConfig, PlannerConfig

UNTRAINED = ("random", "rules")  # methods without training
SEQUENCE = ("leap", "classifier", "plate", "rules")  # these plan several actions, others choose one


def paper_model(method: str, **changes: Any) -> ModelConfig:
    """Returns the network of the paper's appendix, table 6."""
    if method in UNTRAINED:
        return ModelConfig()
    return ModelConfig(architecture="paper", dropout=0.1, **changes)


def paper_training(method: str, **changes: Any) -> TrainingConfig:
    """Returns the training of the paper's appendix, table 6."""
    if method in UNTRAINED:
        return TrainingConfig(steps=0)
    # This many examples fit into a core's cache. LEAP makes a copy of each for every action.
    microbatch = {"leap": 4, "classifier": 0}.get(method, 8)
    return TrainingConfig(**{"windows": "episode", "microbatch": microbatch, **changes})


def our_model(method: str, **changes: Any) -> ModelConfig:
    """Returns the network of preset `leapjax`."""
    if method in UNTRAINED:
        return ModelConfig()
    if method == "classifier":
        return ModelConfig(**changes)
    # Augmentation makes dropout useless: chosen on validation levels of BabyAI.
    return ModelConfig(dropout=0.0, **changes)


def our_training(method: str, **changes: Any) -> TrainingConfig:
    """Returns the training of preset `leapjax`, with rates chosen on BabyAI's validation levels."""
    if method in UNTRAINED:
        return TrainingConfig(steps=0)
    rate = 1.5e-3 if method == "classifier" else 3e-3
    return TrainingConfig(**{"windows": "step", "learning_rate": rate, **changes})


def demonstrations(method: str, count: int) -> int:
    """Returns the number of demonstrations for a method: 0 if the method does not learn."""
    return 0 if method in UNTRAINED else count


def search(
    method: str,
    horizon: int,
    iterations: int,
    temperature: float = 0.0,
    fill: str = "together",
    beams: int = BeamConfig.beams,
) -> PlannerConfig:
    """Returns the search with which a method finds its plans.

    Args:
        method: name of the method.
        horizon: T of methods that plan several actions; other methods choose a single action.
        iterations: N of Gibbs sampling.
        temperature: temperature of Gibbs sampling or beams.
        fill: see `GibbsConfig`; the classifier judges complete plans only.
        beams: W, the number of PlaTe's beams.
    """
    if method == "plate":
        return BeamConfig(horizon, beams, temperature)
    if method == "random":
        temperature = 1.0  # all actions have the same energy
    if method not in SEQUENCE:
        horizon = iterations = 1
    if method == "classifier":
        fill = "together"
    return GibbsConfig(horizon, iterations, fill=fill, temperature=temperature)


def settings(method: str, **of_leap: Any) -> Any:
    """Returns the default settings of a method; `of_leap` changes LEAP's."""
    return leap.Settings(**of_leap) if method == "leap" else find_method(method).settings()


def configure(
    domain: str,
    level: str,
    method: str,
    preset: str,
    *,
    demos: int,
    training: Mapping[str, Any],
    planner: PlannerConfig,
    domain_settings: Any,
    network: Mapping[str, Any] = {},
    **others: Any,
) -> AnyConfig:
    """Makes a configuration; the preset decides only the network and its training.

    Args:
        domain: name of the domain.
        level: name of the level.
        method: name of the method.
        preset: "leapjax" or "paper".
        demos: number of demonstrations, if the method learns.
        training: changes of the preset's training.
        planner: how the method finds plans.
        domain_settings: settings of the domain.
        network: changes of our network.
        others: further fields of `Config`.
    """
    ours = preset == "leapjax"
    return Config(
        domain=domain,
        level=level,
        method=method,
        preset=preset,
        demos=demonstrations(method, demos),
        model=our_model(method, **network) if ours else paper_model(method),
        training=(our_training if ours else paper_training)(method, **training),
        planner=planner,
        method_settings=settings(method, masking="random" if ours else "each"),
        domain_settings=domain_settings,
        **others,
    )
