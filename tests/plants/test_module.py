"""Module of generation 4 on a bench: settings, laws of the bench, control, reports and shipped gains."""

from __future__ import annotations

import math
from dataclasses import fields, replace

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid
from smooth import Wave

from srs_twin import AnalyticalSnake, Plant, SnakeState, TwinSnake, load_robot, rollout
from srs_twin.comparison.compare import compare
from srs_twin.comparison.metrics import plant_metrics
from srs_twin.control.reference import Sine, StepReference
from srs_twin.control.replay import HoldValves
from srs_twin.control.smc import DirectSMC, IterativeSMC
from srs_twin.errors import InputError, InputFileError
from srs_twin.plants.analytical import kernels
from srs_twin.plants.analytical.bodies import simulate_clamped
from srs_twin.plants.analytical.kinematics import BodyParameters
from srs_twin.pneumatics import Trace
from srs_twin.robot.geometry import body_shape, relative_headings
from srs_twin.scenario.loading import load_scenario, parse_scenario
from srs_twin.sensing import make_sensor

MODULE = load_robot("gen4_module")
STEP = StepReference(math.radians(25), time=0.1)
SINE = Sine(math.radians(34.3), 6.0)
CONTROLS = {"direct": (DirectSMC, "in_out"), "iterative": (IterativeSMC, "3/2")}
PLANTS = {"analytical": AnalyticalSnake, "twin": TwinSnake}

controls = pytest.mark.parametrize("control", CONTROLS)
plants = pytest.mark.parametrize("kind", PLANTS)


def bench(kind: str, control: str, **options) -> Plant:
    """Return a bench with a noisy sensor and the valve layout that a controller needs."""
    sensor = make_sensor("hall", MODULE, span=0.8)
    layout = CONTROLS[control][1]
    timestep = {"twin": {"timestep": 0.00025}}.get(kind, {})
    return PLANTS[kind](
        MODULE,
        base="clamped",
        tick=0.001,
        **{"layout": layout, "sensor": sensor} | timestep | options,
    )


# Scenario settings


def module(**changes):
    """Return the scenario of a step with some keys changed."""
    data = {
        "robot": "gen4_module",
        "duration_s": 1.0,
        "bench": True,
        "controller": {
            "kind": "direct_smc",
            "reference": {"kind": "step", "bend_rad": 0.4},
        },
    }
    return parse_scenario(data | changes, name="module")


@pytest.mark.parametrize(
    ("controller", "layout"),
    [
        (
            {"kind": "direct_smc", "reference": {"kind": "step", "bend_rad": 0.4}},
            "in_out",
        ),
        (
            {
                "kind": "iterative_smc",
                "reference": {"kind": "constant", "bend_rad": 0.4},
            },
            "3/2",
        ),
        ({"kind": "hold_valves"}, "3/2"),
        ({"kind": "hold_valves", "minus": "hold"}, "in_out"),
    ],
)
def test_controller_selects_the_layout_and_bench_the_tick(controller, layout):
    scenario = module(controller=controller)
    assert scenario.layout == scenario.document["valves"]["layout"] == layout
    for kind in PLANTS:
        plant = scenario.build_plant(kind)
        assert (plant.layout, plant.tick, plant.describe()["base"]) == (
            layout,
            0.001,
            "clamped",
        )
    assert parse_scenario(scenario.document, name="module") == scenario


def test_explicit_layout_is_kept():
    scenario = module(
        controller={"kind": "gait", "frequency_hz": 1.0}, valves={"layout": "in_out"}
    )
    assert scenario.build_plant("twin").layout == "in_out"


def test_explicit_gains_override_shipped_gains():
    default = module().build_controller()
    settings = module(
        controller={
            "kind": "direct_smc",
            "d_per_s": 3.0,
            "epsilon_rad_per_s": 0.5,
            "cutoff_hz": 7.0,
            "reference": {"kind": "sine", "amplitude_rad": 0.3, "frequency_hz": 2.0},
        }
    ).build_controller()
    assert (settings.D, settings.epsilon, settings.cutoff_hz) == (3.0, 0.5, 7.0)
    assert settings.reference == Sine(0.3, 2.0)
    plain = DirectSMC(STEP)
    assert (default.D, default.epsilon, default.cutoff_hz) == (
        plain.D,
        plain.epsilon,
        plain.cutoff_hz,
    )


def test_reference_beyond_the_range_is_rejected_or_clipped_with_a_warning():
    controller = {"kind": "direct_smc", "reference": {"kind": "step", "bend_rad": 1.2}}
    with pytest.raises(
        InputFileError, match=r"reaches 68.75°.*41.97°.*beyond_range: saturate"
    ):
        module(controller=controller)
    scenario = module(controller=controller | {"beyond_range": "saturate"})
    (warning,) = scenario.warnings
    assert "1.2 rad is limited to 0.7326 rad" in warning
    run = rollout(scenario.build_plant("analytical"), scenario.build_controller(), 0.02)
    assert run["reference_1"].max() == pytest.approx(0.7326, abs=1e-4)
    assert [event.kind for event in run.events] == ["saturation"]
    # More air, more range.
    assert module(controller=controller, supply={"pressure_kpa": 80.0}).warnings == ()


def test_invalid_sensor_settings_raise():
    usual = {"base": "gen4_module"}
    short = usual | {"geometry": {"segment_length_m": 0.04}}
    at_most = "it must be at most the length of the segment, 0.04 m"
    for words, robot, sensor in (
        ("heights|within", usual, {"kind": "hall", "distance_mm": 1.0}),
        (at_most, short, {"kind": "hall", "distance_mm": 50.0}),
    ):
        with pytest.raises(InputFileError, match=words):
            module(robot=robot, sensor=sensor)


def test_pulses_shorter_than_a_tick_raise_before_the_run():
    with pytest.raises(
        InputFileError,
        match="controller: on the twin plant: .*carrier of 600 Hz is too fast",
    ):
        module(
            controller={
                "kind": "iterative_smc",
                "carrier_hz": 600,
                "reference": {"kind": "constant", "bend_rad": 0.2},
            },
            plants={"twin": {"tick_s": 0.002}},
        )


@plants
def test_layout_unsupported_by_the_controller_raises(kind):
    with pytest.raises(
        InputError,
        match="needs valves of layout in_out, but the .* plant has the layout 3/2",
    ):
        rollout(bench(kind, "direct", layout="3/2"), DirectSMC(STEP), 0.01)
    with pytest.raises(
        InputError,
        match="needs valves of layout 3/2, but the .* plant has the layout in_out",
    ):
        rollout(bench(kind, "iterative", layout="in_out"), IterativeSMC(STEP), 0.01)


# Law of the bench


@plants
def test_clamped_head_stays_and_tail_has_no_contact(kind):
    run = rollout(bench(kind, "direct"), DirectSMC(STEP), 0.4, record_hz=1000)
    head = run.position[:, 0]
    assert np.abs(head - head[0]).max() < 1e-12
    assert np.abs(run["connector_heading_1"]).max() < 1e-12
    assert run["connector_heading_2"] == pytest.approx(-run["bend_1"], abs=1e-9)
    assert run["bend_1"].max() > 0.4


@pytest.mark.parametrize(("kind", "allowed"), [("analytical", 1e-9), ("twin", 0.02)])
def test_work_equals_the_kinetic_energy(kind, allowed):
    """Without a floor, ∫ T q̇ dt = E, from recorded columns."""
    heavy = replace(MODULE, mass=replace(MODULE.mass, connectors=(0.02, 0.02)))
    plant = PLANTS[kind](
        heavy,
        base="clamped",
        tick=0.001,
        pneumatics=Wave(heavy),
        **{"twin": {"timestep": 0.00025}}.get(kind, {}),
    )
    run = rollout(plant, HoldValves(), 1.0, record_hz=1000)
    time = run.time
    power = run["torque_1"] * np.gradient(run["bend_1"], time)
    done = cumulative_trapezoid(power, time, initial=0.0)
    # The moving end: its speed and its turning from the recorded places. The analytical
    # model has point masses.
    speed = np.gradient(run.position[:, 1], time, axis=0)
    energy = heavy.mass.array()[1] * (speed**2).sum(axis=1) / 2
    if kind == "twin":
        spin = np.gradient(run["connector_heading_2"], time)
        energy += heavy.yaw_inertia()[1] * spin**2 / 2
    assert energy.max() > 1e-5
    inner = slice(5, -5)
    largest = (0.01 + allowed) * energy.max()
    assert np.abs(run["work"] - energy)[inner].max() < largest
    assert np.abs(done - run["work"])[inner].max() < largest


def test_analytical_torque_satisfies_lagranges_equation():
    """T = d/dt(M q̇) − ∂(½ q̇ᵀ M q̇)/∂q of a chain of three, by differences in time and bends."""
    mass = np.array([0.01, 0.02, 0.03])
    inertia = np.array([1e-6, 2e-6, 3e-6])
    head = np.array([0.3, -0.2, 1.1])
    tiny = 1e-20j
    h = 1e-4

    def poses(q):
        """Return positions and headings of the connectors for complex bends, shape (3, 3)."""
        own = relative_headings(q)
        ahead = body_shape(q, mass, 0.07, 0.004)
        x, y = (ahead - ahead[0]).T
        turn = head[2] - own[0]
        c = np.cos(turn)
        s = np.sin(turn)
        return np.stack(
            [head[0] + c * x - s * y, head[1] + s * x + c * y, own + turn], axis=1
        )

    def mass_matrix(q):
        rows = np.array([poses(q + tiny * e).imag / tiny.imag for e in np.eye(2)])
        weights = np.stack([mass, mass, inertia], axis=1)
        return np.einsum("ia,jia,kia->jk", weights, rows, rows)

    def derivative(v):
        return (mass_matrix(q + h * v) - mass_matrix(q - h * v)) / (2 * h)

    q = np.array([0.5, -0.8])
    dq = np.array([2.0, 3.0])
    ddq = np.array([-40.0, 25.0])
    expected = mass_matrix(q) @ ddq + derivative(dq) @ dq
    expected -= [dq @ derivative(e) @ dq / 2 for e in np.eye(2)]
    states = np.zeros((1, kernels.STATES))
    velocities = np.zeros((1, 3))
    torque = np.zeros((1, 2))
    trace = Trace.empty(1, 2)._replace(
        bend=q[None], bend_rate=dq[None], bend_acceleration=ddq[None]
    )
    solid = BodyParameters.of(mass, inertia, 0.07, 0.004)
    simulate_clamped(trace, solid, head, states, velocities, torque)
    assert torque[0] == pytest.approx(expected, rel=1e-6)
    moved = poses(q + tiny * dq)
    centre = mass @ moved[:, :2] / mass.sum()
    heading = moved[:, 2].mean()
    speed = centre.imag / tiny.imag
    now = states[0]
    assert now[:2] == pytest.approx(centre.real, abs=1e-12)
    assert now[kernels.HEADING] == pytest.approx(heading.real, abs=1e-12)
    assert now[[kernels.STATE_VX, kernels.STATE_VY]] == pytest.approx(speed, abs=1e-12)
    c = np.cos(heading.real)
    s = np.sin(heading.real)
    spin = heading.imag / tiny.imag
    assert velocities[0] == pytest.approx(
        [c * speed[0] + s * speed[1], c * speed[1] - s * speed[0], spin], abs=1e-12
    )


# Both benches


@pytest.mark.slow
@controls
@pytest.mark.parametrize(
    ("reference", "duration"),
    [
        pytest.param(STEP, 0.8, id="step"),
        pytest.param(SINE, 1.0, id="sine", marks=pytest.mark.slow),
    ],
)
def test_both_benches_agree_within_ten_percent(control, reference, duration):
    runs = [
        rollout(
            bench(kind, control),
            CONTROLS[control][0](reference),
            duration,
            record_hz=1000,
        )
        for kind in PLANTS
    ]
    ours, theirs = (plant_metrics(run) for run in runs)
    reported = 0
    for name in (
        "rise_time_s",
        "settling_5_s",
        "ripple_pp_rad",
        "error_rms_rad",
        "amplitude_rel",
        "phase_lag_rad",
        "inlet_openings",
        "outlet_openings",
    ):
        if ours[name] is None:
            assert theirs[name] is None
            continue
        reported += 1
        assert theirs[name] == pytest.approx(ours[name], rel=0.1, abs=1e-9), name
    assert reported >= 4
    assert all(
        item["com_speed_m_s"] is None and item["final_bend_rad"] is None
        for item in (ours, theirs)
    )
    metrics = compare(*runs).metrics
    assert metrics["bend_rms_rel"] < 0.02 and metrics["com_speed_rel"] is None


def test_static_bend_is_gain_times_pressure():
    for kind in PLANTS:
        run = rollout(
            bench(kind, "direct", supply_pa=30e3), HoldValves("vent", "fill"), 1.5
        )
        values = plant_metrics(run)
        assert values["final_bend_rad"] == pytest.approx(
            -MODULE.actuator.gain * 30e3, rel=1e-4
        )
        assert values["error_rms_rad"] is None


@controls
def test_direct_control_settles_fast_with_few_valve_openings(control):
    """A step of 25°: direct control settles within 0.25 s without overshoot; iterative control overshoots."""
    found = plant_metrics(
        rollout(bench("twin", control), CONTROLS[control][0](STEP), 0.9, record_hz=1000)
    )
    if control == "direct":
        assert found["settling_5_s"] <= 0.25
        assert found["overshoot_rad"] <= found["measured_ripple_pp_rad"]
        assert found["inlet_openings"] <= 5
    else:
        assert found["overshoot_rel"] > 0.05
        assert found["inlet_openings"] > 40


# Information of the controllers


class Blindfolded(Plant):
    """Bench whose states are NaN except for time and sensor readings."""

    def __init__(self, plant: Plant) -> None:
        self._plant = plant
        self.name = plant.name
        self.spec = plant.spec
        self.tick = plant.tick
        self.layout = plant.layout
        self.commands: list[np.ndarray] = []

    def reset(self, **start) -> SnakeState:
        return self._hidden(self._plant.reset(**start))

    def step(self, valves: np.ndarray) -> SnakeState:
        self.commands.append(np.array(valves))
        return self._hidden(self._plant.step(valves))

    def _hidden(self, state: SnakeState) -> SnakeState:
        blank = {
            f.name: np.full(np.shape(getattr(state, f.name)), np.nan)
            for f in fields(state)
            if f.name not in ("time", "measured_bend")
        }
        return replace(state, **blank)


@pytest.mark.default_cases(2)
@plants
@controls
def test_controllers_read_only_the_sensor(kind, control):
    blind = Blindfolded(bench(kind, control))
    controller = CONTROLS[control][0](STEP)
    state = blind.reset(seed=3)
    controller.reset(blind.spec, blind.tick, seed=3)
    for _ in range(300):
        state = blind.step(controller.step(state))
    seeing = bench(kind, control)
    run = rollout(seeing, CONTROLS[control][0](STEP), 0.3, seed=3, record_hz=1000)
    last = np.array(
        [entry if entry.ndim == 2 else entry[-1] for entry in blind.commands]
    )
    assert (last[:, 0, 0] == run["valve_plus_1"][1:]).all()
    assert (last[:, 0, 1] == run["valve_minus_1"][1:]).all()


def test_sensor_drift_biases_the_bend():
    """The controller cannot correct a sensor bias, which becomes an error of the bend."""
    errors = []
    for bias in (0.0, 0.2):
        sensor = make_sensor("hall", MODULE, span=0.8, bias=bias)
        run = rollout(
            bench("analytical", "direct", sensor=sensor),
            DirectSMC(STEP),
            0.8,
            record_hz=1000,
        )
        errors.append(plant_metrics(run)["steady_error_rad"])
        shift = abs(sensor.calibration.slope) * bias
    assert abs(errors[1] - errors[0]) == pytest.approx(shift, rel=0.3)


# Reports and metrics


@pytest.mark.slow
def test_report_shows_reference_tracking(tmp_path):
    from srs_twin.cli.table import rows
    from srs_twin.experiment import run_scenario

    scenario = module(
        record_hz=1000, duration_s=0.3, sensor={"kind": "hall", "span_rad": 0.8}
    )
    result = run_scenario(scenario, tmp_path)
    headings = {heading for heading, *_ in rows(result.metrics)}
    assert {"overshoot, relative", "rise, 10 to 90 %", "inlet openings"} <= headings
    assert not headings & {"CoM speed", "path length", "yaw rate"}
    page = (tmp_path / "report.html").read_text("utf-8")
    assert (
        "Bend of the first segment and its reference." in page
        and "Speed of the centre" not in page
    )
    assert (tmp_path / "recording.rrd").stat().st_size > 10_000
    assert load_scenario(tmp_path / "scenario.resolved.yaml") == scenario


@pytest.mark.default_cases(at=[0, 1])
@pytest.mark.parametrize(
    ("reference", "period"),
    [
        ({"kind": "sine", "amplitude_rad": 0.3, "frequency_hz": 5.0}, 0.2),
        ({"kind": "square", "amplitude_rad": 0.3, "frequency_hz": 4.0}, 0.25),
        ({"kind": "step", "bend_rad": 0.3, "time_s": 0.1}, None),
    ],
)
def test_plot_shows_periods_of_a_periodic_reference(reference, period):
    from srs_twin.viewing.plots.signals import reference_period

    scenario = module(controller={"kind": "direct_smc", "reference": reference})
    run = rollout(
        scenario.build_plant("analytical"),
        scenario.build_controller(),
        1.0,
        record_hz=1000,
    )
    found = reference_period(run)
    assert found == (None if period is None else pytest.approx(period, rel=1e-3))


def test_sweep_measures_whole_reference_periods():
    from srs_twin.studies.sweep.loading import load_sweep

    experiment = load_sweep("fig44_direct").experiment
    for frequency in (0.25, 6.0):
        document = experiment.document({"controller.reference.frequency_hz": frequency})
        assert document["duration_s"] == pytest.approx(8 / frequency, abs=0.001)


# As shipped


def test_chapter_4_scenarios_share_one_set_of_gains():
    from srs_twin.io.files import shipped_names

    found = {}
    for name in (
        each for each in shipped_names("scenario") if each.startswith("module_")
    ):
        settings = load_scenario(name).document["controller"]
        gains = {
            k: v
            for k, v in settings.items()
            if k not in ("reference", "beyond_range", "kind")
        }
        found.setdefault(settings["kind"], []).append(gains)
    assert len(found["direct_smc"]) == len(found["iterative_smc"]) == 7
    for gains in found.values():
        assert all(each == gains[0] for each in gains)
