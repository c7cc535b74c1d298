"""Orifice chambers compared with the standard's formulas, another integrator, and conservation laws."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.integrate import solve_ivp
from snakes import robot

from srs_twin import AnalyticalSnake, InputError, RobotSpec, TwinSnake, rollout
from srs_twin.control.gait import Gait
from srs_twin.errors import UnknownNameError
from srs_twin.plants import analytical
from srs_twin.pneumatics import (
    LagPneumatics,
    OrificePneumatics,
    Schedule,
    make_pneumatics,
)
from srs_twin.pneumatics.flow import flow

AMBIENT = 101_325.0
SUPPLY = 48_300.0
L_PER_MIN = 1 / 60_000
COMPRESSOR = 2 * L_PER_MIN  # generation 3's, Section 2.3.2
FILL, VENT, HOLD = (np.tile([state, -1], (4, 1)) for state in (1, -1, 0))


def iso_6358(upstream: float, downstream: float, b: float) -> float:
    """Return P₁ ψ from the standard, linear above a ratio of 0.999; negative for backward flow."""
    if downstream > upstream:
        return -iso_6358(downstream, upstream, b)
    ratio = downstream / upstream
    if ratio <= b:
        return upstream
    if ratio > 0.999:
        return (
            1000
            * (upstream - downstream)
            * float(np.sqrt(1 - ((0.999 - b) / (1 - b)) ** 2))
        )
    return upstream * float(np.sqrt(1 - ((ratio - b) / (1 - b)) ** 2))


def volumes(spec: RobotSpec, bend: np.ndarray) -> np.ndarray:
    """Return the volumes of the chambers, shape (..., segments, 2), m³."""
    grown = np.maximum(0.0, np.stack([bend, -bend], axis=-1))
    return spec.chamber.dead_volume + spec.chamber.displacement * grown


def amounts(spec: RobotSpec, pressure: np.ndarray, bend: np.ndarray) -> float:
    """Return P V of all chambers, J."""
    return float(((pressure + AMBIENT) * volumes(spec, bend)).sum())


# The flow


@settings(max_examples=200)
@given(st.floats(5e4, 5e5), st.floats(5e4, 5e5), st.sampled_from([0.0, 0.3, 0.528]))
def test_flow_follows_iso_6358_with_correct_derivatives(first, second, b):
    value, by_first, by_second = flow(first, second, b)
    assert value == pytest.approx(iso_6358(first, second, b), rel=1e-9, abs=1e-6)
    step = 1e-3
    ratio = min(first, second) / max(first, second)
    if min(abs(ratio - kink) for kink in (b, 0.999, 1.0)) > 1e-6:
        derivatives = (
            (iso_6358(first + step, second, b) - iso_6358(first - step, second, b))
            / (2 * step),
            (iso_6358(first, second + step, b) - iso_6358(first, second - step, b))
            / (2 * step),
        )
        assert (by_first, by_second) == pytest.approx(derivatives, rel=2e-4, abs=1e-6)


def test_flow_is_continuous_at_the_sonic_and_laminar_limits():
    for ratio in (0.3, 0.999):
        below, above = (flow(2e5, 2e5 * (ratio + d), 0.3)[0] for d in (-1e-9, 1e-9))
        assert below == pytest.approx(above, abs=1.0)
    assert flow(2e5, 0.29 * 2e5, 0.3)[0] == flow(2e5, 0.01 * 2e5, 0.3)[0] == 2e5


# Small signals


@pytest.mark.default_cases(at=[0, 3, 6])
@pytest.mark.parametrize("name", ["gen1", "gen2", "gen3", "gen4"])
@pytest.mark.parametrize("critical", [0.2, 0.5])
def test_small_pressure_steps_decay_with_the_fitted_time_constants(name, critical):
    """Two modules with slightly different pressures pass the working point, e⁻² before the end."""
    spec = robot(name)
    spec = replace(
        spec, actuator=replace(spec.actuator, tau_vent=1.4 * spec.actuator.tau_fill)
    )
    supply = spec.supply.nominal
    for direction, tau in ((1, spec.actuator.tau_fill), (-1, spec.actuator.tau_vent)):
        filling = np.tile([1, -1], (4, 1))
        emptying = np.tile([-1, -1], (4, 1))
        first, then = (emptying, filling) if direction == 1 else (filling, emptying)
        times = np.linspace(0.0, 3 * tau, 3001)
        curves = []
        for wait in (10 * tau, 10.002 * tau):
            chambers = OrificePneumatics(
                spec,
                supply_pa=supply,
                layout="in_out",
                critical_ratio=critical,
                substep=tau / 500,
            )
            chambers.advance(chambers.schedule(first, 20 * tau - wait), np.zeros(0))
            order = Schedule(
                13.1 * tau,
                np.array([0.0, wait - 10 * tau + 1e-3 * tau]),
                np.stack([first, then]),
            )
            curves.append(chambers.advance(order, times).pressure[:, 0, 0])
        gap = np.abs(curves[0] - curves[1])
        level = np.exp(-2) * supply if direction == -1 else (1 - np.exp(-2)) * supply
        near = np.abs(times - times[np.argmin(np.abs(curves[0] - level))]) < 0.03 * tau
        assert gap[near].max() < 0.005 * supply, "a small step"
        derivative = np.polyfit(times[near], np.log(gap[near]), 1)[0]
        assert -1 / derivative == pytest.approx(tau, rel=0.01)


@pytest.mark.parametrize("name", ["gen1", "gen2", "gen4"])
def test_large_pressure_steps_take_as_long_as_with_lag(name):
    """Time to 63 % of a step: a square-root law cannot match both the start and the end."""
    spec = robot(name)
    chambers = OrificePneumatics(spec, supply_pa=spec.supply.nominal)
    times = np.linspace(0, 12 * spec.actuator.tau_fill, 4001)
    up = chambers.advance(chambers.schedule(FILL, times[-1]), times).pressure[:, 0, 0]
    down = chambers.advance(chambers.schedule(VENT, times[-1]), times).pressure[:, 0, 0]
    assert (
        0.9
        < times[np.argmax(up > (1 - np.exp(-1)) * up[-1])] / spec.actuator.tau_fill
        < 1.0
    )
    assert (
        1.1
        < times[np.argmax(down < np.exp(-1) * down[0])] / spec.actuator.tau_vent
        < 1.25
    )
    assert (
        up[-1] == pytest.approx(spec.supply.nominal, rel=1e-6) and abs(down[-1]) < 1.0
    )


# The integration

CASES = {
    "supply without limit": {},
    "leak": {"leak_per_s": 0.5},
    "compressor": {"flow_limit": COMPRESSOR},
    "large compressor, hardly a line": {
        "flow_limit": 10 * COMPRESSOR,
        "line_volume": 5e-6,
    },
}


def reference(
    chambers: OrificePneumatics, spec: RobotSpec, order: Schedule, times: np.ndarray
) -> np.ndarray:
    """Return pressures, bends, line amount, drawn and lost amounts by LSODA, shape (times, 15)."""
    n = spec.segments
    actuator = spec.actuator
    air = chambers.parameters
    fill, vent = (1e5 * c for c in chambers.conductances)

    def look(y):
        return (
            y[: 2 * n].reshape(n, 2) / volumes(spec, y[2 * n : 3 * n]),
            y[2 * n : 3 * n],
        )

    def rates(_, y, state):
        pressure, bend = look(y)
        line = y[3 * n] / air.line_volume if air.limited else SUPPLY + AMBIENT
        into = np.zeros((n, 2))
        out = air.leak * (pressure - AMBIENT)
        for at in np.ndindex(n, 2):
            if state[at] == 1:
                into[at] = fill[at] * iso_6358(line, pressure[at], air.critical)
            elif state[at] == -1:
                out[at] += vent[at] * iso_6358(pressure[at], AMBIENT, air.critical)
        turning = (
            actuator.gain * (pressure[:, 0] - pressure[:, 1]) - bend
        ) / actuator.tau_mode
        supplied = into.sum()
        if air.limited:
            supplied = air.max_flow * np.clip(
                (SUPPLY + AMBIENT - line) / (0.01 * SUPPLY), 0, 1
            )
        return np.concatenate(
            [
                (into - out).ravel(),
                turning,
                [supplied - into.sum(), supplied, out.sum()],
            ]
        )

    y = np.concatenate(
        [
            np.full(2 * n, AMBIENT * air.dead),
            np.zeros(n),
            [(SUPPLY + AMBIENT) * air.line_volume, 0, 0],
        ]
    )
    rows = []
    for k, state in enumerate(order.states):
        ends = order.starts[k], np.append(order.starts, order.span)[k + 1]
        solution = solve_ivp(
            rates,
            ends,
            y,
            args=(state,),
            method="LSODA",
            rtol=1e-8,
            atol=1e-10,
            max_step=0.002,
            dense_output=True,
        )
        for t in times[(times > ends[0]) & (times <= ends[1])]:
            at = solution.sol(t)
            pressure, bend = look(at)
            rows.append(np.concatenate([pressure.ravel() - AMBIENT, bend, at[3 * n :]]))
        y = solution.y[:, -1]
    return np.array(rows)


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_integration_converges_to_an_independent_integrator(case):
    spec = robot()
    times = np.linspace(0.005, 0.3, 60)
    errors = []
    for substep in (5e-4, 1.25e-4):
        chambers = OrificePneumatics(
            spec, supply_pa=SUPPLY, layout="in_out", substep=substep, **CASES[case]
        )
        states = np.random.default_rng(3).choice([-1, 0, 1, 1], size=(5, 4, 2))
        order = chambers.schedule(states, 0.3)
        expected = reference(chambers, spec, order, times)
        trace = chambers.advance(order, times)
        errors.append(
            np.abs(trace.pressure.reshape(len(times), -1) - expected[:, :8]).max()
            / SUPPLY
        )
        assert np.abs(trace.bend - expected[:, 8:12]).max() < 1e-3
        drawn = trace.pneumatic_energy * (SUPPLY + AMBIENT) / SUPPLY
        assert drawn == pytest.approx(expected[:, 13], abs=3e-4 * expected[-1, 13])
        assert chambers.lost == pytest.approx(expected[-1, 14], rel=1e-3)
    assert errors[0] < 1e-3 and errors[1] < 0.5 * errors[0]


def test_integration_has_second_order():
    spec = robot("gen4")
    at = np.linspace(0.02, 0.3, 15)
    results = []
    for substep in (1e-3, 5e-4, 2.5e-4, 2e-5):
        chambers = OrificePneumatics(
            spec, supply_pa=SUPPLY, leak_per_s=0.5, substep=substep
        )
        results.append(
            chambers.advance(
                chambers.schedule(np.stack([FILL, VENT]), 0.3), at
            ).pressure
        )
    coarse, middle, fine = (np.abs(item - results[-1]).max() for item in results[:-1])
    assert np.log2(coarse / middle) == pytest.approx(2, abs=0.2)
    assert np.log2(middle / fine) == pytest.approx(2, abs=0.2)


def test_trace_rates_match_finite_differences():
    chambers = OrificePneumatics(robot(), supply_pa=SUPPLY, substep=5e-5)
    chambers.advance(chambers.schedule(FILL, 0.0502), np.zeros(0))
    step = 2e-5
    trace = chambers.advance(
        chambers.schedule(FILL[:, ::-1], 0.02), np.arange(1, 1000) * step
    )
    for value, rate, size in (
        (trace.bend, trace.bend_rate, 50.0),
        (trace.bend_rate, trace.bend_acceleration, 2e4),
    ):
        by_differences = (value[2:] - value[:-2]) / (2 * step)
        error = np.abs(by_differences - rate[1:-1])
        assert np.quantile(error, 0.95) < 0.01 * size


@settings(max_examples=15, deadline=None)
@given(
    st.lists(st.sampled_from([-1, 0, 1]), min_size=48, max_size=48),
    st.sampled_from([None, COMPRESSOR]),
)
def test_air_is_conserved(states, limit):
    spec = robot()
    chambers = OrificePneumatics(
        spec,
        supply_pa=SUPPLY,
        layout="in_out",
        flow_limit=limit,
        leak_per_s=0.3,
        line_volume=3e-5,
    )
    before = amounts(spec, chambers.pressure, chambers.bend) + 3e-5 * (
        chambers.line_pressure + AMBIENT
    )
    for valves in np.array(states).reshape(6, 4, 2):
        trace = chambers.advance(
            chambers.schedule(valves, 0.03), np.linspace(0, 0.03, 7)
        )
        assert (
            np.isfinite(trace.bend_acceleration).all()
            and trace.pressure.min() > -0.5 * AMBIENT
        )
    inside = amounts(spec, chambers.pressure, chambers.bend) + 3e-5 * (
        chambers.line_pressure + AMBIENT
    )
    # A line without limit is the supply itself.
    assert inside + chambers.lost - chambers.drawn == pytest.approx(before, rel=1e-10)
    assert chambers.pneumatic_energy == pytest.approx(
        chambers.drawn * SUPPLY / (SUPPLY + AMBIENT)
    )


def test_result_is_independent_of_the_division_of_a_schedule():
    spec = robot()
    one, many = (
        OrificePneumatics(spec, supply_pa=SUPPLY, substep=1e-4) for _ in range(2)
    )
    states = np.random.default_rng(4).choice([-1, 1], size=(10, 4, 2))
    whole = one.advance(one.schedule(states, 0.2), np.linspace(0.02, 0.2, 10))
    for k, valves in enumerate(states):
        for _ in range(20):
            part = many.advance(many.schedule(valves, 0.001), np.array([0.001]))
        assert part.pressure[0] == pytest.approx(whole.pressure[k], abs=1e-4 * SUPPLY)
        assert part.pneumatic_energy[0] == pytest.approx(
            whole.pneumatic_energy[k], rel=1e-4
        )


# Coupling with actual bends


def test_closed_chamber_is_compressed_by_the_actual_bend():
    """Boyle's law: P V is constant within a schedule and from one schedule to the next."""
    spec = robot()
    chambers = OrificePneumatics(spec, supply_pa=SUPPLY, layout="in_out")
    assert chambers.depends_on_bend and not LagPneumatics.depends_on_bend
    bend = np.full(4, 1.2)
    rate = np.full(4, -2.0)
    chambers.advance(chambers.schedule(FILL, 0.5), np.zeros(0), bend=bend)
    times = np.linspace(0, 0.1, 6)
    order = chambers.schedule(HOLD * [1, 0], 0.1)
    trace = chambers.advance(order, times, bend=bend, bend_rate=rate)
    space = volumes(spec, bend + np.outer(times, rate))[..., 0]
    kept = (trace.pressure[..., 0] + AMBIENT) * space
    assert kept == pytest.approx(np.full_like(kept, kept[0, 0]), rel=1e-9)
    assert chambers.pressure[:, 0] == pytest.approx(trace.pressure[-1, :, 0], rel=1e-9)
    assert (kept[0, 0] - AMBIENT * space[0, 0]) / space[0, 0] == pytest.approx(
        SUPPLY, rel=1e-6
    )
    after = chambers.advance(order, np.zeros(1), bend=np.full(4, 0.7)).pressure[0, :, 0]
    assert (after + AMBIENT) * volumes(spec, np.full(4, 0.7))[:, 0] == pytest.approx(
        kept[0], rel=1e-9
    )


def test_passing_the_free_bends_changes_nothing():
    free, reported = (OrificePneumatics(robot(), supply_pa=SUPPLY) for _ in range(2))
    expected = []
    got = []
    rate = np.zeros(4)
    for valves in np.random.default_rng(5).choice([-1, 1], size=(6, 4, 2)):
        for _ in range(500):
            order = free.schedule(valves, 1e-4)
            end = np.array([1e-4])
            got.append(
                reported.advance(order, end, bend=free.bend, bend_rate=rate).pressure[0]
            )
            trace = free.advance(order, end)
            expected.append(trace.pressure[0])
            rate = trace.bend_rate[0]
    assert np.abs(np.subtract(got, expected)).max() < 0.01 * SUPPLY


# The supply


def speed_and_amplitude(
    spec: RobotSpec, chambers: OrificePneumatics
) -> tuple[float, float]:
    """Return the speed (m/s) and the largest bend (rad) of a gait at 0.9 Hz after 6 s."""
    plant = AnalyticalSnake(spec, supply_pa=SUPPLY, pneumatics=chambers)
    run = rollout(plant, Gait(0.9), 10.0)
    late = run.time >= 6 - 1e-9
    path = run.com[late]
    speed = float(np.hypot(*(path[-1] - path[0]))) / 4
    return speed, float(np.abs(run["bend_2"][late]).max())


def test_generation_3_is_limited_by_two_litres_per_minute():
    """Fills of 45 ml per chamber need ten times the flow (docs/pneumatics.md); no limit is the default."""
    spec = robot("gen3")
    free = OrificePneumatics(spec, supply_pa=SUPPLY)
    low_supply_pressure = OrificePneumatics(
        spec, supply_pa=SUPPLY, flow_limit=COMPRESSOR
    )
    speed, amplitude = speed_and_amplitude(spec, free)
    slow, small = speed_and_amplitude(spec, low_supply_pressure)
    assert speed > 0.04 and amplitude > 1.5
    assert slow < 0.01 * speed and small < 0.15 * amplitude
    assert free.drawn / AMBIENT / 10 > 10 * COMPRESSOR
    assert low_supply_pressure.drawn / AMBIENT / 10 == pytest.approx(
        COMPRESSOR, rel=1e-3
    )


def test_flow_limit_slows_all_segments():
    chambers = OrificePneumatics(robot("gen3"), supply_pa=SUPPLY, flow_limit=COMPRESSOR)
    one = np.full((4, 2), -1)
    one[0, 0] = 1
    alone = chambers.advance(chambers.schedule(one, 0.5), np.array([0.5])).pressure[
        0, 0, 0
    ]
    chambers.reset()
    together = chambers.advance(chambers.schedule(FILL, 0.5), np.array([0.5])).pressure[
        0, :, 0
    ]
    assert together == pytest.approx(np.full(4, together[0]), rel=1e-12)
    assert together[0] < 0.5 * alone
    assert chambers.line_pressure == pytest.approx(together[0], rel=0.05)


def test_a_regulator_keeps_the_line_within_a_hundredth():
    chambers = OrificePneumatics(robot(), supply_pa=SUPPLY, flow_limit=1000 * L_PER_MIN)
    chambers.advance(chambers.schedule(np.stack([FILL, VENT]), 2.0), np.zeros(0))
    assert 0.99 * SUPPLY < chambers.line_pressure <= SUPPLY * (1 + 1e-9)


@pytest.mark.parametrize("limit", [None, COMPRESSOR])
def test_changed_supply_pressure_equals_construction_with_it(limit):
    lower = 0.6 * SUPPLY
    more = {"flow_limit": limit, "initial_line_pressure": lower, "leak_per_s": 0.2}
    regulated, made = (
        OrificePneumatics(robot(), supply_pa=entry, **more) for entry in (SUPPLY, lower)
    )
    regulated.set_supply_pressure(lower)
    traces = [
        entry.advance(entry.schedule(FILL, 0.3), np.linspace(0, 0.3, 7))
        for entry in (regulated, made)
    ]
    assert traces[0].pressure == pytest.approx(traces[1].pressure, abs=1e-6 * lower)
    assert traces[0].pneumatic_energy[-1] > 0 and traces[
        0
    ].pneumatic_energy == pytest.approx(traces[1].pneumatic_energy, rel=1e-9)
    assert (regulated.pneumatic_energy, regulated.line_pressure) == pytest.approx(
        (made.pneumatic_energy, made.line_pressure)
    )


def test_place_sets_pressures_and_bends():
    chambers = OrificePneumatics(robot(), supply_pa=SUPPLY)
    random = np.random.default_rng(2)
    pressure = random.uniform(0, SUPPLY, (4, 2))
    bend = np.array([1.1, -0.8, 0.3, -0.1])
    chambers.set_state(pressure, bend)
    now = chambers.current_trace()
    assert now.pressure[0] == pytest.approx(pressure) and now.bend[0] == pytest.approx(
        bend
    )


def test_settings_are_recorded_in_their_units():
    options = {
        "flow_limit": 2 / 60_000,
        "line_volume": 30e-6,
        "initial_line_pressure": 12e3,
        "leak_per_s": 0.3,
    }
    chambers = OrificePneumatics(robot(), supply_pa=SUPPLY, **options)
    settings = chambers.describe()
    assert settings["flow_limit_l_per_min"] == pytest.approx(2.0)
    assert settings["line_volume_ml"] == pytest.approx(30.0)
    assert settings["initial_line_pressure_kpa"] == pytest.approx(12.0)
    assert settings["leak_per_s"] == 0.3
    for name, conductance in zip(("fill", "vent"), chambers.conductances, strict=True):
        recorded = settings[f"conductance_{name}_m3_per_s_pa"]
        assert conductance == pytest.approx(np.full((4, 2), recorded))
    default = limited(2.0).describe()
    assert default["critical_ratio"] == 0.3
    assert default["line_volume_ml"] == pytest.approx(50.0)
    assert default["initial_line_pressure_kpa"] == pytest.approx(SUPPLY / 1e3)


# Invalid settings


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            {"critical_ratio": 0.9},
            "`critical_ratio` 0.9 is not allowed; it must be between 0 and 0.8",
        ),
        (
            {"flow_limit": 0.0},
            "flow_limit 0.0 is not allowed; it must be finite and above 0",
        ),
        (
            {"line_volume": -1.0},
            "line_volume -1.0 is not allowed; it must be finite and above 0",
        ),
        (
            {"substep": float("nan")},
            "substep nan is not allowed; it must be finite and above 0",
        ),
        (
            {"leak_per_s": -0.1},
            "`leak_per_s` -0.1 is not allowed; it must be finite and at least 0",
        ),
        (
            {"valve_delay_s": -0.1},
            "`valve_delay_s` -0.1 is not allowed; it must be finite and at least 0",
        ),
    ],
)
def test_numbers_out_of_range_raise(arguments, words):
    with pytest.raises(InputError, match=words):
        OrificePneumatics(robot(), supply_pa=SUPPLY, **arguments)


def test_pneumatics_are_selected_by_name():
    made = make_pneumatics(
        "orifice", robot(), supply_pa=SUPPLY, layout="3/2", critical_ratio=0.4
    )
    assert (
        isinstance(made, OrificePneumatics) and made.describe()["critical_ratio"] == 0.4
    )
    assert make_pneumatics(made, robot(), supply_pa=1.0, layout="3/2") is made
    with pytest.raises(
        UnknownNameError, match=r"unknown pneumatics 'orifise'; did you mean orifice\?"
    ):
        make_pneumatics("orifise", robot(), supply_pa=SUPPLY, layout="3/2")


def limited(l_per_min: float, **options: float) -> OrificePneumatics:
    flow = l_per_min / 60_000
    return OrificePneumatics(robot(), supply_pa=SUPPLY, flow_limit=flow, **options)


@pytest.mark.parametrize(
    ("l_per_min", "inertia"),
    [
        (2.0, "connector"),
        pytest.param(2.0, "point", marks=pytest.mark.slow),
        pytest.param(20.0, "connector", marks=pytest.mark.slow),
    ],
)
def test_coupling_step_is_small_enough_with_a_flow_limit(
    l_per_min, inertia, monkeypatch
):
    """Regression: at 1 ms chambers and bodies oscillated, up to 180 kPa from a supply of 48 kPa."""
    options = {
        "model": "compliant",
        "friction": "wheel",
        "inertia": inertia,
        "supply_pa": SUPPLY,
    }

    def run(finer: float) -> tuple[np.ndarray, np.ndarray]:
        chambers = limited(l_per_min)
        chambers.coupling_step_s /= finer
        monkeypatch.setattr(analytical, "_POINT_MASS_COUPLING_STEP", 1e-4 / finer)
        result = rollout(
            AnalyticalSnake(robot(), pneumatics=chambers, **options),
            Gait(2.0, 0.4),
            0.4,
        )
        pressure = np.concatenate(
            [result.stack("pressure_plus"), result.stack("pressure_minus")]
        )
        return pressure, result.stack("bend")

    (pressure, bend), (fine_pressure, fine_bend) = run(1.0), run(2.0)
    # A closed chamber that a swinging connector stretches falls below the ambient
    # pressure, by 70 Pa here.
    assert pressure.min() > -0.005 * SUPPLY and pressure.max() < SUPPLY
    assert pressure == pytest.approx(fine_pressure, abs=0.01 * fine_pressure.max())
    assert bend == pytest.approx(fine_bend, abs=0.005)


def test_twin_time_step_above_the_coupling_step_raises():
    with pytest.raises(
        InputError,
        match="time step 0.001 s is too long .*; it must be 0.00025 s or less",
    ):
        TwinSnake(robot(), pneumatics=limited(2.0))
    TwinSnake(robot(), pneumatics=limited(2.0), timestep=0.00025).step(
        np.full((4, 2), -1)
    )


@pytest.mark.slow
@pytest.mark.parametrize("flow_limit", [None, 2e-4])
def test_closed_chambers_are_stable_under_loaded_contact(flow_limit):
    """Regression: connectors between closed chambers reached several m/s with steps of 1 ms."""

    def crawled(**options: Any) -> tuple[float, float]:
        chambers = OrificePneumatics(robot(), supply_pa=SUPPLY, flow_limit=flow_limit)
        step = {"timestep": min(0.001, chambers.coupling_step_s)} | options
        actual = rollout(
            TwinSnake(robot(), supply_pa=SUPPLY, pneumatics=chambers, **step),
            Gait(2.0, offset=0.4),
            2.0,
        )
        return math.hypot(*(actual.com[-1] - actual.com[0])), actual["heading"][-1]

    preloaded = crawled(contact="preloaded")
    loaded = crawled(contact="loaded")
    assert loaded == pytest.approx(preloaded, rel=0.1)
    assert crawled(contact="loaded", timestep=0.00025) == pytest.approx(
        loaded, rel=0.03
    )
