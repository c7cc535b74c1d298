"""Policies stored as files: small networks, evaluated with NumPy."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from srs_twin.envs.task import Task
from srs_twin.errors import InputError, UnknownNameError
from srs_twin.io.files import atomic_write, data_root, require_file

SHIPPED = "calibration/policies"
"""Folder of the shipped policies."""


@dataclass(frozen=True)
class NetworkPolicy:
    """Fully connected network with tanh between its layers; its output is clipped to −1 and 1.

    Attributes:
        task: name of the task.
        observations: names of the observations that are its input, in order.
        layers: weights, shape (outputs, inputs), and biases, shape (outputs,), of each layer.
    """

    task: str
    observations: tuple[str, ...]
    layers: tuple[tuple[np.ndarray, np.ndarray], ...]

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return the action, float32 from −1 to 1, for the observations of the policy, in order."""
        values = np.asarray(observation, dtype=float)
        for weights, biases in self.layers[:-1]:
            values = np.tanh(weights @ values + biases)
        weights, biases = self.layers[-1]
        return np.clip(weights @ values + biases, -1.0, 1.0).astype(np.float32)

    def bind(self, task: Task) -> Callable[[np.ndarray], np.ndarray]:
        """Return a function from the observations of a task to actions.

        Raises:
            InputError: the task is another one, lacks observations of the policy, or has physical actions.
        """
        names = [signal.name for signal in task.observations]
        missing = [name for name in self.observations if name not in names]
        if task.name != self.task or missing or task.action_range != "unit":
            raise InputError(
                f"the policy is for task {self.task} with actions from −1 to 1 and the observations "
                f"{', '.join(self.observations)}; the task {task.name} "
                + (f"has no {', '.join(missing)}" if missing else "differs")
            )
        indices = [names.index(name) for name in self.observations]
        return lambda observation: self(np.asarray(observation)[indices])

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the policy as an npz file, weights in single precision."""
        arrays: dict[str, np.ndarray] = {
            "task": np.array(self.task), "observations": np.array(self.observations)
        }  # fmt: skip
        for k, (weights, biases) in enumerate(self.layers):
            arrays |= {f"weights_{k}": weights.astype(np.float32), f"biases_{k}": biases.astype(np.float32)}
        with atomic_write(Path(path)) as temporary, open(temporary, "wb") as file:
            np.savez_compressed(file, **arrays)  # type: ignore[arg-type]


def load_policy(name_or_path: str | os.PathLike[str]) -> NetworkPolicy:
    """Load a policy by path, or a shipped one by name ("goto").

    Raises:
        UnknownNameError: no shipped policy has the name.
        InputError: the file does not exist or does not contain a policy.
    """
    path = Path(os.fspath(name_or_path))
    if not path.suffix and path.name == os.fspath(name_or_path):
        names = sorted(entry.stem for entry in (data_root() / SHIPPED).glob("*.npz"))
        if path.name not in names:
            raise UnknownNameError("policy", path.name, names)
        path = data_root() / SHIPPED / f"{path.name}.npz"
    require_file(path, suffix=".npz")
    try:
        with np.load(path, allow_pickle=False) as arrays:
            count = sum(key.startswith("weights_") for key in arrays)
            layers = tuple(
                (arrays[f"weights_{k}"].astype(float), arrays[f"biases_{k}"].astype(float))
                for k in range(count)
            )
            policy = NetworkPolicy(str(arrays["task"]), tuple(map(str, arrays["observations"])), layers)
    except (KeyError, ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: not a policy file ({error}); examples/train_ppo.py writes one") from error
    sizes = [len(policy.observations), *(len(biases) for _, biases in layers)]
    shapes = [weights.shape for weights, _ in layers]
    finite = all(np.isfinite(array).all() for layer in layers for array in layer)
    if not layers or not finite or shapes != [(after, before) for before, after in pairwise(sizes)]:
        raise InputError(f"{path}: the layers of the policy do not fit together, or have no finite numbers")
    return policy
