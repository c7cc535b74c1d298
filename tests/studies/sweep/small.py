"""Sweep of eight short runs, and an engine that runs them in this process."""

from __future__ import annotations

import numpy as np

from srs_twin.compute.workers import TaskResult
from srs_twin.errors import DivergedError
from srs_twin.io.documents import parse_yaml
from srs_twin.studies.sweep.execution import open_sweep
from srs_twin.studies.sweep.table import SweepTable
from srs_twin.studies.sweep.task import run_point

SMALL = """\
scenario: gen2_straight
plants: [analytical]
fixed: {duration_s: 2}
vary:
  controller.frequency_hz: [2, 2.5]
  supply.pressure_kpa: {from: 41, to: 55, count: 4}
"""


def here(experiment, points):
    """Run points one after the other."""
    for number, point in enumerate(points):
        yield TaskResult(number, run_point(experiment, point), None)


def diverges(experiment, points):
    """Fail every second point."""
    for done in here(experiment, points):
        yield (
            TaskResult(done.number, None, DivergedError("twin", 1.0, "boom"))
            if done.number % 2
            else done
        )


def execute(sweep, folder, engine=here, *, points=None, changed=False, **options):
    """Run missing points, at most `points` of them; return their number and the summary."""
    with open_sweep(sweep, folder, changed=changed) as opened:
        missing = opened.missing(**options)[:points]
        opened.run(engine, missing)
        return len(missing), opened.finish()


def table_of(columns):
    """Return the results with some columns, such as arrays."""
    return SweepTable(
        {
            name: np.asarray(column, dtype=object).tolist()
            for name, column in columns.items()
        }
    )


def write(folder, text=SMALL, name="small.yaml"):
    """Write a sweep file and return its path."""
    assert parse_yaml(text, name).problems == []
    path = folder / name
    path.write_text(text)
    return path
