r"""Sidewinding of a stiff, thin snake compared with the kinematics without slip (Burdick et al. 1995).

A wave travels along the body with the speed c = f Λ, Λ the arc length of one wave. Seen
from the wave, the material moves along the body with this speed. The parts that rest on
the floor do not move, so the body moves with the velocity

$$ v = c\,(\langle t \rangle - t_c), $$

with the mean of the body's tangents ⟨t⟩ and the tangent t_c of the parts that carry the
load.
"""

import math

import numpy as np
import pytest

from srs_twin import Gait, load_robot, rollout
from srs_twin.control.gait import PitchWave
from srs_twin.plants.twin.snake import TwinSnake

FREQUENCY_HZ = 0.25
WAVE_SEGMENTS = 8
SETTLED_S = 8.0


@pytest.mark.slow
@pytest.mark.parametrize("fraction", [0.3, 0.15])
def test_a_stiff_sidewinder_travels_as_the_kinematics_without_slip_predict(fraction):
    spec = load_robot("spatial_slender")
    gait = Gait(FREQUENCY_HZ, pitch=PitchWave(fraction, math.pi / 2))
    twin = TwinSnake(spec, supply_pa=30e3, timestep=0.002)
    run = rollout(twin, gait, SETTLED_S + 3 / FREQUENCY_HZ, record_hz=50)
    used = run.time >= SETTLED_S
    w, x, y, z = (run.stack(f"quaternion_{axis}")[used] for axis in "wxyz")
    tangent = np.stack([1 - 2 * (y**2 + z**2), 2 * (x * y + w * z)], axis=-1)
    load = run.stack("load")[used]
    supported = (tangent * load[..., None]).sum(axis=(0, 1)) / load.sum()
    wave_speed = FREQUENCY_HZ * WAVE_SEGMENTS * spec.geometry.pitch
    expected = wave_speed * (tangent.mean(axis=(0, 1)) - supported)
    com = run.com[used]
    measured = (com[-1] - com[0]) / (3 / FREQUENCY_HZ)
    assert np.hypot(*measured) == pytest.approx(np.hypot(*expected), rel=0.12)
    direction = math.atan2(measured[1], measured[0]) - math.atan2(
        expected[1], expected[0]
    )
    assert abs(math.degrees(direction)) < 3.0
    # It travels to the right, across its heading, and supported parts slip slowly.
    assert math.degrees(math.atan2(measured[1], measured[0])) == pytest.approx(
        -90.0, abs=15.0
    )
    speed = np.linalg.norm(np.gradient(run.position, run.time, axis=0), axis=-1)[used]
    assert (speed * load).sum() / load.sum() < 0.3 * np.hypot(*measured)
