"""Presets of any environment, such as Gymnasium's: plan five actions, execute one."""

from leapjax.configuration import AnyConfig, Config
from leapjax.domains import find_domain
from leapjax.presets.common import (
    demonstrations,
    our_model,
    our_training,
    paper_model,
    paper_training,
    search,
    settings,
)

DEMONSTRATIONS = 500  # as in BabyAI
EPISODES = 100
STEPS = 2000
HORIZON = 5  # planned actions, of which one is executed; so many passes fill each position


def paper(domain: str, name: str, method: str) -> AnyConfig:
    """The paper's network."""
    return Config(
        domain=domain,
        level=name,
        method=method,
        preset="paper",
        demos=demonstrations(method, DEMONSTRATIONS),
        episodes=EPISODES,
        executed=1,
        model=paper_model(method),
        training=paper_training(method, steps=STEPS),
        planner=search(method, HORIZON, HORIZON),
        method_settings=settings(method, masking="each"),
        domain_settings=find_domain(domain).settings(),
    )


def leapjax(domain: str, name: str, method: str) -> AnyConfig:
    """Our network."""
    temperature = 0.5 if method == "leap" else 0.0  # as in BabyAI
    return Config(
        domain=domain,
        level=name,
        method=method,
        preset="leapjax",
        demos=demonstrations(method, DEMONSTRATIONS),
        episodes=EPISODES,
        executed=1,
        model=our_model(method),
        training=our_training(method, steps=STEPS),
        planner=search(method, HORIZON, HORIZON, temperature),
        method_settings=settings(method, masking="random"),
        domain_settings=find_domain(domain).settings(),
    )
