r"""Sidewinding of a stiff, thin snake compared with the kinematics without slip (Burdick et al. 1995).

A wave travels along the body with the speed c = f Λ, Λ the arc length of one wave. Seen from the wave, the
material moves along the body with this speed. The parts that rest on the floor do not move, so the body moves
with the velocity

$$ v = c\,(\langle t \rangle - t_c), $$

with the mean of the body's tangents ⟨t⟩ and the tangent t_c of the parts that carry the load.
"""

import math
from dataclasses import replace

import numpy as np
import pytest

from srs_twin import Gait, load_robot, rollout
from srs_twin.control.gait import PitchWave
from srs_twin.plants.twin.snake import TwinSnake
from srs_twin.robot.spec import Mass

FREQUENCY_HZ = 0.25
WAVE_SEGMENTS = 8
SETTLED_S = 8.0


def stiff_snake():
    """Return a snake of two waves that is stiff and thin, with slow chambers that make smooth waves."""
    spec = load_robot("spatial_example")
    geometry = replace(
        spec.geometry, com_height=0.004, wheel_radius=0.004, half_track=4e-6, width=0.008, connectors=17
    )
    return replace(
        spec,
        geometry=geometry,
        mass=Mass.along_body((0.025,) * 16),
        bending=replace(
            spec.bending, stiffness=20.0, pitch_stiffness=20.0, roll_stiffness=40 / 3, damping_time=0.01
        ),
        actuator=replace(spec.actuator, tau_fill=2.0, tau_vent=2.0),
        friction=replace(spec.friction, mu_t=0.6, mu_n=0.6, mu_back=0.6),
    )


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.3, 0.15])
def test_a_stiff_sidewinder_travels_as_the_kinematics_without_slip_predict(share):
    spec = stiff_snake()
    gait = Gait(FREQUENCY_HZ, phase_step=2 * math.pi / WAVE_SEGMENTS, pitch=PitchWave(share, math.pi / 2))
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
    direction = math.atan2(measured[1], measured[0]) - math.atan2(expected[1], expected[0])
    assert abs(math.degrees(direction)) < 3.0
    # It travels to the right, across its heading, and supported parts slip slowly.
    assert math.degrees(math.atan2(measured[1], measured[0])) == pytest.approx(-90.0, abs=15.0)
    speed = np.linalg.norm(np.gradient(run.position, run.time, axis=0), axis=-1)[used]
    assert (speed * load).sum() / load.sum() < 0.3 * np.hypot(*measured)
