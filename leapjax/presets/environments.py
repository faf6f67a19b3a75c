"""Presets of any environment, such as Gymnasium's: plan five actions, execute one."""

from typing import Any

from leapjax.configuration import AnyConfig, change
from leapjax.domains import find_domain
from leapjax.presets import common

DEMONSTRATIONS = 500  # as in BabyAI
EPISODES = 100
STEPS = 2000
HORIZON = 5  # T = N: the planner makes 5 passes, and executes the first of 5 actions
# A target network that moves by a tenth of the distance at each step catches up 200 times in these
# steps. Each time, values travel one step of an episode.
_VALUES: dict[str, Any] = {"target_rate": 0.1, "reward_scale": None}  # the scale: from the data
# Chosen where exact values are known (`tests/test_values.py`) and on experts' data. MOPO keeps its
# own target rate: 0.1 did not bring its values closer.
_SETTINGS: dict[str, dict[str, Any]] = {
    "leap": {"target_return": None, "return_scale": None},  # from the data
    "dt": {"target_return": None, "return_scale": None},
    "bcq": _VALUES,
    "cql": {**_VALUES, "alpha": 1.0},  # less keeps too little to the actions of an expert
    "qr_dqn": _VALUES,
    "rem": _VALUES,
    "mopo": {"reward_scale": None},
    "iql": {**_VALUES, "expectile": 0.7},  # a higher expectile turns noise of Q-values into value
}
# Learning rates of our network at which values settle; at 1e-3 IQL's exceed what rewards allow.
_RATES = {"bcq": 1e-3, "cql": 1e-3, "qr_dqn": 1e-3, "rem": 1e-3, "iql": 3e-4}


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
        training=_choose_training(method, preset),
        planner=common.search(method, HORIZON, HORIZON, temperature),
        domain_settings=find_domain(domain).settings(),
        episodes=EPISODES,
        executed=1,
    )
    return change(config, method_settings=_SETTINGS.get(method, {}))


def _choose_training(method: str, preset: str) -> dict[str, Any]:
    """Returns the changes of a preset's training."""
    rate = {"learning_rate": _RATES[method]} if preset == "leapjax" and method in _RATES else {}
    return {"steps": STEPS, **rate}
