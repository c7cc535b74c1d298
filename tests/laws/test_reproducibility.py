"""The same seed gives the same bytes, in whatever process."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from srs_twin import AnalyticalSnake, Gait, TwinSnake, load_robot, rollout

RUN = """
import hashlib, io
from srs_twin import AnalyticalSnake, Gait, TwinSnake, load_robot, rollout
for plant in (AnalyticalSnake(load_robot("gen2")), TwinSnake(load_robot("gen2"))):
    file = io.BytesIO()
    rollout(plant, Gait(1.7, 0.1), 0.6, seed=3).to_parquet(file)
    print(plant.name, hashlib.sha256(file.getvalue()).hexdigest())
"""


@pytest.mark.slow
def test_same_seed_gives_the_same_bytes_in_three_processes():
    runs = [
        subprocess.Popen(
            [sys.executable, "-c", RUN],
            env={**os.environ, "PYTHONHASHSEED": str(hash_seed)},
            stdout=subprocess.PIPE,
            text=True,
        )
        for hash_seed in (0, 1, 2)
    ]
    outputs = [run.communicate(timeout=600)[0] for run in runs]
    assert [run.returncode for run in runs] == [0, 0, 0]
    assert [line.split()[0] for line in outputs[0].splitlines()] == ["analytical", "twin"]
    assert len(set(outputs)) == 1


def test_running_a_plant_again_repeats_itself():
    for plant in (AnalyticalSnake(load_robot("gen2")), TwinSnake(load_robot("gen2"))):
        first = rollout(plant, Gait(2.0, 0.3), 0.4)
        rollout(plant, Gait(1.0, -0.3), 0.2, pose=(1.0, 2.0, 3.0))
        again = rollout(plant, Gait(2.0, 0.3), 0.4)
        assert all((first[name] == again[name]).all() for name in first.columns)
        assert first.metadata == again.metadata
