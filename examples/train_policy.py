"""Train a small policy that crawls to a goal, and evaluate it on other goals.

    python examples/train_policy.py [GENERATIONS]

CMA-ES changes the weights of a linear policy of the position of the goal.
`tools/train_ppo.py` trains a network with stable-baselines3.
"""

import sys

import cma
import numpy as np

from srs_twin.envs.gymnasium import SnakeEnv
from srs_twin.envs.policy import NetworkPolicy, load_policy
from srs_twin.plants.twin.mjcf.numerics import PRESETS

OBSERVATIONS = ("goal_ahead_m", "goal_left_m")
STEPS = 80  # of 0.1 s, at most, in an episode


def policy(weights: np.ndarray) -> NetworkPolicy:
    """Return the policy with weights and biases in one array, shape (9,)."""
    layer = weights[:6].reshape(3, 2), weights[6:]
    return NetworkPolicy("GoTo", OBSERVATIONS, (layer,))


def mean_return(env: SnakeEnv, candidate: NetworkPolicy, seeds: range) -> float:
    """Return the mean return of a policy over the episodes of the seeds."""
    act = candidate.bind(env.task)
    total = 0.0
    for seed in seeds:
        observation, _ = env.reset(seed=seed)
        for _ in range(STEPS):
            observation, reward, terminated, *_ = env.step(act(observation))
            total += reward
            if terminated:
                break
    return total / len(seeds)


def main() -> None:
    """Train, write policy.npz, and print the mean return on goals of other seeds."""
    generations = int(sys.argv[1]) if len(sys.argv) > 1 else 10
    env = SnakeEnv("GoTo", observations=("goal",), **PRESETS["fast"])
    search = cma.CMAEvolutionStrategy(
        np.zeros(9), 0.5, {"seed": 1, "verbose": -9, "popsize": 6}
    )
    for _ in range(generations):
        tried = search.ask()
        search.tell(tried, [-mean_return(env, policy(w), range(2)) for w in tried])
    policy(search.result.xbest).save("policy.npz")
    before = mean_return(env, policy(np.zeros(9)), range(100, 103))
    after = mean_return(env, load_policy("policy.npz"), range(100, 103))
    print(f"mean return: {before:.2f} untrained, {after:.2f} trained")


if __name__ == "__main__":
    main()
