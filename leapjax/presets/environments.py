"""Presets of any environment, such as Gymnasium's: plan five actions, execute one."""

from leapjax.configuration import AnyConfig, change
from leapjax.domains import find_domain
from leapjax.presets import common

DEMONSTRATIONS = 500  # as in BabyAI
EPISODES = 100
STEPS = 2000
HORIZON = 5  # T = N: the planner makes 5 passes, and executes the first of 5 actions


def paper(domain: str, name: str, method: str) -> AnyConfig:
    """Returns a configuration with the paper's network."""
    return _configure(domain, name, method, "paper", temperature=0.0)


def leapjax(domain: str, name: str, method: str) -> AnyConfig:
    """Returns a configuration with our network."""
    temperature = 0.5 if method == "leap" else 0.0  # as in BabyAI
    return _configure(domain, name, method, "leapjax", temperature)


def _configure(domain: str, name: str, method: str, preset: str, temperature: float) -> AnyConfig:
    config = common.configure(
        domain,
        name,
        method,
        preset,
        demos=DEMONSTRATIONS,
        training={"steps": STEPS},
        planner=common.search(method, HORIZON, HORIZON, temperature),
        domain_settings=find_domain(domain).settings(),
        episodes=EPISODES,
        executed=1,
    )
    if method not in common.CONDITIONED:
        return config
    return change(config, method_settings={"target_return": None})  # from the data
