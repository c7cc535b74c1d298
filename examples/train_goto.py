"""Train a policy for the task GoTo with CMA-ES.

    uv run --extra envs python examples/train_goto.py --out runs/goto

The policy is linear in the features bearing, distance and 1 of the goal and has nine weights; tanh maps its
output to [−1, 1]. All candidates of a generation have the same goals. The script writes policy.json, and the
learning curve as curve.csv and curve.png.
"""

from __future__ import annotations

import argparse
import csv
import json
from collections.abc import Sequence
from pathlib import Path

import cma
import gymnasium
import numpy as np
from matplotlib.figure import Figure

from srs_twin.envs.gymnasium import SnakeVectorEnv

_TESTED = 20  # number of test goals, seeds 0 to 19, which the training does not use
FOLLOWER = 1.96  # mean return of the planner and follower over 20 goals (docs/environments.md)


def features(observation: np.ndarray, names: list[str]) -> np.ndarray:
    """Return the features bearing (rad), distance (m) and 1 of the goal, shape (environments, 3)."""
    ahead, left = (observation[:, names.index(f"goal_{way}_m")] for way in ("ahead", "left"))
    return np.stack([np.arctan2(left, ahead), np.hypot(ahead, left), np.ones_like(ahead)], axis=1)


def returns(env: SnakeVectorEnv, policies: np.ndarray, seeds: Sequence[int]) -> np.ndarray:
    """Return the episode returns of the policies, each with the goal of its seed, shape (policies,)."""
    box = env.single_action_space
    assert isinstance(box, gymnasium.spaces.Box)
    middle, half = (box.high + box.low) / 2, (box.high - box.low) / 2
    names = [signal.name for signal in env.envs[0].task.observations]
    observation, _ = env.reset(seed=seeds)
    total, running = np.zeros(env.num_envs), np.ones(env.num_envs, dtype=bool)
    while running.any():
        squeezed = np.tanh(np.einsum("paf,pf->pa", policies, features(observation, names)))
        observation, reward, ended, cut, _ = env.step((middle + half * squeezed).astype(np.float32))
        total += reward * running
        running &= ~(ended | cut)
    return total


def main() -> None:
    """Train a policy and write it with its learning curve."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--generations", type=int, default=20)
    parser.add_argument("--candidates", type=int, default=12)
    parser.add_argument("--goals", type=int, default=2, help="episodes of each candidate per generation")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("runs/goto"))
    given = parser.parse_args()
    env = SnakeVectorEnv("GoTo", given.candidates)
    actions = env.single_action_space.shape[0]
    search = cma.CMAEvolutionStrategy(
        np.zeros(actions * 3), 0.5, {"popsize": given.candidates, "seed": given.seed, "verbose": -9}
    )
    curve = []
    for generation in range(given.generations):
        found = search.ask()
        policies = np.array(found).reshape(given.candidates, actions, 3)
        goals = given.seed * 10_000 + generation * given.goals + np.arange(given.goals)
        scores = np.mean([returns(env, policies, [int(seed)] * given.candidates) for seed in goals], axis=0)
        search.tell(found, list(-scores))
        curve.append((generation + 1, float(scores.mean()), float(scores.max())))
        print("generation {}: mean return {:.3f}, best {:.3f}".format(*curve[-1]), flush=True)
    held_out = np.repeat(search.result.xfavorite.reshape(1, actions, 3), given.candidates, axis=0)
    batches = (range(k, k + given.candidates) for k in range(0, _TESTED, given.candidates))
    tested = np.concatenate([returns(env, held_out, list(seeds)) for seeds in batches])[:_TESTED]
    given.out.mkdir(parents=True, exist_ok=True)
    policy = {"weights": held_out[0].tolist(), "mean_return": float(np.mean(tested)), "seeds": _TESTED}
    (given.out / "policy.json").write_text(json.dumps(policy, indent=2) + "\n", "utf-8")
    with (given.out / "curve.csv").open("w", newline="") as file:
        csv.writer(file).writerows([("generation", "mean_return", "best_return"), *curve])
    figure = Figure(figsize=(6, 3.2), layout="constrained")
    axes = figure.subplots()
    number, mean, best = zip(*curve, strict=True)
    axes.plot(number, mean, label="mean of the candidates")
    axes.plot(number, best, label="best candidate")
    axes.axhline(FOLLOWER, color="0.4", linestyle="--", label="planner and follower, 20 goals")
    axes.set_xlabel("generation")
    axes.xaxis.get_major_locator().set_params(integer=True)
    axes.set_ylabel("return")
    axes.legend(frameon=False)
    figure.savefig(given.out / "curve.png", dpi=120)
    print(f"20 test goals: mean return {policy['mean_return']:.3f}; planner and follower {FOLLOWER}")


if __name__ == "__main__":
    main()
