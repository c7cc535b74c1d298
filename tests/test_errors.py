"""Errors come back whole from another process, whatever their constructors take."""

from __future__ import annotations

import pickle

import pytest

from srs_twin.errors import (
    DivergedError,
    InputError,
    InputFileError,
    SrsError,
    TaskFailedError,
    TimeStepError,
    UnknownNameError,
    WorkerDiedError,
)

EVERY = [
    InputError("no such file"),
    UnknownNameError("metric", "sped", ["speed", "yaw"]),
    TimeStepError("tick", 0.02, "time step", 0.003),
    InputFileError(["a.yaml:1:2: x: unknown key", "a.yaml:3:4: y: missing"]),
    DivergedError("twin", 0.31, "it flew", history=[1, 2]),
    TaskFailedError(ZeroDivisionError("division by zero")),
    WorkerDiedError(-9, 3),
]


def kinds(kind: type) -> set[type]:
    return {kind}.union(*(kinds(each) for each in kind.__subclasses__()))


@pytest.mark.parametrize("error", EVERY, ids=lambda error: type(error).__name__)
def test_survives_the_way_between_processes(error):
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is type(error)
    assert (str(again), again.exit_code, again.__dict__) == (str(error), error.exit_code, error.__dict__)


def test_every_kind_was_tried():
    ours = {kind for kind in kinds(SrsError) if kind.__module__ == "srs_twin.errors"}
    assert ours - {type(error) for error in EVERY} <= {SrsError}
