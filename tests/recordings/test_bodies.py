"""Rigid bodies in recordings keep the identity that their names state, at any rate."""

from __future__ import annotations

import numpy as np
import pytest
from recorded import SPEC
from synthetic import Snake
from test_formats import motive

from srs_twin.recordings.inspection import inspect_file
from srs_twin.recordings.recording import read_motion
from srs_twin.recordings.recording_map import NO_MAP

SPEEDS = (0.05, 0.2, 0.5)
RATES = (5.0, 10.0, 15.0, 30.0, 120.0)


def motive_bodies(path, truth, names, mounted=0.0):
    """Write the connectors as rigid bodies of Motive that are mounted at given angles, rad."""
    half = (truth.stack("connector_heading") + mounted) / 2
    turns = np.stack([0 * half, np.sin(half), 0 * half, np.cos(half)], axis=-1)
    x, y = np.moveaxis(truth.position, -1, 0)
    points = np.stack([x, np.full_like(x, 0.03), -y], axis=-1)
    path.write_bytes(motive(truth.time, points, turns, names=names))


@pytest.mark.default_cases(at=[0, 9, 10])
@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize("speed", SPEEDS)
def test_bodies_are_read_at_any_rate(tmp_path, rate, speed):
    truth = Snake(
        speed=speed, frequency=0.6, record_hz=rate, duration=12.0
    ).trajectory()
    path = tmp_path / "bodies.csv"
    # The order in the file is not the order along the body.
    motive_bodies(path, truth, ["e", "a", "c", "b", "d"], 0.7 * np.arange(5))
    found = read_motion(path, SPEC, head="e").trajectory
    assert len(found.time) == len(truth.time)
    error = found.stack("bend") - truth.stack("bend")
    assert np.sqrt((error**2).mean()) < 0.03


def test_a_hidden_body_is_interpolated_and_keeps_its_name(tmp_path):
    truth = Snake(frequency=0.6, record_hz=15.0, duration=12.0).trajectory()
    path = tmp_path / "bodies.csv"
    motive_bodies(path, truth, "abcde")
    lines = path.read_text().splitlines()
    for row in (60, 61):
        cells = lines[row].split(",")
        cells[9:16] = [""] * 7
        lines[row] = ",".join(cells)
    path.write_text("\n".join(lines) + "\n")
    found = read_motion(path, SPEC, head="a").trajectory
    error = found.stack("bend") - truth.stack("bend")
    assert found.stack("filled")[:, 1].sum() == 2
    assert np.sqrt((error**2).mean()) < 0.03


@pytest.mark.parametrize("rate", [1.0, 5.0, 200.0])
def test_a_single_body_is_described(tmp_path, rate):
    path = tmp_path / "body.tum"
    rows = [f"{k / rate} {0.2 * k / rate} 0.0 0.03 0 0 0 1" for k in range(60)]
    path.write_text("\n".join(rows) + "\n")
    facts, _ = inspect_file(path, NO_MAP, None)
    assert facts.bodies == ["body"] and facts.rate_hz == pytest.approx(rate)
    assert facts.markers[0].coverage == 1.0
