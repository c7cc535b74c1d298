"""Measured footprints: prescribed paths are recovered, real ones hold against mirror and refinement."""

from __future__ import annotations

import cmath
import math
from dataclasses import astuple, replace
from functools import partial

import numpy as np
import pytest
from crawling import Crawl
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from synthetic import mirrored, moved

from srs_twin import InputError, Trajectory, TwinSnake, load_robot, rollout
from srs_twin.comparison.gait import GaitWindow
from srs_twin.comparison.learning import PathFit, box_edges
from srs_twin.identification.footprint import (
    RECORD_HZ,
    TICK,
    Drive,
    changes_between,
    steady_path,
    study,
)
from srs_twin.identification.paths import SETTLED, Change, Poses, SteadyPath, mean_path, transient, widest
from srs_twin.planning.footprint import Footprint, Transient, validate_footprint

PERIODS = 6


def steady(crawl: Crawl, run: Trajectory | None = None) -> SteadyPath:
    run = crawl.trajectory() if run is None else run
    window = GaitWindow.last(run, crawl.period, float(run.time[-1]), PERIODS)
    assert window is not None
    return SteadyPath.of(run, crawl.geometry, window)


def edges_of_a_bar(crawl: Crawl, curvature: float) -> tuple[float, float, float, float]:
    """Return left, right, ahead and behind of a swaying bar that touches its circle in the middle.

    Its ends are round: half discs beyond its middle line.
    """
    half, half_length = crawl.geometry.width / 2, crawl.geometry.body_length / 2
    ahead, aside = crawl.sway
    if curvature == 0:
        return half + aside, half + aside, half_length + half + ahead, half_length + half + ahead
    radius = 1 / abs(curvature)
    inner, outer = half + aside, math.hypot(half_length, radius + half + aside) - radius
    corner = math.atan2(half_length, radius - half)
    disc = math.atan2(half_length, radius) + math.asin(half / math.hypot(half_length, radius))
    reach = radius * max(corner, disc)
    return (inner, outer, reach, reach) if curvature > 0 else (outer, inner, reach, reach)


@pytest.mark.parametrize("curvature", [-4.0, -0.3, 0.0, 1e-5, 0.3, 4.0])
@pytest.mark.parametrize("aside", [0.0, 0.006])
def test_speed_curvature_and_edges_of_a_bar_on_a_circle(curvature, aside):
    crawl = Crawl((curvature,), sway=(0.0, aside))
    found = steady(crawl)
    left, right, ahead, behind = edges_of_a_bar(crawl, curvature)
    assert found.speed == pytest.approx(0.15, rel=1e-3)
    assert found.curvature == pytest.approx(curvature, rel=1e-3, abs=1e-5)
    # At the ends the bar is farthest out when it sways out, and at its widest inside where it touches.
    assert (found.left, found.right) == pytest.approx((left, right), abs=1e-4)
    if not aside:
        assert (found.ahead, found.behind) == pytest.approx((ahead, behind), abs=1e-4)


@pytest.mark.slow
@settings(max_examples=15)
@given(
    curvature=st.floats(-5, 5), speed=st.floats(0.05, 0.3), phase=st.floats(0, 6.3),
    x=st.floats(-3, 3), angle=st.floats(-3, 3),
)  # fmt: skip
def test_the_same_wherever_it_lies_whatever_the_phase_and_in_a_mirror(curvature, speed, phase, x, angle):
    crawl = Crawl((curvature,), speed=speed, sway=(0.003, 0.005), phase=phase)
    run = crawl.trajectory()
    found, elsewhere, seen = (steady(crawl, r) for r in (run, moved(run, x, 1.0, angle), mirrored(run)))
    assert found.speed == pytest.approx(speed, rel=5e-3)
    assert found.curvature == pytest.approx(curvature, rel=5e-3, abs=1e-3)
    assert astuple(elsewhere) == pytest.approx(astuple(found), abs=1e-7)
    swapped = (found.speed, -found.curvature, found.right, found.left, found.ahead, found.behind)
    assert astuple(seen) == pytest.approx(swapped, abs=1e-7)


def test_the_edges_are_those_of_the_metrics_where_the_body_is_straight():
    """`box_edges` looks at connectors and fits a circle; between them a straight body does not bulge."""
    crawl = Crawl((2.0,), sway=(0.002, 0.005))
    run = crawl.trajectory()
    run.metadata["body_width_m"] = crawl.geometry.width
    window = GaitWindow.last(run, crawl.period, float(run.time[-1]), PERIODS)
    fit = PathFit.of(run, window)
    left, right = box_edges(run, window, fit)
    found = steady(crawl)
    assert (-left, right) == pytest.approx((found.left, found.right), abs=2e-4)


def test_a_snake_that_gets_nowhere_or_backward_has_no_footprint():
    with pytest.raises(InputError, match="mm ahead in a gait period"):
        steady(Crawl(speed=0.0, sway=(0.003, 0.005)))
    with pytest.raises(InputError, match="the snake goes -75 mm ahead"):
        steady(Crawl(speed=-0.15))


def test_repeats_are_put_together_as_means_and_farthest_edges():
    a, b = SteadyPath(0.1, 1.0, 0.03, 0.04, 0.1, 0.2), SteadyPath(0.2, 2.0, 0.05, 0.02, 0.3, 0.1)
    path, spread = mean_path([a, b])
    assert astuple(path) == pytest.approx((0.15, 1.5, 0.05, 0.04, 0.3, 0.2))
    assert astuple(spread) == pytest.approx((0.05, 0.5, 0.01, 0.01, 0.1, 0.05))


@given(
    curvature=st.floats(-5, 5), length=st.floats(-0.3, 0.3), u=st.floats(-0.15, 0.15), w=st.floats(-0.1, 0.1),
    heading=st.floats(-3, 3),
)  # fmt: skip
def test_motions_along_arcs_and_coordinates_about_them(curvature, length, u, w, heading):
    here = Poses(np.array([0.3 - 0.2j]), np.array([heading]))
    there = here.then(Poses.arc(curvature, length))
    back = there.then(Poses.arc(curvature, -length))
    assert back.place == pytest.approx(here.place) and back.heading == pytest.approx(here.heading)
    nothing = there.inverse().then(there)
    assert abs(nothing.place[0]) < 1e-12 and abs(nothing.heading[0]) < 1e-12
    # From the centre of the circle the pose and the point are seen at their radii and angle.
    point = here.place[0] + (u + 1j * w) * cmath.exp(1j * heading)
    along, left = (each[0, 0] for each in here.coordinates(np.array([[[point.real, point.imag]]]), curvature))
    if abs(curvature) < 1e-6:
        assert (along, left) == pytest.approx((u, w), abs=1e-6)
        return
    centre = here.place[0] + 1j / curvature * cmath.exp(1j * heading)
    sign, radius = math.copysign(1, curvature), 1 / abs(curvature)
    assert left == pytest.approx(sign * (radius - abs(point - centre)), abs=1e-9)
    angle = cmath.phase((point - centre) / (here.place[0] - centre))
    assert along == pytest.approx(sign * radius * angle, abs=1e-6)


LATE = 0.604  # s, between the command and the turn; no whole number of samples


def late(before: float, after: float, **settings: object) -> tuple[Crawl, Change]:
    """Return a snake that obeys a change of offset only after a while, then at once."""
    crawl = Crawl((before, after), (4.0 + LATE,), duration=8.0, **settings)  # type: ignore[arg-type]
    return crawl, Change(4.0, -0.1, 0.1)


def measured(crawl: Crawl, change: Change, run: Trajectory | None = None, *, seen: bool = False) -> Transient:
    paths = []
    for curvature in crawl.curvatures:
        alone = Crawl((curvature,), speed=crawl.speed, sway=crawl.sway)
        paths.append(steady(alone, mirrored(alone.trajectory()) if seen else None))
    run = crawl.trajectory() if run is None else run
    return transient(run, crawl.geometry, crawl.period, change, (paths[0], paths[1]))


@pytest.mark.parametrize(("before", "after"), [(-3.0, 3.0), (0.0, 2.0), (2.0, 0.0), (1.0, -1.0)])
def test_a_turn_that_comes_late_is_recovered(before, after):
    crawl, change = late(before, after)
    found, way = measured(crawl, change), crawl.speed * LATE
    # Along the old arc for the way that is late, and back along the new one.
    place, heading = 0j, 0.0
    for curvature, length in ((before, way), (after, -way)):
        steps = np.exp(1j * (heading + curvature * length * (np.arange(20_000) + 0.5) / 20_000))
        place, heading = place + length * steps.mean(), heading + curvature * length
    assert found.dheading == pytest.approx(heading, abs=2e-3)
    assert (found.dx, found.dy) == pytest.approx((place.real, place.imag), abs=1e-3)
    assert found.length == pytest.approx(
        way - SETTLED * crawl.speed * crawl.period, abs=2 * crawl.speed / 100
    )

    # How far the bar reaches out of the circles about the two centres that the new arc should have had.
    time = np.arange(801) / 100
    places, headings = crawl.path(time)
    begin, direction = places[400], cmath.exp(1j * headings[400])
    bar = crawl.geometry.body_length * np.linspace(-0.5, 0.5, 201)
    sides = np.concatenate([bar + 0.5j * crawl.geometry.width, bar - 0.5j * crawl.geometry.width])
    upto = 400 + round(100 * found.length / crawl.speed)
    points = places[400 : upto + 1, None] + sides * np.exp(1j * headings[400 : upto + 1])[:, None]

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
    assert (found.left, found.right) == pytest.approx((max(left, 0), max(right, 0)), abs=2e-3)


def test_a_change_at_once_costs_nothing():
    crawl = Crawl((-2.0, 2.0), (4.0,), duration=8.0)
    found = measured(crawl, Change(4.0, -0.1, 0.1))
    assert (found.dx, found.dy, found.dheading) == pytest.approx((0, 0, 0), abs=2e-3)
    assert found.length < 0.02
    # A bar on two arcs at once is on neither; what sticks out is less than its width.
    assert max(found.left, found.right) < crawl.geometry.width


@pytest.mark.slow
@settings(max_examples=5, phases=(Phase.explicit, Phase.reuse, Phase.generate))
@given(phase=st.floats(0, 6.3), x=st.floats(-3, 3), angle=st.floats(-3, 3))
def test_transients_do_not_depend_on_place_or_phase_and_are_mirrored(phase, x, angle):
    crawl, change = late(0.5, 2.5, sway=(0.002, 0.004), phase=phase)
    run = crawl.trajectory()
    found, elsewhere = measured(crawl, change, run), measured(crawl, change, moved(run, x, 1.0, angle))
    assert astuple(elsewhere) == pytest.approx(astuple(found), abs=1e-6)
    seen = measured(crawl, change, mirrored(run), seen=True)
    assert (seen.left, seen.right, seen.length) == pytest.approx(
        (found.right, found.left, found.length), abs=1e-6
    )
    assert (seen.dx, seen.dy, seen.dheading) == pytest.approx(
        (found.dx, -found.dy, -found.dheading), abs=1e-6
    )
    assert found.dheading == pytest.approx((0.5 - 2.5) * crawl.speed * LATE, abs=5e-3)


def test_followers_get_how_late_a_path_turns():
    crawl, change = late(0.5, 2.5)
    there = measured(crawl, change)
    back = replace(there, before=there.after, after=there.before, dheading=-there.dheading)
    box = Footprint.box(0.1, 0.0, speed=crawl.speed, curvature=1.0)
    assert box.settle is None
    turns = {"offsets": (there.before, there.after), "curvatures": (0.5, 2.5)}
    assert replace(box, **turns, transients=(there, back)).settle == pytest.approx(
        crawl.speed * LATE, rel=0.05
    )


def test_a_path_that_does_not_settle_is_refused():
    crawl = Crawl((0.0, 2.0), (7.0,), duration=8.0)
    with pytest.raises(InputError, match="not settled 8 gait periods after it"):
        measured(crawl, Change(4.0, -0.1, 0.1))
    with pytest.raises(InputError, match="needs 4 gait periods before it"):
        measured(crawl, Change(1.0, -0.1, 0.1))


def test_repeats_of_a_change_count_at_their_widest_and_longest():
    a = Transient(0, 0.3, 0.01, 0.0, 0.2, 0.1, 0.0, 3.1)
    b = Transient(0, 0.3, 0.0, 0.02, 0.1, 0.3, 0.2, -3.1)
    found = widest([a, b])
    assert astuple(found)[:7] == pytest.approx((0, 0.3, 0.01, 0.02, 0.2, 0.2, 0.1))
    assert abs(found.dheading) == pytest.approx(math.pi)


def twin(offset: float, *, phase: float = 0.0, timestep: float | None = None) -> SteadyPath:
    spec = load_robot("gen2")
    more = {} if timestep is None else {"timestep": timestep}
    drive = Drive(spec, 2.0, spec.supply.nominal, plant=partial(TwinSnake, spec, tick=TICK, **more))
    job = drive.steady_job(drive.plant_maker(), offset, phase, 3)
    run = rollout(job.plant(), job.controller(), job.duration, record_hz=RECORD_HZ)
    return steady_path(drive, run, 3)


@pytest.fixture(scope="module")
def turning() -> SteadyPath:
    return twin(0.3)


@pytest.mark.slow
def test_finer_time_steps_of_the_twin_give_the_same_footprint(turning):
    """Within this; sticking begins and ends at kinks, so that no order can be asked for."""
    whole = TwinSnake(load_robot("gen2")).timestep
    half, quarter = (twin(0.3, timestep=whole / parts) for parts in (2, 4))
    for name, within in (("speed", 0.005), ("curvature", 0.02), ("left", 0.01), ("right", 0.01)):
        finest = getattr(quarter, name)
        assert [getattr(each, name) for each in (turning, half)] == pytest.approx([finest] * 2, rel=within)


def test_the_twin_turns_right_as_it_turns_left(turning):
    other = twin(-0.3, phase=math.pi)
    assert other.speed == pytest.approx(turning.speed, rel=1e-4)
    assert other.curvature == pytest.approx(-turning.curvature, rel=1e-4)
    assert (other.left, other.right) == pytest.approx((turning.right, turning.left), abs=1e-5)


def measure(robot, *, frequency, supply_pa=None, controller="gait", target=0.7, plant="twin", **more):
    run = {key: more.pop(key) for key in ("threads", "progress") if key in more}
    supply = robot.supply.nominal if supply_pa is None else supply_pa
    return study(Drive(robot, frequency, supply, controller, target, plant), **more).measure(**run)


def footprint_of(measured) -> Footprint:
    """Return what was measured as the planner takes it, without the rounding of a file."""
    keys = ("curvature", "speed", "left", "right", "ahead", "behind")
    columns = [tuple(getattr(path, key) for path in measured.steady) for key in keys]
    reach = max(columns[4]), max(columns[5])
    return Footprint("measured", "", measured.offsets, *columns[:4], *reach, measured.transients)


@pytest.mark.slow
def test_a_whole_footprint_is_one_for_the_planner():
    done: list[int] = []
    found = measure(
        load_robot("gen2"), frequency=2.0, plant="analytical", offsets=(-0.2, 0.0, 0.2), periods=3, phases=2,
        changes=[(-0.2, 0.2), (0.2, -0.2)], progress=done.append,
    )  # fmt: skip
    body = validate_footprint(footprint_of(found))
    assert body.offsets == (-0.2, 0.0, 0.2) and done == list(range(1, 11))
    # Two phases half a period apart: a snake and its mirror image.
    assert body.curvatures[0] == pytest.approx(-body.curvatures[2], rel=1e-3)
    assert body.left[0] == pytest.approx(body.right[2], abs=1e-4)
    to_left, to_right = body.transients
    assert (to_left.left, to_left.right) == pytest.approx((to_right.right, to_right.left), abs=1e-3)
    assert to_left.dheading < 0 < to_right.dheading and to_left.length > 0
    alone = measure(
        load_robot("gen2"), frequency=2.0, plant="analytical", offsets=(-0.2, 0.0, 0.2), periods=3, phases=2,
        changes=[], threads=1,
    )  # fmt: skip
    assert alone.steady == found.steady


def test_which_changes_are_measured():
    pairs = changes_between((-0.4, -0.2, -0.1, 0.0, 0.2, 0.4))
    assert set(pairs) == {
        (-0.4, 0.0), (-0.4, 0.4), (0.0, -0.4), (0.0, 0.4), (0.4, -0.4), (0.4, 0.0),
        (0.0, -0.2), (-0.2, 0.0), (0.0, 0.2), (0.2, 0.0),
    }  # fmt: skip
    assert set(changes_between((-0.3, -0.1, 0.3))) == {(-0.3, 0.3), (0.3, -0.3)}


GEN2 = load_robot("gen2")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"offsets": [0.0, 0.1, 0.2]}, "on both sides of 0"),
        ({"offsets": [-0.1, 0.1]}, "a planner needs 3 to 101"),
        ({"offsets": []}, r"offsets \(none\) are not allowed"),
        ({"offsets": [-0.1, 0.1, 0.1]}, "each must be there once, rising"),
        ({"offsets": [-0.1, math.nan, 0.1]}, "gait offset nan is not allowed"),
        ({"offsets": [-1.0, 0.0, 0.1]}, "gait offset -1.0 is not allowed"),
        ({"controller": "ilc", "offsets": [-0.4, 0.0, 0.3]}, "ilc offset -0.4 is not allowed"),
        ({"controller": "itc"}, "unknown controller 'itc'; did you mean ilc?"),
        ({"plant": "twins"}, "unknown plant 'twins'; did you mean twin?"),
        ({"supply_pa": 600e3}, "pressure 600 kPa is above the"),
        ({"supply_pa": math.nan}, "pressure nan kPa is not allowed"),
        ({"frequency": 0.0}, "frequency 0 Hz is not allowed"),
        ({"frequency": 5.0}, "4 Hz is the most"),
        ({"controller": "ilc", "target": -1.0}, "ilc target -1.0 is not allowed"),
        ({"periods": 2}, "periods 2 is not allowed; it must be from 3 to 200"),
        ({"phases": 0}, "phases 0 is not allowed"),
        ({"changes": [(0.1, 0.1)]}, "a change from offset 0.1 to 0.1 is none"),
        ({"changes": [(0.1, 0.15)]}, "a change from offset 0.1 to 0.15 is none"),
        ({"threads": 0}, "threads: 0 is not allowed"),
    ],
)
def test_what_cannot_be_measured_is_refused_before_anything_runs(changes, words):
    arguments = {"frequency": 2.0, "offsets": None, "plant": "analytical"} | changes
    with pytest.raises(InputError, match=words):
        measure(GEN2, **arguments)


def test_the_number_of_runs_is_known():
    drive = Drive(GEN2, 2.0, GEN2.supply.nominal)
    assert study(drive, phases=3).runs == 3 * (9 + 10)
    assert study(drive, offsets=(-0.1, 0, 0.2), changes=(), phases=1).runs == 3


def test_steady_runs_begin_at_equally_spaced_phases(monkeypatch):
    class Enough(Exception):
        pass

    begun = []

    def none(jobs, **_):
        begun.extend(job.controller().phase for job in jobs)
        raise Enough

    monkeypatch.setattr("srs_twin.identification.footprint.run_many", none)
    drive = Drive(GEN2, 2.0, GEN2.supply.nominal)
    with pytest.raises(Enough):
        study(drive, offsets=(-0.1, 0, 0.2), changes=(), phases=4).measure()
    assert begun == pytest.approx([0, math.pi / 2, math.pi, 3 * math.pi / 2] * 3)
