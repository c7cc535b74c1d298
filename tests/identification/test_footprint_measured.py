"""Measured footprints: prescribed paths are recovered; symmetry and convergence of simulated ones."""

from __future__ import annotations

import cmath
import math
from dataclasses import astuple

import numpy as np
import pytest
from crawling import Crawl
from hypothesis import given, strategies as st
from synthetic import moved

from srs_twin import InputError, Trajectory, load_robot
from srs_twin.comparison.gait import GaitWindow
from srs_twin.identification.footprint import (
    GaitSetup,
    default_changes,
    footprint_study,
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
from srs_twin.planning.footprint import Transient

PERIODS = 6


def elsewhere(crawl: Crawl) -> Trajectory:
    """Return the run of a snake that starts at another place in another direction."""
    return moved(crawl.trajectory(), 1.0, -2.0, 0.8)


def steady(crawl: Crawl) -> SteadyPath:
    run = elsewhere(crawl)
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


CHANGE = OffsetChange(4.0, -0.1, 0.1)


def late(before: float, after: float) -> Crawl:
    """Return a snake that follows a change of offset after a delay, then at once."""
    return Crawl((before, after), (4.0 + LATE,), duration=8.0)


def measured(crawl: Crawl, change: OffsetChange) -> Transient:
    before, after = (steady(Crawl((curvature,))) for curvature in crawl.curvatures)
    return measure_transient(
        elsewhere(crawl), crawl.geometry, crawl.period, change, (before, after)
    )


@pytest.mark.parametrize(("before", "after"), [(-3.0, 3.0), (0.0, 2.0), (2.0, 0.0)])
def test_a_delayed_turn_is_recovered(before, after):
    crawl = late(before, after)
    fit = measured(crawl, CHANGE)
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
    fit = measured(crawl, CHANGE)
    assert (fit.dx, fit.dy, fit.dheading) == pytest.approx((0, 0, 0), abs=2e-3)
    assert fit.length < 0.02
    # A bar across two arcs lies on neither; the excess is less than its width.
    assert max(fit.left, fit.right) < crawl.geometry.width


def test_an_unsettled_path_is_refused():
    crawl = Crawl((0.0, 2.0), (7.0,), duration=8.0)
    with pytest.raises(
        InputError,
        match="does not become steady within 8 gait periods after the change",
    ):
        measured(crawl, CHANGE)
    with pytest.raises(InputError, match="at least 4 gait periods must precede"):
        measured(crawl, OffsetChange(1.0, -0.1, 0.1))


def test_repeats_of_a_change_are_combined_as_maxima():
    a = Transient(0, 0.3, 0.01, 0.0, 0.2, 0.1, 0.0, 3.1)
    b = Transient(0, 0.3, 0.0, 0.02, 0.1, 0.3, 0.2, -3.1)
    fit = combine_transients([a, b])
    assert astuple(fit)[:7] == pytest.approx((0, 0.3, 0.01, 0.02, 0.2, 0.2, 0.1))
    assert abs(fit.dheading) == pytest.approx(math.pi)


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


DRIVE = GaitSetup(load_robot("gen2"), 2.0, 48e3)
OFFSETS = (-0.1, 0, 0.2)


@pytest.mark.parametrize("change", [(0.2, 0.2), (0, 0.15)])
def test_invalid_changes_of_offset_are_refused(change):
    with pytest.raises(InputError, match="a change from offset .* is not allowed"):
        footprint_study(DRIVE, offsets=OFFSETS, changes=[change])


def test_the_number_of_runs_is_predicted():
    assert footprint_study(DRIVE, phases=3).runs == 3 * (9 + 10)
    assert footprint_study(DRIVE, offsets=OFFSETS, changes=(), phases=1).runs == 3
    learning = GaitSetup(load_robot("gen4"), 2.0, 131e3, "ilc")
    assert footprint_study(learning, changes=(), phases=1).runs == 7
    # Sixteen periods of 0.5 s to settle, and twelve for the transient.
    start = learning.change_time(0.0)
    job = learning.change_job(learning.plant_factory(), (0.1, 0.2), start, 4)
    assert job.duration == pytest.approx(8.0 + 6.0 + 2.0)


def test_each_run_is_measured_for_its_offset_or_change(monkeypatch):
    """Prescribed paths replace the simulations of each offset and of one change."""
    curvatures = (-2.0, 0.5, 3.0)
    changes = (4.0, 4.13, 4.25, 4.38)  # at quarters of a period, in whole samples
    jobs = []

    def runs(asked, *, progress, **_):
        jobs.extend(asked)
        steady = [Crawl((curvatures[k // 4],), duration=7.0) for k in range(12)]
        turns = [Crawl((0.5, 3.0), (t + LATE,), duration=9.5) for t in changes]
        for k, crawl in enumerate([*steady, *turns], start=1):
            progress(k)
            yield elsewhere(crawl)

    monkeypatch.setattr("srs_twin.identification.footprint.run_many", runs)
    study = footprint_study(DRIVE, offsets=OFFSETS, changes=[(0, 0.2)], phases=4)
    counts = []
    found = study.measure(progress=lambda *count: counts.append(count))
    assert counts == [(k, 16) for k in range(1, 17)]
    phases = [job.controller().phase for job in jobs[:12]]
    assert phases == pytest.approx([0, math.pi / 2, math.pi, 3 * math.pi / 2] * 3)
    # Eight gait periods of 0.5 s to settle, six to measure; the transient takes at
    # most six, and four follow.
    assert [job.duration for job in jobs] == pytest.approx(
        [7.0] * 12 + [time + 5.0 for time in changes]
    )
    assert [path.curvature for path in found.steady] == pytest.approx(
        curvatures, rel=1e-3
    )
    (change,) = found.transients
    assert (change.before, change.after) == (0, 0.2)
    assert change.dheading == pytest.approx(-2.5 * 0.15 * LATE, abs=2e-3)
