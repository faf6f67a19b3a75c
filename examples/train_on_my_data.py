"""A Gymnasium environment, a Minari data set of it, and a planner that learns from that.

python examples/train_on_my_data.py [steps] [episodes]
"""

import sys
import warnings

import gymnasium
import jax
from minari import DataCollector

import leapjax as leap
from leapjax.agents import leap as method
from leapjax.agents.learning import Setup, TrainingConfig
from leapjax.data import storage, windows
from leapjax.domain import apply_statistics
from leapjax.domains import find_domain
from leapjax.domains.gymnasium.domain import Settings
from leapjax.models.trajectory import ModelConfig
from leapjax.training import make_train_step, train

steps, episodes = (int(given) for given in (sys.argv[1:] + ["600", "20"][len(sys.argv) - 1 :]))

# Data: somebody's, or of a rule that balances the pole.
NAME = "mine/cartpole-v0"
if not storage.exists(NAME):
    env = DataCollector(gymnasium.make("CartPole-v1"))
    for seed in range(20):
        (x, speed, angle, turning), _ = env.reset(seed=seed)
        over = False
        while not over:
            push = int(angle + 0.5 * turning + 0.05 * x + 0.1 * speed > 0)
            (x, speed, angle, turning), _, fallen, out_of_time, _ = env.step(push)
            over = fallen or out_of_time
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it would like to know who we are
        env.create_dataset(NAME)

# A network of plans of five actions, trained and played.
domain = find_domain("gymnasium").make("CartPole-v1", Settings())
demonstrations = storage.load(NAME, domain).demonstrations
domain = apply_statistics(domain, domain.measure(demonstrations))  # the network scales numbers
data = windows.concatenate(demonstrations)
training = TrainingConfig(steps=steps, learning_rate=3e-3)
model = ModelConfig(width=64, layers=2, dropout=0.0)
agent = method.make_agent(Setup(domain, 0, 5, model, training, method.Settings("random")))
key = jax.random.key(0)
state = train(
    make_train_step(agent), jax.jit(agent.init)(key), data, key, steps,
    lambda step, state, means: print(step, means) if step % 100 == 0 else None,
)  # fmt: skip
plan = leap.compile_planner(agent.energy, leap.GibbsConfig(horizon=5, iterations=5))
played = leap.evaluate(
    domain.make_adapter, range(1000, 1000 + episodes), plan, state.params, context=0, executed=1
)
print(f"mean return {played.returns.mean():.0f}, success {played.successes.mean():.0%}")
