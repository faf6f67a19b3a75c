"""Trains a planner on a Minari data set of a Gymnasium environment.

python examples/train_on_my_data.py [steps] [episodes]
"""

import sys
import warnings

import gymnasium
from minari import DataCollector

import leapjax as leap
from leapjax.data import storage

steps, episodes = (int(given) for given in (sys.argv[1:] + ["600", "20"][len(sys.argv) - 1 :]))

# Data: an existing data set, or episodes of a rule that balances the pole.
NAME = "mine/cartpole-v0"
if not storage.has_dataset(NAME):
    env = DataCollector(gymnasium.make("CartPole-v1"))
    for seed in range(20):
        (x, speed, angle, turning), _ = env.reset(seed=seed)
        over = False
        while not over:
            push = int(angle + 0.5 * turning + 0.05 * x + 0.1 * speed > 0)
            (x, speed, angle, turning), _, fallen, out_of_time, _ = env.step(push)
            over = fallen or out_of_time
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Minari warns that author and code are not named
        env.create_dataset(NAME)

# Train a planner of five actions, make a plan, and play episodes.
domain = leap.make_domain("gymnasium", "CartPole-v1")
planner = leap.fit(NAME, domain, steps=steps, progress=lambda step, means: print(step, means))
print(planner)
print("the first plan:", planner.plan_for(domain.make_adapter(), seed=1000).actions)
played = leap.evaluate(
    domain.make_adapter, range(1000, 1000 + episodes), planner.plan, planner.params,
    context=0, executed=1,
)  # fmt: skip
print(f"mean return {played.returns.mean():.0f}, success {played.successes.mean():.0%}")
