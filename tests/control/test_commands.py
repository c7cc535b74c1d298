"""Commanded gaits: continuous phase, regulated supply, and limits."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, strategies as st
from snakes import robot

from srs_twin import Gait, InputError, TwinSnake
from srs_twin.control.commands import CommandedGait, GaitCommand, GaitLimits
from srs_twin.pneumatics import make_pneumatics
from srs_twin.recordings.recorded_pressures import RecordedPressures

pytestmark = pytest.mark.fast

SPEC = robot()
FREQUENCIES = st.floats(0.3, 4.0)


@given(FREQUENCIES, FREQUENCIES, st.floats(0.0, 50.0), st.floats(0.0, 1.0))
def test_phase_is_continuous_when_the_frequency_changes(before, after, time, later):
    gait = Gait(before)
    gait.reset(SPEC, 0.02)
    angle = gait.angle(time)
    lags = np.diff(gait.phase_lag)
    gait.change_frequency(after, time)
    assert gait.angle(time) == pytest.approx(angle, abs=1e-9)
    assert gait.angle(time + later) - angle == pytest.approx(
        2 * math.pi * after * later, abs=1e-9
    )
    assert np.diff(gait.phase_lag) == pytest.approx(lags, abs=1e-9)


def test_an_invalid_frequency_is_refused_without_effect():
    gait = Gait(2.0)
    gait.reset(SPEC, 0.02)
    for frequency in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(InputError, match="gait frequency"):
            gait.change_frequency(frequency, 1.0)
    assert gait.frequency == 2.0 and gait.angle(1.0) == pytest.approx(4 * math.pi)


def test_regulated_chambers_equal_chambers_made_for_that_pressure():
    made = make_pneumatics("lag", SPEC, supply_pa=45e3, layout="3/2")
    regulated = make_pneumatics("lag", SPEC, supply_pa=60e3, layout="3/2")
    regulated.set_supply_pressure(45e3)
    gait = Gait(2.0)
    gait.reset(SPEC, 0.02)
    for k in range(30):
        traces = []
        for chambers in (made, regulated):
            schedule = chambers.schedule(gait.valves_at(0.02 * k), 0.02)
            traces.append(chambers.advance(schedule, np.array([0.01, 0.02])))
        assert (traces[0].pressure == traces[1].pressure).all() and (
            traces[0].pneumatic_energy == traces[1].pneumatic_energy
        ).all()


def test_invalid_supply_pressures_are_refused():
    for kind in ("lag", "orifice"):
        chambers = make_pneumatics(kind, SPEC, supply_pa=60e3, layout="3/2")
        for pressure in (-1.0, 60.1e3, math.nan):
            with pytest.raises(
                InputError,
                match="it must be between 0 and 60000 Pa, the supply pressure that"
                " was given",
            ):
                chambers.set_supply_pressure(pressure)
    log = RecordedPressures(
        SPEC, np.array([0.0, 1.0]), np.zeros((2, 4, 2)), supply_pa=60e3
    )
    with pytest.raises(
        InputError, match="'recorded' has no pressure regulator; use 'lag' or 'orifice'"
    ):
        log.set_supply_pressure(1e3)


def test_a_command_changes_gait_and_supply():
    twin = TwinSnake(SPEC, supply_pa=55e3)
    gait = CommandedGait(SPEC, twin.tick, twin.pneumatics, GaitCommand(0.0, 1.0, 41e3))
    highest = []
    for command in (GaitCommand(0.0, 1.0, 41e3), GaitCommand(0.3, 2.0, 55e3)):
        state = twin.reset()
        for _ in range(100):
            state = twin.step(gait.valves(float(state.time), command))
            highest.append(float(state.pressure.max()))
        assert gait.command == command
    # With an offset of 0.3 a chamber fills for 0.3 s of 0.5 s, three time constants.
    assert max(highest[:100]) <= 41e3 < max(highest[100:]) <= 55e3
    assert float(state.heading) > 1.0


def test_limits_are_those_of_the_dissertation_and_clip_every_parameter():
    limits = GaitLimits.for_robot(SPEC)
    assert limits.offset == (-0.4, 0.4) and limits.frequency == (1.0, 2.0)
    # Section 3.4.2: 41 to 55 kPa.
    assert limits.pressure == (
        pytest.approx(41e3, rel=0.01),
        pytest.approx(55e3, rel=0.01),
    )
    assert limits.clipped(GaitCommand(-1.0, 9.0, 0.0)) == GaitCommand(
        -0.4, 2.0, limits.pressure[0]
    )
    for name in ("gen1", "gen3", "gen4"):
        spec = robot(name)
        assert GaitLimits.for_robot(spec).pressure[1] <= spec.supply.pulsed_limit
