"""Valves and chambers compared with their differential equations, and the rules of their layouts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.integrate import solve_ivp
from snakes import chain

from srs_twin import DivergedError, InputError, RobotSpec
from srs_twin.pneumatics import LagPneumatics, Schedule, make_pneumatics
from srs_twin.pneumatics.chambers import AMBIENT_PA
from srs_twin.pneumatics.lag import lag_response, relaxation_of

pytestmark = pytest.mark.fast

SUPPLY = 50e3
GAIN = 3e-5
HELD = np.zeros((1, 2, 2), np.int8)


def actuated(
    segments: int = 2, *, fill: float = 0.11, vent: float = 0.11, mode: float = 0.00214
) -> RobotSpec:
    """Return a robot with other time constants (s) and a gain of 3e-5 rad/Pa."""
    spec = chain((0.03,) * (segments + 1))
    actuator = replace(
        spec.actuator, tau_fill=fill, tau_vent=vent, tau_mode=mode, gain=GAIN
    )
    return replace(spec, actuator=actuator)


def commands(
    ticks: int, slots: int, segments: int, states: tuple[int, ...]
) -> st.SearchStrategy[np.ndarray]:
    """Return random valve sequences of shape (ticks, slots, segments, 2)."""
    count = ticks * slots * segments * 2
    flat = st.lists(st.sampled_from(states), min_size=count, max_size=count)
    return flat.map(
        lambda v: np.array(v, dtype=np.int8).reshape(ticks, slots, segments, 2)
    )


TIMES = st.floats(0.005, 0.5)


@settings(max_examples=25)
@given(
    commands(4, 3, 1, (-1, 0, 1)),
    TIMES,
    TIMES,
    st.floats(0.001, 0.05),
    st.sampled_from([0.0, 0.7]),
)
def test_closed_form_solves_the_differential_equations(valves, fill, vent, mode, leak):
    pneumatics = LagPneumatics(
        actuated(1, fill=fill, vent=vent, mode=mode),
        supply_pa=SUPPLY,
        layout="in_out",
        leak_per_s=leak,
    )
    tick = 0.03
    values = np.zeros(3)
    at = np.array([0.004, 0.01, 0.017, 0.0299, tick])
    for slots in valves:
        trace = pneumatics.advance(pneumatics.schedule(slots, tick), at)
        for k, state in enumerate(slots[:, 0, :]):
            rows = np.flatnonzero(
                (at > tick * k / 3 + 1e-12) & (at <= tick * (k + 1) / 3 + 1e-12)
            )
            inside = at[rows] - tick * k / 3

            def rates(_, y, state=state):
                filling = np.where(state == 1, (SUPPLY - y[:2]) / fill, 0) - np.where(
                    state == -1, y[:2] / vent, 0
                )
                return [*(filling - leak * y[:2]), (GAIN * (y[0] - y[1]) - y[2]) / mode]

            # The tolerances do not control the error of the interpolant: the steps must
            # resolve the mode.
            solution = solve_ivp(
                rates,
                (0, tick / 3),
                values,
                method="DOP853",
                rtol=1e-10,
                atol=[1e-5, 1e-5, 1e-11],
                dense_output=True,
                max_step=mode / 2,
            )
            expected = solution.sol(inside).T
            assert trace.pressure[rows, 0] == pytest.approx(
                expected[:, :2], abs=1e-6 * SUPPLY
            )
            assert trace.bend[rows, 0] == pytest.approx(expected[:, 2], abs=1e-6)
            derivative = [rates(0, y)[2] for y in expected]
            assert trace.bend_rate[rows, 0] == pytest.approx(
                derivative, abs=1e-6 / mode
            )
            values = solution.y[:, -1]


@settings(max_examples=30)
@given(commands(6, 3, 2, (-1, 0, 1)))
def test_openings_count_changes_to_filling(valves):
    pneumatics = LagPneumatics(actuated(), supply_pa=SUPPLY, layout="in_out")
    expected = np.zeros((2, 2), dtype=int)
    last = np.full((2, 2), -1)
    for state in valves.reshape(-1, 2, 2):
        expected += (state == 1) & (last != 1)
        last = state
    for slots in valves:
        pneumatics.advance(pneumatics.schedule(slots, 0.02), np.array([0.02]))
    assert (pneumatics.openings == expected).all()


@pytest.mark.default_cases(3)
@pytest.mark.parametrize("excess", [0.0, 1e-8, 1e-7, 3e-6, 1e-4])
def test_equal_time_constants_have_a_finite_limit(excess):
    """For τ₁ → τ₂ the step response tends to 1 − (1 + t/τ) e^{−t/τ}."""
    tau = 0.05
    time = np.linspace(0, 0.4, 9)
    pneumatics = LagPneumatics(
        actuated(1, fill=tau, vent=tau, mode=tau * (1 + excess)), supply_pa=SUPPLY
    )
    bend = pneumatics.advance(pneumatics.schedule([[1, -1]], 0.4), time).bend[:, 0]
    expected = GAIN * SUPPLY * (1 - (1 + time / tau) * np.exp(-time / tau))
    assert bend == pytest.approx(expected, abs=(1e-6 + excess) * GAIN * SUPPLY)


@pytest.mark.default_cases(3)
@pytest.mark.parametrize("excess", [0.0, 1e-9, -1e-9, 5e-7, -5e-7, 1e-3])
def test_a_lag_with_the_time_constant_of_the_filling_follows_the_equations(excess):
    tau = 0.1
    fill = (1 + excess) / tau
    relaxation = relaxation_of(fill, 0.0, 50e3)
    start = [10e3, 4e3]

    def rates(_, state):
        pressure, lagged = state
        return [fill * (50e3 - pressure), (pressure - lagged) / tau]

    for time in (0.02, 0.3):
        solved = solve_ivp(rates, (0, time), start, rtol=1e-11, atol=1e-6).y[1, -1]
        lagged = lag_response(start[1], start[0], relaxation, tau, time)
        assert lagged == pytest.approx(solved, rel=1e-6)


@settings(max_examples=15, deadline=None)
@given(commands(4, 2, 1, (-1, 0, 1)), st.sampled_from([0.0, 0.6]))
def test_air_is_the_integrated_inflow(valves, leak):
    """∫ V (p_s − p)/τ + (p + p_a) V' dt over the fills, integrated with the equations."""
    spec = actuated(1)
    tau = 0.11
    pneumatics = LagPneumatics(spec, supply_pa=SUPPLY, layout="in_out", leak_per_s=leak)
    values = np.zeros(4)
    space = spec.chamber
    worth = SUPPLY / (SUPPLY + AMBIENT_PA)
    for slots in valves:
        trace = pneumatics.advance(
            pneumatics.schedule(slots, 0.1), np.linspace(0.002, 0.1, 50)
        )
        for state in slots[:, 0, :]:

            def rates(_, y, state=state):
                filling = np.where(state == 1, (SUPPLY - y[:2]) / tau, 0)
                turning = (GAIN * (y[0] - y[1]) - y[2]) / 0.00214
                sign = np.array([1.0, -1.0])
                volume = space.dead_volume + space.displacement * np.maximum(
                    0, sign * y[2]
                )
                growing = (
                    space.displacement * np.where(sign * y[2] > 0, sign, 0) * turning
                )
                drawn = (
                    (volume * filling + (y[:2] + AMBIENT_PA) * growing) * (state == 1)
                ).sum()
                rate = filling - np.where(state == -1, y[:2] / tau, 0) - leak * y[:2]
                return [*rate, turning, worth * drawn]

            values = solve_ivp(
                rates,
                (0, 0.05),
                values,
                method="LSODA",
                rtol=1e-9,
                atol=[1e-4, 1e-4, 1e-10, 1e-9],
                max_step=5e-4,
            ).y[:, -1]
        assert (
            trace.pneumatic_energy[-1]
            == pneumatics.pneumatic_energy
            == pytest.approx(values[3], abs=2e-6)
        )


@pytest.mark.default_cases(at=[0, 3, 4])
@pytest.mark.parametrize("kind", ["lag", "orifice"])
@pytest.mark.parametrize("delay", [0.003, 0.02, 0.0535])
def test_valve_delay_shifts_the_response_across_ticks(kind, delay):
    prompt, late = (
        make_pneumatics(
            kind,
            actuated(),
            supply_pa=SUPPLY,
            layout="in_out",
            leak_per_s=0.2,
            valve_delay_s=d,
        )
        for d in (0.0, delay)
    )
    valves = np.random.default_rng(7).choice([-1, 0, 1], size=(9, 2, 2, 2))
    times = np.linspace(0.0, 0.18, 1801)
    whole = prompt.advance(prompt.schedule(valves.reshape(-1, 2, 2), 0.18), times)
    pressures = []
    states = []
    for slots in valves:
        trace = late.advance(late.schedule(slots, 0.02), np.array([0.01, 0.02]))
        pressures.append(trace.pressure)
        states.append(trace.valves)
    ends = 0.01 * np.arange(1, 19) - delay
    for k in np.ndindex(2, 2):
        expected = np.interp(ends, times, whole.pressure[(slice(None), *k)], left=0.0)
        assert np.concatenate(pressures)[(slice(None), *k)] == pytest.approx(
            expected, abs=0.01 * SUPPLY
        )
    # Before the first command arrives valves vent, which opens nothing.
    assert (np.concatenate(states)[ends < 0] == -1).all()
    assert (late.openings <= prompt.openings).all() and late.openings.sum() > 0


def test_effective_schedule_includes_delay():
    pneumatics = LagPneumatics(actuated(), supply_pa=SUPPLY, valve_delay_s=0.03)
    fill = np.ones((2, 2), dtype=np.int8)
    first = pneumatics.schedule(fill, 0.02)
    assert pneumatics.effective_schedule(first).states.tolist() == [(-fill).tolist()]
    pneumatics.advance(first, np.zeros(0))
    second = pneumatics.schedule(fill, 0.02)
    assert pneumatics.effective_schedule(second).events == pytest.approx([0.01])
    assert pneumatics.openings.sum() == 0 and pneumatics.valves.max() == -1
    pneumatics.advance(second, np.zeros(0))
    assert (pneumatics.openings == 1).all() and pneumatics.valves.min() == 1


def test_reset_empties_all_chambers():
    pneumatics = LagPneumatics(actuated(), supply_pa=SUPPLY)
    pneumatics.advance(
        pneumatics.schedule(np.ones((2, 2), dtype=np.int8), 0.1), np.array([0.1])
    )
    assert pneumatics.pressure.min() > 0 and (pneumatics.openings == 1).all()
    assert pneumatics.pneumatic_energy > 0
    pneumatics.reset()
    assert (
        not pneumatics.pressure.any()
        and not pneumatics.bend.any()
        and not pneumatics.openings.any()
    )
    assert pneumatics.pneumatic_energy == 0.0
    assert (pneumatics.valves == -1).all()


@pytest.mark.parametrize(
    ("attribute", "name"),
    [
        ("pressure", "pressure"),
        ("bend", "free bend"),
        ("pneumatic_energy", "air drawn"),
    ],
)
def test_diverged_chambers_name_value_and_time(attribute, name):
    pneumatics = LagPneumatics(actuated(), supply_pa=SUPPLY)
    vent = pneumatics.schedule(np.full((2, 2), -1), 0.3)
    pneumatics.advance(vent, np.zeros(0))
    setattr(pneumatics, attribute, np.inf * np.ones_like(pneumatics.bend[0]))
    with pytest.raises(
        DivergedError,
        match=f"^pneumatics 'lag' diverged at t = 0.3 s: the {name} is inf, a value",
    ):
        pneumatics.advance(vent, np.zeros(0))


@pytest.mark.parametrize("kind", ["lag", "orifice"])
def test_a_refused_state_changes_nothing(kind):
    traces = []
    for refused in (False, True):
        spec = actuated(2)
        chambers = make_pneumatics(kind, spec, supply_pa=SUPPLY, layout="in_out")
        chambers.set_state(np.full((2, 2), 20e3), np.array([0.2, -0.1]))
        if refused:
            with pytest.raises(InputError, match="chamber pressure"):
                chambers.set_state(np.full((2, 2), 9e9), np.array([0.4, 0.3]))
        times = np.linspace(0.0, 0.1, 5)
        traces.append(chambers.advance(chambers.schedule(HELD, 0.1), times))
    assert np.array_equal(traces[1].bend, traces[0].bend)
    assert np.array_equal(traces[1].pressure, traces[0].pressure)


def test_schedule_merges_equal_slots_and_can_be_sliced_and_joined():
    slots = np.array([1, 1, -1, -1, -1, 1], dtype=np.int8)[:, None, None] * np.ones(
        (1, 2, 2), dtype=np.int8
    )
    whole = Schedule.from_slots(slots, 0.6)
    assert whole.starts == pytest.approx(
        [0.0, 0.2, 0.5]
    ) and whole.events == pytest.approx([0.2, 0.5])
    assert whole.states[:, 0, 0].tolist() == [1, -1, 1]
    middle = whole.slice(0.2, 0.55)
    assert middle.starts == pytest.approx([0.0, 0.3]) and middle.span == pytest.approx(
        0.35
    )
    again = whole.slice(0.0, 0.3).followed_by(whole.slice(0.3, 0.6))
    assert (
        again.starts == pytest.approx(whole.starts)
        and (again.states == whole.states).all()
    )


def test_layouts_reject_impossible_states():
    holding = LagPneumatics(actuated(), supply_pa=1.0, layout="in_out").schedule(
        np.zeros((2, 2)), 0.1
    )
    assert holding.states.shape == (1, 2, 2)
    with pytest.raises(
        InputError, match=r"valve layout '5/2' is unknown; allowed: 3/2, in_out"
    ):
        LagPneumatics(actuated(), supply_pa=1.0, layout="5/2")
    pneumatics = LagPneumatics(actuated(), supply_pa=1.0)
    with pytest.raises(
        InputError,
        match=r"valve state 0 is not supported by layout 3/2; use one of \(-1, 1\)",
    ):
        pneumatics.schedule(np.zeros((2, 2), dtype=np.int8), 0.1)
    with pytest.raises(
        InputError, match=r"valve state 2 is not supported by layout 3/2"
    ):
        pneumatics.schedule(np.array([[1, -1], [2, 1]]), 0.1)
    with pytest.raises(InputError, match="valve state nan is not supported"):
        pneumatics.schedule(np.array([[1, -1], [np.nan, 1]]), 0.1)
    wrong = (
        r"valves have the shape \(3, 2\), which is not allowed; it must be \(2,"
        r" 2\) or \(slots, 2, 2\)"
    )
    with pytest.raises(InputError, match=wrong):
        pneumatics.schedule(np.ones((3, 2)), 0.1)
