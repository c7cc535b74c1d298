"""Unequal modules: law of the chambers, both plants, random modules, files, drifted and dead sensors."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.integrate import solve_ivp
from scipy.stats import kstest, norm
from snakes import robot

from srs_twin import (
    AnalyticalSnake,
    InputError,
    PreloadedContact,
    RobotSpec,
    TwinSnake,
    load_robot,
    load_scenario,
    rollout,
)
from srs_twin.control.gait import Gait
from srs_twin.control.replay import HoldValves
from srs_twin.plants.twin.mjcf.model import robot_mjcf
from srs_twin.plants.twin.mjcf.numerics import ModelSettings
from srs_twin.pneumatics import LagPneumatics, OrificePneumatics, make_pneumatics
from srs_twin.pneumatics.chambers import (
    BendLaw,
    air_bend,
    apply_bend_law,
    equivalent_linear_pressure,
    largest_bend,
)
from srs_twin.pneumatics.valves import StuckValve
from srs_twin.robot.file import load_robot_file
from srs_twin.robot.sections import ModulesFile
from srs_twin.robot.spec import Modules
from srs_twin.sensing import make_sensor

SUPPLY = 131e3
PLANTS = {"analytical": AnalyticalSnake, "twin": TwinSnake}
both = pytest.mark.parametrize("kind", PLANTS)


def unlike(
    seed: int = 1,
    *,
    limit: float = 1.4,
    bias: float = 0.1,
    sensors: float = 0.0,
    **dead_zone: float,
) -> RobotSpec:
    """Return a generation 4 with unequal modules and a bend limit (rad)."""
    rng = np.random.default_rng(seed)
    spec = load_robot("gen4")
    modules = Modules.from_arrays(
        gain=rng.uniform(0.7, 1.3, (4, 2)),
        tau_fill=rng.uniform(0.7, 1.3, (4, 2)),
        tau_vent=rng.uniform(0.7, 1.3, (4, 2)),
        bias=rng.uniform(-bias, bias, 4),
        sensor_gain=1 + rng.uniform(-sensors, sensors, 4),
        sensor_bias=rng.uniform(-sensors, sensors, 4),
    )
    return replace(
        spec,
        actuator=replace(spec.actuator, bend_limit=limit, **dead_zone),
        variation=modules,
    )


def mirrored(spec: RobotSpec) -> RobotSpec:
    """Return the mirror image of a robot, with exchanged + and − chambers."""
    modules = spec.modules
    turned = {
        name: modules.array(name)[:, ::-1] for name in ("gain", "tau_fill", "tau_vent")
    }
    other = {
        "bias": -modules.array("bias"),
        "sensor_bias": -modules.array("sensor_bias"),
    }
    variation = Modules.from_arrays(
        **turned, **other, sensor_gain=modules.array("sensor_gain")
    )
    return replace(spec, variation=variation)


# The law


@settings(max_examples=20)
@given(
    st.floats(-3, 3),
    st.floats(0.5, 3) | st.just(np.inf),
    st.floats(0, 1),
    st.floats(0.05, 1.5),
    st.floats(0.05, 1.5),
)
def test_bend_law_with_dead_zone_is_odd_smooth_and_monotone(
    x, limit, fraction, dead_zone, width
):
    bend_law = BendLaw(limit, fraction, dead_zone, width)
    step = 1e-5
    value, derivative, curve = apply_bend_law(x, bend_law)
    y = x - fraction * width / 2 * np.log(
        np.cosh((x + dead_zone) / width) / np.cosh((x - dead_zone) / width)
    )
    assert value == pytest.approx(
        y if np.isinf(limit) else y / (1 + (y / limit) ** 4) ** 0.25, abs=1e-12
    )
    assert (value, derivative) == (
        -apply_bend_law(-x, bend_law)[0],
        apply_bend_law(-x, bend_law)[1],
    ) and derivative >= 0
    assert apply_bend_law(0.0, bend_law)[1] == pytest.approx(
        1 - fraction * np.tanh(dead_zone / width)
    )
    spec = unlike(
        limit=limit,
        onset_fraction=fraction,
        dead_zone=dead_zone,
        dead_zone_transition=width,
    )
    pressure = np.zeros((4, 2))
    pressure[:, 0] = x / (spec.actuator.gain * spec.modules.array("gain")[:, 0])
    assert air_bend(spec, pressure) == pytest.approx(np.full(4, value), abs=1e-12)
    assert equivalent_linear_pressure(spec, np.zeros((4, 2))) == pytest.approx(
        np.zeros((4, 2))
    )
    ahead = apply_bend_law(x + step, bend_law)
    behind = apply_bend_law(x - step, bend_law)
    assert derivative == pytest.approx((ahead[0] - behind[0]) / (2 * step), abs=1e-6)
    assert curve == pytest.approx((ahead[1] - behind[1]) / (2 * step), abs=1e-4)
    assert apply_bend_law(x, BendLaw(np.inf, 0.0, 1.0, 1.0)) == (x, 1.0, 0.0)


def test_equivalent_linear_pressure_gives_the_same_bend():
    spec = unlike()
    pressure = np.random.default_rng(5).uniform(0, SUPPLY, (7, 4, 2))
    linear = replace(spec, actuator=replace(spec.actuator, bend_limit=np.inf))
    assert air_bend(
        linear, equivalent_linear_pressure(spec, pressure)
    ) == pytest.approx(air_bend(spec, pressure), rel=1e-12)
    assert equivalent_linear_pressure(linear, pressure) is pressure
    full = np.array([SUPPLY, 0.0])
    nominal = replace(spec, variation=None)
    assert largest_bend(nominal, SUPPLY) == pytest.approx(
        air_bend(nominal, np.tile(full, (4, 1)))[0]
    )


def segment_equations(spec: RobotSpec, leak: float):
    """Return y' of (p⁺, p⁻, x) of segment 2 from the dissertation, and its bend, for one valve state."""
    modules = spec.modules
    actuator = spec.actuator
    g = actuator.gain * modules.array("gain")[1]
    fill = actuator.tau_fill * modules.array("tau_fill")[1]
    vent = actuator.tau_vent * modules.array("tau_vent")[1]

    def rates(_, y, state):
        p = y[:2]
        flow = np.where(
            state == 1, (SUPPLY - p) / fill, np.where(state == -1, -p / vent, 0.0)
        )
        return [
            *(flow - leak * p),
            (g[0] * p[0] - g[1] * p[1] - y[2]) / actuator.tau_mode,
        ]

    def bend(x):
        m = actuator.bend_limit
        return modules.bias[1] + x / (1 + (x / m) ** 4) ** 0.25

    return rates, bend


@pytest.mark.parametrize("leak", [0.0, 0.7])
def test_lag_solves_the_equations_of_unequal_modules(leak):
    spec = unlike()
    chambers = LagPneumatics(spec, supply_pa=SUPPLY, layout="in_out", leak_per_s=leak)
    assert chambers.bend == pytest.approx(spec.modules.bias, abs=0)
    rates, bend = segment_equations(spec, leak)
    y = np.zeros(3)
    at = np.linspace(0.002, 0.05, 25)
    for states in np.random.default_rng(2).choice([-1, 0, 1], size=(12, 4, 2)):
        trace = chambers.advance(chambers.schedule(states, 0.05), at)
        solution = solve_ivp(
            rates,
            (0, 0.05),
            y,
            args=(states[1],),
            rtol=1e-10,
            atol=1e-10,
            method="LSODA",
            dense_output=True,
        )
        y = solution.y[:, -1]
        expected = solution.sol(at)
        assert pytest.approx(expected[:2], abs=1e-5 * SUPPLY) == trace.pressure[:, 1].T
        assert trace.bend[:, 1] == pytest.approx(bend(expected[2]), abs=1e-6)
        step = 1e-6
        ahead, behind = (
            bend(solution.sol(np.clip(at + d, 0, 0.05))[2]) for d in (step, -step)
        )
        inner = slice(0, -1)
        assert trace.bend_rate[inner, 1] == pytest.approx(
            ((ahead - behind) / (2 * step))[inner], abs=2e-3
        )
    assert chambers.bend[1] == pytest.approx(bend(y[2]), abs=1e-6)


@pytest.mark.parametrize(
    "kind", ["lag", pytest.param("orifice", marks=pytest.mark.slow)]
)
def test_bend_accelerations_are_derivatives_of_the_rates(kind):
    finer = {"substep": 5e-5} if kind == "orifice" else {}
    chambers = make_pneumatics(kind, unlike(), supply_pa=SUPPLY, layout="3/2", **finer)
    fill = np.tile([1, -1], (4, 1))
    chambers.advance(chambers.schedule(fill, 0.05), np.zeros(0))
    step = 1e-5
    trace = chambers.advance(chambers.schedule(-fill, 0.04), np.arange(1, 4000) * step)
    for value, rate, size in (
        (trace.bend, trace.bend_rate, 30.0),
        (trace.bend_rate, trace.bend_acceleration, 8e3),
    ):
        derivative = (value[2:] - value[:-2]) / (2 * step)
        # A chamber begins to grow where its segment comes through straight: a kink,
        # once a segment.
        assert np.quantile(np.abs(derivative - rate[1:-1])[50:], 0.995) < 0.01 * size


@pytest.mark.slow
def test_unequal_orifice_chambers_conserve_air_and_reach_the_static_bend():
    spec = unlike()
    chambers = OrificePneumatics(spec, supply_pa=SUPPLY)
    assert not np.abs(chambers.pressure).any()
    air = chambers.parameters.dead
    displacement = spec.chamber.displacement

    def content() -> float:
        sizes = air + displacement * np.maximum(
            0, np.stack([chambers.bend, -chambers.bend], axis=1)
        )
        return float(((chambers.pressure + 101_325) * sizes).sum())

    # The first amounts are those of bodies that are not straight.
    before = 101_325 * (8 * air + displacement * np.abs(spec.modules.bias).sum())
    chambers.advance(chambers.schedule(np.tile([1, -1], (4, 1)), 3.0), np.zeros(0))
    assert chambers.drawn - chambers.lost == pytest.approx(
        content() - before, abs=1e-6 * before
    )
    slow = LagPneumatics(spec, supply_pa=SUPPLY)
    slow.advance(slow.schedule(np.tile([1, -1], (4, 1)), 3.0), np.zeros(0))
    assert chambers.bend == pytest.approx(slow.bend, abs=1e-5)


def test_larger_time_constant_means_smaller_conductance():
    spec = load_robot("gen4")
    slow = np.ones((4, 2))
    slow[2, 1] = 2.0
    modules = replace(Modules.nominal(4), tau_fill=tuple(map(tuple, slow.tolist())))
    fill, vent = OrificePneumatics(
        replace(spec, variation=modules), supply_pa=SUPPLY
    ).conductances
    even_fill, even_vent = OrificePneumatics(spec, supply_pa=SUPPLY).conductances
    assert vent == pytest.approx(even_vent, rel=1e-12)
    assert even_fill / fill == pytest.approx(slow, rel=0.02)


def test_initially_empty_line_delays_filling():
    spec = load_robot("gen4")
    options = {"supply_pa": SUPPLY, "flow_limit": 1e-3, "line_volume": 5e-4}
    full = OrificePneumatics(spec, **options)
    empty = OrificePneumatics(spec, **options, initial_line_pressure=0.0)
    for chambers in (full, empty):
        chambers.advance(chambers.schedule(np.tile([1, -1], (4, 1)), 0.1), np.zeros(0))
    assert empty.bend.max() < 0.5 * full.bend.min()
    with pytest.raises(
        InputError, match="`initial_line_pressure` 200000.0 Pa is not allowed"
    ):
        OrificePneumatics(spec, **options, initial_line_pressure=2e5)


# Both plants


@both
def test_snake_at_rest_has_the_rest_bends(kind):
    spec = unlike()
    plant = PLANTS[kind](spec)
    pose = (0.3, -0.2, 0.7)
    state = plant.reset(pose=pose)
    assert state.bend == pytest.approx(spec.modules.bias, abs=1e-8)
    assert (*state.com, state.heading) == pytest.approx(pose, abs=1e-9)
    run = rollout(plant, HoldValves("vent", "vent"), 0.5, pose=pose)
    assert [run[name][-1] for name in ("com_x", "com_y", "heading")] == pytest.approx(
        pose, abs=1e-4
    )
    assert run["bend_2"][-1] == pytest.approx(spec.modules.bias[1], abs=1e-3)


@pytest.mark.default_cases(at=[0, 7, 11, 12])
@both
@pytest.mark.parametrize(
    ("side", "fraction", "supply", "chambers"),
    [
        ("plus", 0.0, 48e3, "lag"),
        ("minus", 0.0, 48e3, "lag"),
        ("minus", 1.0, 10e3, "lag"),
        ("plus", 1.0, 20e3, "lag"),
        ("minus", 0.8, 30e3, "lag"),
        ("plus", 0.8, 40e3, "orifice"),
        ("minus", 1.0, 48e3, "lag"),
    ],
)
def test_static_bend_follows_the_module_gains(kind, side, fraction, supply, chambers):
    """On a bench, where only the air bends the segment; the formula is repeated here."""
    spec = replace(
        load_robot("gen4_module"),
        variation=Modules.from_arrays(
            gain=np.array([[1.2, 0.8]]),
            tau_fill=np.ones((1, 2)),
            tau_vent=np.ones((1, 2)),
            bias=np.array([0.15]),
            sensor_gain=np.array([1.1]),
            sensor_bias=np.array([-0.05]),
        ),
    )
    late = {"onset_fraction": fraction, "dead_zone": 0.3, "dead_zone_transition": 0.2}
    spec = replace(spec, actuator=replace(spec.actuator, bend_limit=1.0, **late))
    plant = PLANTS[kind](
        spec, base="clamped", tick=0.001, supply_pa=supply, pneumatics=chambers
    )
    states = ("fill", "vent") if side == "plus" else ("vent", "fill")
    run = rollout(plant, HoldValves(*states), 2.0)
    x = spec.actuator.gain * supply * (1.2 if side == "plus" else -0.8)
    x -= fraction * 0.1 * np.log(np.cosh((x + 0.3) / 0.2) / np.cosh((x - 0.3) / 0.2))
    expected = 0.15 + x / (1 + x**4) ** 0.25
    assert run["bend_1"][-1] == pytest.approx(expected, abs=1e-4)
    assert run["measured_bend_1"][-1] == pytest.approx(1.1 * expected - 0.05, abs=1e-4)


@both
def test_mirrored_modules_and_gait_give_the_mirrored_path(kind):
    spec = unlike(bias=0.05)
    runs = [
        rollout(PLANTS[kind](item, supply_pa=60e3), Gait(1.0, phase=phase), 2.0)
        for item, phase in ((spec, 0.0), (mirrored(spec), np.pi))
    ]
    tolerance = 1e-6 if kind == "analytical" else 1e-4
    assert runs[0]["heading"] == pytest.approx(-runs[1]["heading"], abs=tolerance)
    assert runs[0]["com_y"] == pytest.approx(-runs[1]["com_y"], abs=tolerance)
    assert abs(runs[0]["heading"][-1]) > 0.1


def test_stiff_light_twin_has_the_free_bends():
    """The twin gets moments, the analytical model bends: both must use the same bend law."""
    spec = unlike()
    stiff = replace(
        spec,
        actuator=replace(
            spec.actuator, onset_fraction=0.5, dead_zone=0.2, dead_zone_transition=0.15
        ),
        bending=replace(spec.bending, stiffness=20.0),
        friction=replace(spec.friction, mu_t=0.01, mu_n=0.05),
    )
    twin, free = (
        rollout(plant(stiff, supply_pa=SUPPLY, **more), Gait(1.0), 1.5)
        for plant, more in ((TwinSnake, {"timestep": 0.0005}), (AnalyticalSnake, {}))
    )
    for j in range(1, 5):
        assert np.sqrt(np.mean((twin[f"bend_{j}"] - free[f"bend_{j}"]) ** 2)) < 0.01


def test_exported_model_has_module_gains_and_rest_bends():
    spec = unlike()
    model = robot_mjcf(spec, ModelSettings(contact=PreloadedContact())).compile()
    for j in range(1, 5):
        hinges = [model.joint(f"hinge_{j}_{k}") for k in (1, 2)]
        assert sum(model.qpos_spring[h.qposadr[0]] for h in hinges) == pytest.approx(
            spec.modules.bias[j - 1]
        )
        for side, name, sign in ((0, "plus", 1), (1, "minus", -1)):
            required = (
                sign
                * spec.bending.stiffness
                * spec.actuator.gain
                * spec.modules.gain[j - 1][side]
            )
            assert model.actuator(f"{name}_{j}").gainprm[0] == pytest.approx(required)


# Faults


@pytest.mark.default_cases(at=[0, 1, 2])
@both
@pytest.mark.parametrize(("state", "level"), [(1, 1.0), (-1, 0.0)])
def test_stuck_valve_ignores_commands(kind, state, level):
    plant = PLANTS[kind](robot("gen4"), supply_pa=48e3)
    plant.pneumatics.stuck = (StuckValve(2, 0, state, since=0.513),)
    run = rollout(plant, Gait(1.0), 3.0)
    stuck = run["pressure_plus_2"]
    other = run["pressure_minus_2"]
    assert np.ptp(run["valve_plus_2"][run["time"] > 0.53]) == 0
    assert np.abs(stuck[run["time"] > 2.0] / 48e3 - level).max() < 1e-4
    assert (
        np.ptp(stuck[run["time"] < 0.5]) > 40e3
        and np.ptp(other[run["time"] > 2.0]) > 40e3
    )
    assert plant.openings()[1, 0] <= 2 < plant.openings()[1, 1]


def test_valve_can_stick_within_a_schedule():
    chambers = LagPneumatics(robot("gen4"), supply_pa=48e3)
    chambers.stuck = (StuckValve(1, 1, 1, since=0.01),)
    at = np.array([0.01, 0.02])
    trace = chambers.advance(chambers.schedule(np.full((4, 2), -1), 0.02), at)
    tau = 0.1107
    assert trace.pressure[:, 0, 1] == pytest.approx(
        [0.0, 48e3 * (1 - np.exp(-0.01 / tau))], abs=1e-6
    )
    assert not trace.pressure[:, 0, 0].any()


# Drawing


def test_random_modules_have_the_requested_spread_and_independent_streams():
    record = {"unit": "1", "status": "estimated", "source": "test"}
    file = ModulesFile(
        gain_spread={**record, "value": 0.15},
        bias_spread_rad={**record, "value": 0.1, "unit": "rad"},
    )
    draws = [file.draw(4, seed) for seed in range(300)]
    gains = np.array([entry.gain for entry in draws]).ravel()
    assert kstest((gains - 1) / 0.15, norm.cdf).pvalue > 0.01
    assert np.abs(gains - 1).max() <= 3 * 0.15 + 1e-12
    biases = np.array([entry.bias for entry in draws])
    assert (
        np.abs(np.corrcoef(biases.T, gains.reshape(300, 8).T) - np.eye(12)).max() < 0.2
    )
    alone = ModulesFile(gain_spread={**record, "value": 0.15})
    assert (
        alone.draw(4, 7).gain == draws[7].gain and alone.draw(4, 7).bias == (0.0,) * 4
    )
    assert draws[7] == file.draw(4, 7) != draws[8]


def test_listed_and_random_module_values_combine():
    unit = {"unit": "1", "status": "measured", "source": "test"}
    listed = [[1.0, 2.0], [0.5, 1.0]]
    file = ModulesFile(
        gain={**unit, "value": listed}, gain_spread={**unit, "value": 0.1}, seed=3
    )
    alone = ModulesFile(gain_spread={**unit, "value": 0.1})
    assert np.array(file.draw(2, 99).gain) == pytest.approx(
        np.array(listed) * alone.draw(2, 3).gain
    )


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        (
            {"bias": (0.0,) * 3},
            r"modules\.bias has shape \(3,\), but the robot needs shape \(4,\)",
        ),
        (
            {"bias": (0.0, 0.0, np.nan, 0.0)},
            "modules.bias nan is not allowed; it must be between -3.14159 and 3.14159",
        ),
        (
            {"tau_fill": ((1.0, 0.0),) * 4},
            "modules.tau_fill 0 is not allowed; it must be between 0.01 and 100",
        ),
    ],
)
def test_invalid_modules_raise(changed, words):
    with pytest.raises(InputError, match=words):
        replace(Modules.nominal(4), **changed)


def test_modules_of_another_length_raise():
    with pytest.raises(
        InputError, match="the variation has 3 segments with 2 chambers, but"
    ):
        replace(load_robot("gen4"), variation=Modules.nominal(3))


# Files

SCENARIO = """\
robot:
  base: gen4
  modules: {gain_spread: 0.15, bias_rad: [0.1, 0, 0, -0.1], sensor_bias_rad: [0, 0.2, 0, 0]}
  actuator: {bend_limit_rad: 1.5}
duration_s: 1
seed: 5
supply: {pressure_kpa: 131}
controller: {kind: gait, frequency_hz: 1.0}
faults:
  - {kind: dead_sensor, segment: 3, from_s: 0.5}
  - {kind: dead_sensor, segment: 4, reading_rad: 0.25}
  - {kind: stuck_valve, segment: 1, chamber: minus, stuck: open}
"""


def test_scenario_with_modules_and_faults(tmp_path):
    path = tmp_path / "one.yaml"
    path.write_text(SCENARIO)
    scenario = load_scenario(path)
    assert (
        scenario.robot.modules.bias == (0.1, 0.0, 0.0, -0.1)
        and scenario.robot.actuator.bend_limit == 1.5
    )
    assert len({*np.ravel(scenario.robot.modules.gain)}) == 8
    for kind in PLANTS:
        run = rollout(scenario.build_plant(kind), scenario.build_controller(), 1.0)
        late = run["time"] >= 0.5
        assert (
            np.isnan(run["measured_bend_3"][late]).all()
            and np.isfinite(run["measured_bend_3"][~late]).all()
        )
        assert (run["measured_bend_4"] == 0.25).all()
        assert run["measured_bend_2"] == pytest.approx(run["bend_2"] + 0.2)
        assert run["pressure_minus_1"][-1] > 0.99 * 131e3
    (tmp_path / "two.yaml").write_text(SCENARIO.replace("seed: 5", "seed: 6"))
    assert load_scenario(tmp_path / "two.yaml").robot != scenario.robot


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            "segment: 3,",
            "segment: 5,",
            "10:34: faults[0].segment: segment 5 does not exist; gen4 has 4 segments",
        ),
        (
            "[0.1, 0, 0, -0.1]",
            "[0.1, 0]",
            "modules.bias_rad: 2 entries are given for 4 segments; give 4 entries,"
            " head first",
        ),
        (
            "gain_spread: 0.15",
            "gain_spred: 0.15",
            "unknown key; did you mean gain_spread?",
        ),
        ("gain_spread: 0.15", "gain_spread: 3", "a number from 0 to 0.3"),
        ("stuck: open", "stuck: ajar", "open"),
    ],
)
def test_module_errors_name_the_key(tmp_path, old, new, words):
    path = tmp_path / "bad.yaml"
    path.write_text(SCENARIO.replace(old, new))
    with pytest.raises(InputError) as caught:
        load_scenario(path)
    assert words in str(caught.value) and "bad.yaml:" in str(caught.value)


def test_robot_file_with_modules_has_sources(tmp_path):
    text = load_robot_file("gen4").model_dump(mode="json", exclude_none=True)
    record = {"unit": "1", "status": "measured", "source": "bench, 2026"}
    text["modules"] = {"gain": {**record, "value": [[1.1, 0.9]] * 4}}
    path = tmp_path / "mine.yaml"
    path.write_text(json.dumps(text))
    assert load_robot(path).modules.gain == ((1.1, 0.9),) * 4
    assert load_robot_file(path).records()["modules.gain"].source == "bench, 2026"


def test_sensor_drift_keeps_the_noise():
    spec = unlike(sensors=0.1)
    drifted = make_sensor("hall", spec)
    plain = make_sensor("hall", replace(spec, variation=None))
    bend = np.full((5, 4), 0.3)
    time = np.arange(5) * 0.01
    expected = (
        plain.read(bend, time, 3) * spec.modules.sensor_gain + spec.modules.sensor_bias
    )
    assert drifted.read(bend, time, 3) == pytest.approx(expected)
    assert drifted.kind == "hall" and "drift_gain" in drifted.describe()
