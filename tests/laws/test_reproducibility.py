"""The same seed gives the same bytes in every process."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading

import numpy as np
import pytest
from snakes import chain
from threadpoolctl import threadpool_info, threadpool_limits

from srs_twin import AnalyticalSnake, Gait, TwinSnake, load_robot, rollout
from srs_twin.compute.arrays import one_blas_thread

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
    assert [line.split()[0] for line in outputs[0].splitlines()] == [
        "analytical",
        "twin",
    ]
    assert len(set(outputs)) == 1


DIGEST = """
import hashlib
from srs_twin import Gait, TwinSnake, load_robot, rollout
from srs_twin.scenario.provenance import arithmetic
run = rollout(TwinSnake(load_robot("gen2"), contact="loaded"), Gait(2.0, 0.2), 0.2)
print(arithmetic(), hashlib.sha256(run["com_x"].tobytes() + run["heading"].tobytes()).hexdigest())
"""


@pytest.mark.slow
def test_bits_are_independent_of_the_blas_kernel():
    """OpenBLAS replaces a kernel that the processor cannot execute, or the process ends at its first use."""
    digests: dict[str, set[str]] = {}
    for kernel in ("Haswell", "SkylakeX", "Sandybridge", "Nehalem"):
        environment = {**os.environ, "OPENBLAS_CORETYPE": kernel}
        done = subprocess.run(
            [sys.executable, "-c", DIGEST],
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode == -signal.SIGILL:
            continue
        done.check_returncode()
        name, digest = done.stdout.split()
        digests.setdefault(name, set()).add(digest)
    assert len(digests) > 1, "OPENBLAS_CORETYPE selects no other kernel here"
    assert all(len(result) == 1 for result in digests.values())


@pytest.mark.slow
def test_long_twin_is_independent_of_blas_threads():
    dampers = []
    for threads in (1, 2):
        with threadpool_limits(threads, "blas"):
            twin = TwinSnake(chain((0.05,) * 61), contact="loaded")
        dampers.append(twin.physics.stepper.records["sparsity"].damping)
    assert np.array_equal(*dampers)


def test_concurrent_construction_keeps_the_number_of_blas_threads():
    def blas_threads():
        return {
            item["num_threads"]
            for item in threadpool_info()
            if item["user_api"] == "blas"
        }

    def hold(entered, leave):
        with one_blas_thread():
            entered.set()
            leave.wait(1.0)
            seen.append(blas_threads())

    seen = []
    before = blas_threads()
    events = [threading.Event() for _ in range(4)]
    first = threading.Thread(target=hold, args=events[:2])
    second = threading.Thread(target=hold, args=events[2:])
    first.start()
    events[0].wait(5.0)
    second.start()
    events[2].wait(0.2)
    events[1].set()
    first.join()
    events[3].set()
    second.join()
    assert seen == [{1}, {1}] and blas_threads() == before


def test_bits_are_independent_of_other_blas_libraries():
    pytest.importorskip("cv2")
    code = (
        "from srs_twin.compute.arrays import blas_kernels as b; print(b()); import cv2;"
        " print(b())"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    before, after = done.stdout.splitlines()
    assert before == after


def test_second_run_of_a_plant_repeats_the_first():
    for plant in (AnalyticalSnake(load_robot("gen2")), TwinSnake(load_robot("gen2"))):
        first = rollout(plant, Gait(2.0, 0.3), 0.4)
        rollout(plant, Gait(1.0, -0.3), 0.2, pose=(1.0, 2.0, 3.0))
        again = rollout(plant, Gait(2.0, 0.3), 0.4)
        assert all((first[name] == again[name]).all() for name in first.columns)
        assert first.metadata == again.metadata
