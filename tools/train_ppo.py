"""Train a policy for a task with PPO (stable-baselines3), and write it as a small file.

    uv run --extra rl python tools/train_ppo.py --seeds 0 1 2 3 4 --out runs/ppo

The reward has a time penalty in addition to the default terms, so that the policy
learns to arrive early. For each seed K the script writes seed_K/policy.npz, which
`srs_twin.envs.policy.load_policy` reads without PyTorch, and the learning curve as
seed_K/curve.csv: the steps so far, and the success rate and mean duration of the last
100 episodes. A seed whose policy exists is not trained again. curve.png shows all
seeds.

`--task Obstacles --observations pose goal gait bends command --time-weight 0` trains a
policy that does not see the obstacles.
"""

from __future__ import annotations

import argparse
import csv
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import gymnasium
import numpy as np
import torch
from matplotlib.figure import Figure
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from srs_twin.envs import TASKS
from srs_twin.envs.policy import NetworkPolicy
from srs_twin.envs.task import Task
from srs_twin.plants.twin.mjcf.numerics import PRESETS

GROUPS = ("goal", "gait", "command")
"""Groups of observations for GoTo, which does not need the pose or the bends."""

ENVIRONMENTS = 8

DISCOUNT = 0.99
"""Discount factor of a step of 0.1 s."""

FOLLOWER_S = 5.6
"""Mean duration of planner and follower over 500 goals (docs/environments.md), s."""


def make_environment(
    task: str, groups: Sequence[str], time_weight: float
) -> gymnasium.Env:
    """Return the environment of the training: coarser steps and a time penalty."""
    return gymnasium.make(
        f"srs_twin.envs:SRSTwin/{task}-v0",
        observations=groups,
        rewards={"time_s": -time_weight},
        **PRESETS["fast"],
    )


class LearningCurve(BaseCallback):
    """Success rate and duration of the last 100 episodes, written after each rollout."""

    def __init__(self, path: Path) -> None:
        """Open the file of the curve."""
        super().__init__()
        self._file = path.open("w", newline="")
        self._rows = csv.writer(self._file)
        self._rows.writerow(["steps", "success", "duration_s"])
        self._ended: deque[tuple[bool, float]] = deque(maxlen=100)

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            if info["ending"]:
                self._ended.append((info["ending"] == "goal_reached", info["time_s"]))
        return True

    def _on_rollout_end(self) -> None:
        if self._ended:
            success, duration = np.mean(self._ended, axis=0)
            self._rows.writerow(
                [self.num_timesteps, f"{success:.3f}", f"{duration:.2f}"]
            )
            self._file.flush()


def exported(model: PPO, task: Task) -> NetworkPolicy:
    """Return the mean action of a model as a network of its raw observations."""
    layers = [*model.policy.mlp_extractor.policy_net, model.policy.action_net]
    linear = [layer for layer in layers if isinstance(layer, torch.nn.Linear)]
    weights = [layer.weight.detach().numpy().astype(float) for layer in linear]
    biases = [layer.bias.detach().numpy().astype(float) for layer in linear]
    normalised = model.get_vec_normalize_env()
    assert normalised is not None
    scale = 1 / np.sqrt(normalised.obs_rms.var + normalised.epsilon)
    # The normalisation of the observations becomes part of the first layer.
    biases[0] -= weights[0] @ (normalised.obs_rms.mean * scale)
    weights[0] *= scale
    names = tuple(signal.name for signal in task.observations)
    return NetworkPolicy(task.name, names, tuple(zip(weights, biases, strict=True)))


def train(
    folder: Path, seed: int, steps: int, make: Callable[[], gymnasium.Env]
) -> None:
    """Train one policy and write it with its learning curve."""
    folder.mkdir(parents=True, exist_ok=True)
    environments = DummyVecEnv([make] * ENVIRONMENTS)
    model = PPO(
        "MlpPolicy",
        VecNormalize(environments, gamma=DISCOUNT),
        n_steps=256,
        batch_size=256,
        n_epochs=10,
        learning_rate=lambda left: 3e-4 * left,
        gamma=DISCOUNT,
        policy_kwargs={"net_arch": [32, 32], "log_std_init": -0.5},
        seed=seed,
        device="cpu",
    )
    model.learn(steps, LearningCurve(folder / "curve.csv"))
    exported(model, environments.envs[0].unwrapped.task).save(folder / "policy.npz")


def draw(curves: list[Path], path: Path) -> None:
    """Draw success rate and mean duration over the steps, one line per curve."""
    figure = Figure(figsize=(7.0, 2.8), layout="constrained")
    axes = figure.subplots(1, 2)
    for curve in curves:
        steps, success, duration = np.loadtxt(
            curve, delimiter=",", skiprows=1, ndmin=2
        ).T
        axes[0].plot(steps / 1e3, 100 * success, linewidth=1)
        axes[1].plot(steps / 1e3, duration, linewidth=1)
    axes[0].set_ylabel("goals reached, %")
    axes[1].set_ylabel("mean duration of an episode, s")
    axes[1].axhline(
        FOLLOWER_S, color="black", linestyle="--", label="planner and follower"
    )
    axes[1].legend(frameon=False)
    for axis in axes:
        axis.set_xlabel("steps of the environment, thousands")
        axis.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=150)


def main() -> None:
    """Train a policy and write it with its learning curve."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--task", choices=TASKS, default="GoTo")
    parser.add_argument(
        "--observations", nargs="+", default=GROUPS, help="groups of observations"
    )
    parser.add_argument("--steps", type=int, default=200_000, help="environment steps")
    parser.add_argument(
        "--time-weight", type=float, default=0.2, help="penalty per second"
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--out", type=Path, default=Path("runs/ppo"))
    given = parser.parse_args()
    torch.set_num_threads(1)
    make = partial(make_environment, given.task, given.observations, given.time_weight)
    for seed in given.seeds:
        folder = given.out / f"seed_{seed}"
        if not (folder / "policy.npz").is_file():
            train(folder, seed, given.steps, make)
    draw(
        [given.out / f"seed_{seed}/curve.csv" for seed in given.seeds],
        given.out / "curve.png",
    )
    print(f"{given.out}: {len(given.seeds)} policies, curve.png")


if __name__ == "__main__":
    main()
