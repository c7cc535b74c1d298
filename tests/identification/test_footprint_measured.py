"""Measured footprints: prescribed paths are recovered; symmetry and convergence of simulated ones."""

from __future__ import annotations

import cmath
import math
from dataclasses import astuple, replace
from functools import partial

import numpy as np
import pytest
from crawling import Crawl
from hypothesis import Phase, given, settings, strategies as st
from synthetic import mirrored, moved

from srs_twin import InputError, Trajectory, TwinSnake, load_robot, rollout
from srs_twin.comparison.gait import GaitWindow
from srs_twin.comparison.learning import PathFit, box_edges
from srs_twin.identification.footprint import (
    RECORD_HZ,
    TICK,
    GaitSetup,
    default_changes,
    footprint_study,
    steady_path,
)
from srs_twin.identification.paths import (
    SETTLED,
    OffsetChange,
    Poses,
    SteadyPath,
    average_repeats,
    combine_transients,
    measure_transient,
)
from srs_twin.planning.footprint import Footprint, Transient, validate_footprint

PERIODS = 6


def steady(crawl: Crawl, run: Trajectory | None = None) -> SteadyPath:
    run = crawl.trajectory() if run is None else run
    window = GaitWindow.ending_at(run, crawl.period, float(run.time[-1]), PERIODS)
    assert window is not None
    return SteadyPath.measure(run, crawl.geometry, window)


def edges_of_a_bar(crawl: Crawl, curvature: float) -> tuple[float, float, float, float]:
    """Return the left, right, front and rear edges of a swaying bar tangent to its circle at the middle.

    Its ends are round: half discs beyond its middle line.
    """
    half = crawl.geometry.width / 2
    half_length = crawl.geometry.body_length / 2
    ahead, lateral = crawl.sway
    if curvature == 0:
        return (
            half + lateral,
            half + lateral,
            half_length + half + ahead,
            half_length + half + ahead,
        )
    radius = 1 / abs(curvature)
    inner = half + lateral
    outer = math.hypot(half_length, radius + half + lateral) - radius
    corner = math.atan2(half_length, radius - half)
    disc = math.atan2(half_length, radius) + math.asin(
        half / math.hypot(half_length, radius)
    )
    reach = radius * max(corner, disc)
    return (
        (inner, outer, reach, reach) if curvature > 0 else (outer, inner, reach, reach)
    )


@pytest.mark.default_cases(at=[0, 5, 8])
@pytest.mark.parametrize("curvature", [-4.0, -0.3, 0.0, 1e-5, 0.3, 4.0])
@pytest.mark.parametrize("lateral", [0.0, 0.006])
def test_speed_curvature_and_edges_of_a_bar_on_a_circle(curvature, lateral):
    crawl = Crawl((curvature,), sway=(0.0, lateral))
    fit = steady(crawl)
    left, right, ahead, behind = edges_of_a_bar(crawl, curvature)
    assert fit.speed == pytest.approx(0.15, rel=1e-3)
    assert fit.curvature == pytest.approx(curvature, rel=1e-3, abs=1e-5)
    # The outer edge is reached by the ends of the bar, the inner edge by its middle.
    assert (fit.left, fit.right) == pytest.approx((left, right), abs=1e-4)
    if not lateral:
        assert (fit.ahead, fit.behind) == pytest.approx((ahead, behind), abs=1e-4)


@pytest.mark.slow
@settings(max_examples=15)
@given(
    curvature=st.floats(-5, 5),
    speed=st.floats(0.05, 0.3),
    phase=st.floats(0, 6.3),
    x=st.floats(-3, 3),
    angle=st.floats(-3, 3),
)
def test_edges_are_invariant_to_pose_and_phase_and_mirror_symmetric(
    curvature, speed, phase, x, angle
):
    crawl = Crawl((curvature,), speed=speed, sway=(0.003, 0.005), phase=phase)
    run = crawl.trajectory()
    fit, elsewhere, seen = (
        steady(crawl, r) for r in (run, moved(run, x, 1.0, angle), mirrored(run))
    )
    assert fit.speed == pytest.approx(speed, rel=5e-3)
    assert fit.curvature == pytest.approx(curvature, rel=5e-3, abs=1e-3)
    assert astuple(elsewhere) == pytest.approx(astuple(fit), abs=1e-7)
    swapped = (fit.speed, -fit.curvature, fit.right, fit.left, fit.ahead, fit.behind)
    assert astuple(seen) == pytest.approx(swapped, abs=1e-7)


def test_edges_of_a_straight_body_agree_with_the_metrics():
    """`box_edges` uses only the connectors, which is exact for a straight body."""
    crawl = Crawl((2.0,), sway=(0.002, 0.005))
    run = crawl.trajectory()
    run.metadata["body_width_m"] = crawl.geometry.width
    window = GaitWindow.ending_at(run, crawl.period, float(run.time[-1]), PERIODS)
    fit = PathFit.from_trajectory(run, window)
    left, right = box_edges(run, window, fit)
    result = steady(crawl)
    assert (-left, right) == pytest.approx((result.left, result.right), abs=2e-4)


def test_a_snake_without_forward_motion_has_no_footprint():
    with pytest.raises(InputError, match="mm per gait period"):
        steady(Crawl(speed=0.0, sway=(0.003, 0.005)))
    with pytest.raises(InputError, match="the snake moves forward by only -75 mm"):
        steady(Crawl(speed=-0.15))


def test_repeats_are_combined_as_mean_paths_and_farthest_edges():
    a = SteadyPath(0.1, 1.0, 0.03, 0.04, 0.1, 0.2)
    b = SteadyPath(0.2, 2.0, 0.05, 0.02, 0.3, 0.1)
    path, spread = average_repeats([a, b])
    assert astuple(path) == pytest.approx((0.15, 1.5, 0.05, 0.04, 0.3, 0.2))
    assert astuple(spread) == pytest.approx((0.05, 0.5, 0.01, 0.01, 0.1, 0.05))


@given(
    curvature=st.floats(-5, 5),
    length=st.floats(-0.3, 0.3),
    u=st.floats(-0.15, 0.15),
    w=st.floats(-0.1, 0.1),
    heading=st.floats(-3, 3),
)
def test_arc_motions_and_arc_coordinates_agree_with_geometry(
    curvature, length, u, w, heading
):
    here = Poses(np.array([0.3 - 0.2j]), np.array([heading]))
    there = here.compose(Poses.arc(curvature, length))
    back = there.compose(Poses.arc(curvature, -length))
    assert back.place == pytest.approx(here.place) and back.heading == pytest.approx(
        here.heading
    )
    nothing = there.inverse().compose(there)
    assert abs(nothing.place[0]) < 1e-12 and abs(nothing.heading[0]) < 1e-12
    # Expected values follow from radii and angles about the centre of the circle.
    point = here.place[0] + (u + 1j * w) * cmath.exp(1j * heading)
    along, left = (
        component[0, 0]
        for component in here.coordinates(
            np.array([[[point.real, point.imag]]]), curvature
        )
    )
    if abs(curvature) < 1e-6:
        assert (along, left) == pytest.approx((u, w), abs=1e-6)
        return
    centre = here.place[0] + 1j / curvature * cmath.exp(1j * heading)
    sign = math.copysign(1, curvature)
    radius = 1 / abs(curvature)
    assert left == pytest.approx(sign * (radius - abs(point - centre)), abs=1e-9)
    angle = cmath.phase((point - centre) / (here.place[0] - centre))
    assert along == pytest.approx(sign * radius * angle, abs=1e-6)


LATE = 0.604  # s, between the command and the turn; no whole number of samples


def late(before: float, after: float, **settings: object) -> tuple[Crawl, OffsetChange]:
    """Return a snake that follows a change of offset after a delay, then at once."""
    crawl = Crawl((before, after), (4.0 + LATE,), duration=8.0, **settings)  # type: ignore[arg-type]
    return crawl, OffsetChange(4.0, -0.1, 0.1)


def measured(
    crawl: Crawl,
    change: OffsetChange,
    run: Trajectory | None = None,
    *,
    seen: bool = False,
) -> Transient:
    paths = []
    for curvature in crawl.curvatures:
        alone = Crawl((curvature,), speed=crawl.speed, sway=crawl.sway)
        paths.append(steady(alone, mirrored(alone.trajectory()) if seen else None))
    run = crawl.trajectory() if run is None else run
    return measure_transient(
        run, crawl.geometry, crawl.period, change, (paths[0], paths[1])
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("before", "after"), [(-3.0, 3.0), (0.0, 2.0), (2.0, 0.0), (1.0, -1.0)]
)
def test_a_delayed_turn_is_recovered(before, after):
    crawl, change = late(before, after)
    fit = measured(crawl, change)
    way = crawl.speed * LATE
    # Along the old arc by the delay distance, and back along the new arc.
    place = 0j
    heading = 0.0
    for curvature, length in ((before, way), (after, -way)):
        steps = np.exp(
            1j * (heading + curvature * length * (np.arange(20_000) + 0.5) / 20_000)
        )
        place = place + length * steps.mean()
        heading = heading + curvature * length
    assert fit.dheading == pytest.approx(heading, abs=2e-3)
    assert (fit.dx, fit.dy) == pytest.approx((place.real, place.imag), abs=1e-3)
    assert fit.length == pytest.approx(
        way - SETTLED * crawl.speed * crawl.period, abs=2 * crawl.speed / 100
    )

    # Excess of the bar beyond the circles around both centres of the nominal new arc.
    time = np.arange(801) / 100
    places, headings = crawl.path(time)
    begin = places[400]
    direction = cmath.exp(1j * headings[400])
    bar = crawl.geometry.body_length * np.linspace(-0.5, 0.5, 201)
    sides = np.concatenate(
        [bar + 0.5j * crawl.geometry.width, bar - 0.5j * crawl.geometry.width]
    )
    upto = 400 + round(100 * fit.length / crawl.speed)
    points = (
        places[400 : upto + 1, None]
        + sides * np.exp(1j * headings[400 : upto + 1])[:, None]
    )

    def off(curvature: float) -> np.ndarray:
        if curvature == 0:
            return ((points - begin) / direction).imag
        centre = begin + 1j * direction / curvature
        return math.copysign(1, curvature) * (1 / abs(curvature) - abs(points - centre))

    old, new = (edges_of_a_bar(crawl, curvature) for curvature in (before, after))
    still = (off(before) <= old[0] + 1e-4) & (off(before) >= -old[1] - 1e-4)
    ahead = ((points - begin) / direction).real
    still &= ahead <= crawl.geometry.body_length / 2
    left = np.where(still, 0, off(after) - new[0]).max()
    right = np.where(still, 0, -off(after) - new[1]).max()
    assert (fit.left, fit.right) == pytest.approx(
        (max(left, 0), max(right, 0)), abs=2e-3
    )


def test_an_immediate_change_has_no_transient():
    crawl = Crawl((-2.0, 2.0), (4.0,), duration=8.0)
    fit = measured(crawl, OffsetChange(4.0, -0.1, 0.1))
    assert (fit.dx, fit.dy, fit.dheading) == pytest.approx((0, 0, 0), abs=2e-3)
    assert fit.length < 0.02
    # A bar across two arcs lies on neither; the excess is less than its width.
    assert max(fit.left, fit.right) < crawl.geometry.width


@pytest.mark.slow
@settings(max_examples=5, phases=(Phase.explicit, Phase.reuse, Phase.generate))
@given(phase=st.floats(0, 6.3), x=st.floats(-3, 3), angle=st.floats(-3, 3))
def test_transients_are_invariant_to_pose_and_phase_and_mirror_symmetric(
    phase, x, angle
):
    crawl, change = late(0.5, 2.5, sway=(0.002, 0.004), phase=phase)
    run = crawl.trajectory()
    fit = measured(crawl, change, run)
    elsewhere = measured(crawl, change, moved(run, x, 1.0, angle))
    assert astuple(elsewhere) == pytest.approx(astuple(fit), abs=1e-6)
    seen = measured(crawl, change, mirrored(run), seen=True)
    assert (seen.left, seen.right, seen.length) == pytest.approx(
        (fit.right, fit.left, fit.length), abs=1e-6
    )
    assert (seen.dx, seen.dy, seen.dheading) == pytest.approx(
        (fit.dx, -fit.dy, -fit.dheading), abs=1e-6
    )
    assert fit.dheading == pytest.approx((0.5 - 2.5) * crawl.speed * LATE, abs=5e-3)


def test_followers_get_the_delay_of_a_turn():
    crawl, change = late(0.5, 2.5)
    there = measured(crawl, change)
    back = replace(
        there, before=there.after, after=there.before, dheading=-there.dheading
    )
    box = Footprint.box(0.1, 0.0, speed=crawl.speed, curvature=1.0)
    assert box.response_length is None
    turns = {"offsets": (there.before, there.after), "curvatures": (0.5, 2.5)}
    assert replace(
        box, **turns, transients=(there, back)
    ).response_length == pytest.approx(crawl.speed * LATE, rel=0.05)


def test_an_unsettled_path_is_refused():
    crawl = Crawl((0.0, 2.0), (7.0,), duration=8.0)
    with pytest.raises(
        InputError,
        match="does not become steady within 8 gait periods after the change",
    ):
        measured(crawl, OffsetChange(4.0, -0.1, 0.1))
    with pytest.raises(InputError, match="at least 4 gait periods must precede"):
        measured(crawl, OffsetChange(1.0, -0.1, 0.1))


def test_repeats_of_a_change_are_combined_as_maxima():
    a = Transient(0, 0.3, 0.01, 0.0, 0.2, 0.1, 0.0, 3.1)
    b = Transient(0, 0.3, 0.0, 0.02, 0.1, 0.3, 0.2, -3.1)
    fit = combine_transients([a, b])
    assert astuple(fit)[:7] == pytest.approx((0, 0.3, 0.01, 0.02, 0.2, 0.2, 0.1))
    assert abs(fit.dheading) == pytest.approx(math.pi)


def twin(
    offset: float, *, phase: float = 0.0, timestep: float | None = None
) -> SteadyPath:
    spec = load_robot("gen2")
    more = {} if timestep is None else {"timestep": timestep}
    drive = GaitSetup(
        spec,
        2.0,
        spec.supply.nominal,
        plant=partial(TwinSnake, spec, tick=TICK, **more),
    )
    job = drive.steady_job(drive.plant_factory(), offset, phase, 3)
    run = rollout(job.plant(), job.controller(), job.duration, record_hz=RECORD_HZ)
    return steady_path(drive, run, 3)


@pytest.fixture(scope="module")
def turning() -> SteadyPath:
    return twin(0.3)


@pytest.mark.slow
def test_finer_time_steps_of_the_twin_give_the_same_footprint(turning):
    """Stick-slip transitions are not smooth, so only a tolerance is checked, not an order."""
    whole = TwinSnake(load_robot("gen2")).timestep
    half, quarter = (twin(0.3, timestep=whole / parts) for parts in (2, 4))
    for name, within in (
        ("speed", 0.005),
        ("curvature", 0.02),
        ("left", 0.01),
        ("right", 0.01),
    ):
        finest = getattr(quarter, name)
        assert [getattr(path, name) for path in (turning, half)] == pytest.approx(
            [finest] * 2, rel=within
        )


@pytest.mark.slow
def test_right_and_left_turns_of_the_twin_are_mirror_images(turning):
    other = twin(-0.3, phase=math.pi)
    assert other.speed == pytest.approx(turning.speed, rel=1e-4)
    assert other.curvature == pytest.approx(-turning.curvature, rel=1e-4)
    assert (other.left, other.right) == pytest.approx(
        (turning.right, turning.left), abs=1e-5
    )


def measure(
    robot,
    *,
    frequency,
    supply_pa=None,
    controller="gait",
    target=0.7,
    plant="twin",
    **more,
):
    run = {key: more.pop(key) for key in ("threads", "progress") if key in more}
    supply = robot.supply.nominal if supply_pa is None else supply_pa
    return footprint_study(
        GaitSetup(robot, frequency, supply, controller, target, plant), **more
    ).measure(**run)


def footprint_of(measured) -> Footprint:
    """Return the measurement as a footprint for the planner, without the rounding of a file."""
    keys = ("curvature", "speed", "left", "right", "ahead", "behind")
    columns = [tuple(getattr(path, key) for path in measured.steady) for key in keys]
    reach = max(columns[4]), max(columns[5])
    return Footprint(
        "measured", "", measured.offsets, *columns[:4], *reach, measured.transients
    )


@pytest.mark.slow
def test_a_full_measurement_is_valid_for_the_planner():
    done: list[int] = []
    fit = measure(
        load_robot("gen2"),
        frequency=2.0,
        plant="analytical",
        offsets=(-0.2, 0.0, 0.2),
        periods=3,
        phases=2,
        changes=[(-0.2, 0.2), (0.2, -0.2)],
        progress=lambda count, total: done.append(count),
    )
    body = validate_footprint(footprint_of(fit))
    assert body.offsets == (-0.2, 0.0, 0.2) and done == list(range(1, 11))
    # Two phases half a period apart are mirror images.
    assert body.curvatures[0] == pytest.approx(-body.curvatures[2], rel=1e-3)
    assert body.left[0] == pytest.approx(body.right[2], abs=1e-4)
    to_left, to_right = body.transients
    assert (to_left.left, to_left.right) == pytest.approx(
        (to_right.right, to_right.left), abs=1e-3
    )
    assert to_left.dheading < 0 < to_right.dheading and to_left.length > 0
    alone = measure(
        load_robot("gen2"),
        frequency=2.0,
        plant="analytical",
        offsets=(-0.2, 0.0, 0.2),
        periods=3,
        phases=2,
        changes=[],
        threads=1,
    )
    assert alone.steady == fit.steady


def test_default_changes_of_a_measurement():
    pairs = default_changes((-0.4, -0.2, -0.1, 0.0, 0.2, 0.4))
    assert set(pairs) == {
        (-0.4, 0.0),
        (-0.4, 0.4),
        (0.0, -0.4),
        (0.0, 0.4),
        (0.4, -0.4),
        (0.4, 0.0),
        (0.0, -0.2),
        (-0.2, 0.0),
        (0.0, 0.2),
        (0.2, 0.0),
    }
    assert set(default_changes((-0.3, -0.1, 0.3))) == {(-0.3, 0.3), (0.3, -0.3)}


GEN2 = load_robot("gen2")


@pytest.mark.default_cases(at=[0, 3, 6, 7, 9, 10, 12, 16, 18])
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"offsets": [0.0, 0.1, 0.2]}, "some below 0 and some above 0"),
        ({"offsets": [-0.1, 0.1]}, "a planner needs between 3 and 101 offsets"),
        ({"offsets": []}, r"offsets \(none\) are not allowed"),
        ({"offsets": [-0.1, 0.1, 0.1]}, "give each offset once, in ascending order"),
        ({"offsets": [-0.1, math.nan, 0.1]}, "gait offset nan is not allowed"),
        ({"offsets": [-1.0, 0.0, 0.1]}, "gait offset -1.0 is not allowed"),
        (
            {"controller": "ilc", "offsets": [-0.4, 0.0, 0.3]},
            "ilc offset -0.4 is not allowed",
        ),
        ({"controller": "itc"}, "unknown controller 'itc'; did you mean ilc?"),
        ({"plant": "twins"}, "unknown plant 'twins'; did you mean twin?"),
        ({"supply_pa": 600e3}, "the pressure 600 kPa is not allowed"),
        ({"supply_pa": math.nan}, "pressure nan kPa is not allowed"),
        ({"frequency": 0.0}, "frequency 0.0 Hz is not allowed"),
        ({"frequency": 5.0}, "it must be 4 Hz or less"),
        ({"controller": "ilc", "target": -1.0}, "ilc target -1.0 is not allowed"),
        ({"periods": 2}, "periods 2 is not allowed; it must be between 3 and 200"),
        ({"phases": 0}, "phases 0 is not allowed"),
        ({"changes": [(0.1, 0.1)]}, "a change from offset 0.1 to 0.1 is not allowed"),
        ({"changes": [(0.1, 0.15)]}, "a change from offset 0.1 to 0.15 is not allowed"),
        ({"threads": 0}, "`threads` 0 is not allowed"),
    ],
)
def test_invalid_studies_are_refused_before_any_run(changes, message):
    arguments = {"frequency": 2.0, "offsets": None, "plant": "analytical"} | changes
    with pytest.raises(InputError, match=message):
        measure(GEN2, **arguments)


def test_the_number_of_runs_is_predicted():
    drive = GaitSetup(GEN2, 2.0, GEN2.supply.nominal)
    assert footprint_study(drive, phases=3).runs == 3 * (9 + 10)
    assert (
        footprint_study(drive, offsets=(-0.1, 0, 0.2), changes=(), phases=1).runs == 3
    )


def test_steady_runs_start_at_equally_spaced_phases(monkeypatch):
    class Enough(Exception):
        pass

    begun = []

    def none(jobs, **_):
        begun.extend(job.controller().phase for job in jobs)
        raise Enough

    monkeypatch.setattr("srs_twin.identification.footprint.run_many", none)
    drive = GaitSetup(GEN2, 2.0, GEN2.supply.nominal)
    with pytest.raises(Enough):
        footprint_study(drive, offsets=(-0.1, 0, 0.2), changes=(), phases=4).measure()
    assert begun == pytest.approx([0, math.pi / 2, math.pi, 3 * math.pi / 2] * 3)
