"""Robots whose segments bend in two directions: chambers, gaits and the twin."""

from dataclasses import replace

import numpy as np
import pytest
from heavy_rod import sag
from snakes import shortened

from srs_twin import AnalyticalSnake, Gait, load_robot, load_scenario, rollout
from srs_twin.comparison.gait import spatial_metrics
from srs_twin.control.gait import PitchWave
from srs_twin.envs import make_task
from srs_twin.errors import InputError, InputFileError
from srs_twin.live.shadow import Shadow
from srs_twin.plants.twin.snake import TwinSnake
from srs_twin.pneumatics import LagPneumatics, Schedule, make_pneumatics
from srs_twin.robot.spec import GRAVITY
from srs_twin.scenario.loading import parse_scenario
from srs_twin.studies.sweep.task import flat_metrics
from srs_twin.trajectory import Trajectory

SPEC = load_robot("spatial_example")
SUPPLY = 20e3
SIDEWINDING = PitchWave(0.4, np.pi / 2)


def crawl(gait, duration=1.0, spec=SPEC, **options):
    return rollout(
        TwinSnake(spec, supply_pa=SUPPLY, timestep=0.002), gait, duration, **options
    )


def with_directions(*degrees):
    return replace(
        SPEC, chamber=replace(SPEC.chamber, directions=tuple(np.radians(degrees)))
    )


def traces_of_a_fill(chamber, **options):
    """Return the traces of a planar and of the spatial robot, one chamber of which fills for 0.1 s."""
    planar_spec = replace(SPEC, chamber=replace(SPEC.chamber, directions=None))
    planar = LagPneumatics(planar_spec, supply_pa=SUPPLY, **options)
    spatial = make_pneumatics("lag", SPEC, supply_pa=SUPPLY, layout="3/2", **options)
    times = np.linspace(0.0, 0.3, 7)
    starts = np.array([0.0, 0.1])
    one, many = (np.full((2, 8, count), -1, dtype=np.int8) for count in (2, 4))
    one[0, 0, 0] = many[0, 0, chamber] = 1
    return (
        planar.advance(Schedule(0.3, starts, one), times),
        spatial.advance(Schedule(0.3, starts, many), times),
    )


def test_leaking_chamber_draws_the_air_of_a_planar_robot():
    """Both integrate the leak by the trapezoidal rule."""
    tight, _ = traces_of_a_fill(2)
    expected, trace = traces_of_a_fill(2, leak_per_s=0.8)
    drawn = trace.pneumatic_energy[-1]
    assert drawn == pytest.approx(expected.pneumatic_energy[-1], rel=1e-4)
    assert abs(drawn - tight.pneumatic_energy[-1]) > 0.01 * drawn


@pytest.mark.default_cases(3)
@pytest.mark.parametrize(
    ("filled", "component", "sign"), [(0, 0, 1), (1, 0, -1), (2, 1, 1), (3, 1, -1)]
)
def test_each_chamber_bends_a_segment_as_that_of_a_planar_robot(
    filled, component, sign
):
    expected, trace = traces_of_a_fill(filled)
    assert trace.pressure[:, 0, filled] == pytest.approx(
        expected.pressure[:, 0, 0], rel=1e-12
    )
    assert sign * trace.bend[:, 0, component] == pytest.approx(
        expected.bend[:, 0], rel=1e-9, abs=1e-12
    )
    assert sign * trace.bend_rate[:, 0, component] == pytest.approx(
        expected.bend_rate[:, 0], rel=1e-9
    )
    assert sign * trace.bend_acceleration[:, 0, component] == pytest.approx(
        expected.bend_acceleration[:, 0], rel=1e-9
    )
    assert (trace.valves[:, 0, filled] == expected.valves[:, 0, 0]).all()
    assert trace.pneumatic_energy == pytest.approx(
        expected.pneumatic_energy, rel=1e-9, abs=1e-12
    )
    assert abs(trace.bend[:, 0, 1 - component]).max() < 1e-12


def test_equal_pressures_in_three_chambers_leave_the_rest_bends():
    three = with_directions(90, 210, 330)
    spec = replace(three, variation=replace(three.modules, bias=(0.1,) * 8))
    chambers = make_pneumatics("lag", spec, supply_pa=SUPPLY, layout="3/2")
    trace = chambers.advance(
        Schedule(0.5, np.zeros(1), np.ones((1, 8, 3), dtype=np.int8)),
        np.array([0.1, 0.5]),
    )
    assert trace.bend == pytest.approx(np.tile([0.1, 0.0], (2, 8, 1)), abs=1e-12)
    assert trace.pressure.min() > 0.0


def test_the_limit_holds_for_the_magnitude_of_the_bend():
    limited = replace(SPEC, actuator=replace(SPEC.actuator, bend_limit=0.5))
    chambers = make_pneumatics("lag", limited, supply_pa=100e3, layout="3/2")
    states = np.full((1, 8, 4), -1, dtype=np.int8)
    states[0, :, [0, 2]] = 1
    bend = chambers.advance(Schedule(2.0, np.zeros(1), states), np.array([2.0])).bend[
        0, 0
    ]
    assert bend[0] == pytest.approx(bend[1]) and 0.49 < np.hypot(*bend) < 0.5


def test_directions_must_surround_the_axis():
    with pytest.raises(InputError, match="less than 180"):
        with_directions(0, 90, 180)
    with pytest.raises(
        InputFileError, match="neighbouring chambers must be less than 180"
    ):
        load_scenario(
            "spatial_sidewinding", set={"robot.chamber.directions_deg": [0, 90, 180]}
        )
    with pytest.raises(InputFileError, match="round cross-section"):
        load_scenario("spatial_sidewinding", set={"robot.geometry.width_m": 0.06})


def test_a_solid_round_section_twists_with_two_thirds_of_the_bending_stiffness():
    assert SPEC.bending.pitch_stiffness == SPEC.bending.stiffness
    assert SPEC.bending.roll_stiffness == pytest.approx(2 / 3 * SPEC.bending.stiffness)


def test_the_fundamental_of_a_resting_wave_has_the_amplitude_of_the_fraction():
    gait = Gait(1.0, phase_step=0.0, pitch=PitchWave(0.3, 0.0))
    gait.reset(SPEC, 0.02)
    schedule = gait.script(1.0)
    edges = np.append(schedule.starts, 1.0)
    amplitudes = []
    for plus, minus in ((0, 1), (2, 3)):
        wave = (
            schedule.states[:, 0, plus].astype(float) - schedule.states[:, 0, minus]
        ) / 2
        phases = np.exp(-2j * np.pi * edges)
        amplitudes.append(abs(2 * (wave * np.diff(phases) / (-2j * np.pi)).sum()))
    assert amplitudes[1] / amplitudes[0] == pytest.approx(0.3 / 0.7, abs=1e-3)
    assert amplitudes[0] == pytest.approx(4 / np.pi, rel=1e-6)


def test_a_pitch_wave_alone_leaves_the_other_chambers_empty():
    gait = Gait(1.0, pitch=PitchWave(1.0, lifted_segments=1))
    gait.reset(SPEC, 0.02)
    states = gait.script(1.0).states
    assert (
        (states[:, :, :2] == -1).all()
        and (states[:, 0, 2] == 1).all()
        and (states[:, 1, 2] == -1).any()
    )


def test_stepping_gives_the_states_of_the_script():
    gait = Gait(0.7, 0.2, pitch=PitchWave(0.6, 0.3, 2.0))
    gait.reset(SPEC, 0.02)
    script = gait.script(0.4)
    for tick in range(20):
        slots = gait.valves_at(0.02 * tick)
        piece = script.slice(0.02 * tick, 0.02 * (tick + 1))
        assert (slots[0] == piece.states[0]).all() and (
            slots[-1] == piece.states[-1]
        ).all()


@pytest.fixture(scope="module")
def run():
    return crawl(Gait(0.5, pitch=SIDEWINDING), spec=shortened(SPEC, 6), duration=1.0)


def test_the_floor_carries_the_weight_of_a_body_that_lifts_itself(run):
    weight = GRAVITY * shortened(SPEC, 6).mass.total
    loads = run.stack("load")[1:]
    assert loads.sum(axis=1).mean() == pytest.approx(weight, rel=0.05)
    assert run.stack("z").max() > 1.3 * SPEC.geometry.com_height
    assert 0.2 < (loads > 0.0).mean() < 0.9


def test_columns_of_a_spatial_run_survive_a_file(run, tmp_path):
    run.to_parquet(tmp_path / "run.parquet")
    again = Trajectory.from_parquet(tmp_path / "run.parquet")
    assert again.stack("pitch").shape == again.stack("bend").shape == (len(run), 5)
    assert again.stack("pressure_4").shape == (len(run), 5) and not again.has(
        "pressure_plus"
    )
    turns = np.stack([again.stack(f"quaternion_{axis}") for axis in "wxyz"], axis=-1)
    assert np.linalg.norm(turns, axis=-1) == pytest.approx(np.ones(turns.shape[:-1]))
    w, x, y, z = np.moveaxis(turns, -1, 0)
    heading = np.arctan2(2 * (x * y + w * z), 1 - 2 * (y**2 + z**2))
    assert np.cos(heading - again.stack("connector_heading")) == pytest.approx(
        np.ones(heading.shape)
    )
    assert (again.unit("pitch_1"), again.unit("pressure_1_1"), again.unit("z_1")) == (
        "rad",
        "Pa",
        "m",
    )


@pytest.fixture(scope="module")
def lifting():
    """Return a run until the body has lifted; later, rounding errors grow with every new contact."""
    return lift(Gait(0.5, pitch=SIDEWINDING))


def lift(gait, **options):
    return rollout(
        TwinSnake(shortened(SPEC, 6), supply_pa=SUPPLY), gait, 0.3, **options
    )


def test_the_mirror_image_of_a_gait_travels_along_the_mirror_image_of_its_path(lifting):
    other = lift(Gait(0.5, phase=np.pi, pitch=PitchWave(0.4, -np.pi / 2)))
    assert lifting.stack("z").max() > SPEC.geometry.com_height + 2e-3
    assert other["com_x"] == pytest.approx(lifting["com_x"], abs=1e-9)
    assert other["com_y"] == pytest.approx(-lifting["com_y"], abs=1e-9)
    assert other.stack("z") == pytest.approx(lifting.stack("z"), abs=1e-9)


def test_the_motion_does_not_depend_on_the_heading(lifting):
    other = lift(Gait(0.5, pitch=SIDEWINDING), pose=(1.0, 2.0, 1.0))
    c = np.cos(1.0)
    s = np.sin(1.0)
    turned = lifting.com @ np.array([[c, s], [-s, c]]) + [1.0, 2.0]
    assert other.com == pytest.approx(turned, abs=1e-9)


def test_a_run_continues_from_a_saved_state_with_the_same_bits():
    twin = TwinSnake(shortened(SPEC, 4), supply_pa=SUPPLY, timestep=0.002)
    gait = Gait(0.5, pitch=SIDEWINDING)
    rollout(twin, gait, 0.2)
    saved = twin.save()
    valves = gait.valves_at(0.2)
    expected = twin.step(valves)
    twin.step(valves)
    twin.restore(saved)
    again = twin.step(valves)
    assert (again.qpos == expected.qpos).all() and (
        again.pressure == expected.pressure
    ).all()


def test_a_clamped_snake_sags_as_the_elastica():
    stiffness = 2.0  # N·m/rad; the tip then sags by a tenth of the length
    spec = shortened(SPEC, 5)
    spec = replace(
        spec,
        geometry=replace(spec.geometry, rigid_gap=0.0),
        bending=replace(
            spec.bending,
            stiffness=stiffness,
            pitch_stiffness=stiffness,
            damping_time=0.05,
            out_of_plane_damping_time=0.05,
        ),
    )
    twin = TwinSnake(spec, base="clamped", timestep=0.002, hinges_per_segment=4)
    empty = np.full((spec.segments, 4), -1, dtype=np.int8)
    for _ in range(100):
        state = twin.step(empty)
    drop = state.height[0] - state.height[-1]
    assert drop / spec.geometry.body_length == pytest.approx(sag(spec), rel=0.02)
    assert abs(state.bend[:, 0]).max() < 1e-9
    # The torques hold the deflection, and the air does no work: gravity delivers what
    # the dampers take.
    assert state.torque == pytest.approx(-stiffness * state.bend, abs=1e-3 * stiffness)
    assert abs(state.work) < 0.02 * state.internal_loss


def test_the_scenario_of_a_run_loads_again_and_a_start_in_motion_is_refused():
    scenario = load_scenario("spatial_sidewinding")
    again = parse_scenario(scenario.document)
    assert again.document == scenario.document
    with pytest.raises(InputFileError, match="start: spatial_example is spatial"):
        load_scenario("spatial_sidewinding", set={"start.bend_rad": [0.1] * 8})
    with pytest.raises(
        InputFileError, match="world: .* the spatial robot 'spatial_example' with"
    ):
        load_scenario("spatial_sidewinding", set={"world.floor.tilt_deg": 5})


def test_sweeps_record_the_openings_of_every_chamber():
    columns = flat_metrics("twin", {"valve_switches": [[1, 2, 3, 4], [5, 6, 7, 8]]})
    assert columns["twin.valve_switches_3_2"] == 7.0 and len(columns) == 8


def test_features_for_planar_robots_refuse_a_spatial_one_by_name():
    planar = load_robot("gen2")
    for refused in (
        lambda: make_pneumatics("orifice", SPEC, supply_pa=SUPPLY, layout="3/2"),
        lambda: AnalyticalSnake(SPEC),
        lambda: Shadow(SPEC),
        lambda: make_task("GoTo", robot="spatial_example"),
    ):
        with pytest.raises(
            InputError, match="does not support the spatial robot 'spatial_example'"
        ):
            refused()
    with pytest.raises(InputError, match="needs a spatial robot, but 'gen2' bends"):
        rollout(TwinSnake(planar), Gait(1.0, pitch=SIDEWINDING), 0.1)
    with pytest.raises(
        InputFileError,
        match="analytical.model: model 'complete' does not support the spatial robot",
    ):
        load_scenario("spatial_sidewinding", set={"plants.analytical": {}})
    with pytest.raises(
        InputFileError,
        match="controller.kind: the controller is not allowed, because spatial_example is",
    ):
        load_scenario(
            "spatial_sidewinding",
            set={"controller": {"kind": "ilc", "frequency_hz": 1.0}},
        )
    with pytest.raises(InputError, match="does not support the spatial robot"):
        twin = TwinSnake(shortened(SPEC, 4))
        twin.set_state(twin.state)


def test_supports_and_turns_about_the_axis_are_counted():
    count = 6
    times = np.linspace(0.0, 2.0, 41)
    load = np.zeros((len(times), count))
    load[:, [0, 1, 3, 5]] = 1.0  # three separate parts
    roll = 2 * np.pi * 0.75 * times
    columns = {f"load_{i + 1}": load[:, i] for i in range(count)}
    for name, values in zip(
        "wxyz", (np.cos(roll / 2), np.sin(roll / 2), 0 * roll, 0 * roll), strict=True
    ):
        columns |= {f"quaternion_{name}_{i + 1}": values for i in range(count)}
    columns |= {f"z_{i + 1}": 0 * times for i in range(count)}
    metrics = spatial_metrics(Trajectory({"time": times} | columns, {}))
    assert metrics["supports"] == 3.0 and metrics["roll_turns"] == pytest.approx(1.5)
