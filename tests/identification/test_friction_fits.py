"""Friction fits to pull tests and coasting tests: Table 2, both plants, throws at any angle."""

from __future__ import annotations

import math

import numpy as np
import pytest
from laws.test_stopping import sliding_skid, sliding_wheel
from scipy import optimize, stats
from snakes import GRAVITY, robot, throw, vented

from srs_twin import AnalyticalSnake, Plant, PreloadedContact, Trajectory, TwinSnake
from srs_twin.errors import InputError
from srs_twin.identification.friction import (
    CoastingTest,
    Pulls,
    fit_coasting,
    fit_pulls,
    misalignment,
)
from srs_twin.identification.parameters import with_values
from srs_twin.plants.analytical.floor import slide, spin_fraction

SPEC = robot(stiffness=20.0)
MU_T = 0.06
MU_N = 0.5
SPRING = 120.0
MASS = 0.25


def pulls(mu_t, mu_n, **more) -> Pulls:
    lengths = [np.asarray(mu) * MASS * GRAVITY / SPRING for mu in (mu_t, mu_n)]
    return Pulls(*lengths, SPRING, MASS, **more)


def test_table_2_is_recovered():
    """Ten pulls per direction have the mean and standard deviation of the text."""
    shape = stats.zscore(np.random.default_rng(0).normal(size=10), ddof=1)
    fit = fit_pulls(pulls(0.0966 + 0.0015 * shape, 0.68 + 0.01 * shape))
    for name, mean, deviation in (
        ("friction.mu_t", 0.0966, 0.0015),
        ("friction.mu_n", 0.68, 0.01),
    ):
        parameter = fit[name]
        assert (
            parameter.value == pytest.approx(mean) and parameter.verdict == "identified"
        )
        assert parameter.standard_error == pytest.approx(deviation / math.sqrt(10))
        half = 2.262 * deviation / math.sqrt(10)
        assert parameter.low == pytest.approx(mean - half, rel=1e-4)
        assert parameter.high == pytest.approx(mean + half, rel=1e-4)
    assert fit.correlation[0, 1] == 0.0
    assert len(fit.residuals) == 2 and fit.samples == 20


def test_a_common_error_of_all_pulls_does_not_average_out():
    fit = fit_pulls(
        pulls([0.1, 0.1001] * 50, [0.6, 0.6001] * 50, stiffness_error=0.03 * SPRING)
    )
    assert fit["friction.mu_t"].standard_error == pytest.approx(
        0.03 * 0.10005, rel=1e-3
    )
    assert fit.correlation[0, 1] == pytest.approx(1.0, abs=1e-3)


def test_a_direction_without_pulls_is_not_identifiable():
    fit = fit_pulls(pulls([0.1, 0.11], []))
    assert (
        fit["friction.mu_n"].verdict == "not identifiable"
        and fit["friction.mu_n"].value is None
    )
    assert fit["friction.mu_n"].why == "there are no pulls across the body"
    assert fit["friction.mu_t"].value == pytest.approx(0.105)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"along": [0.1, -0.1]}, "deformations of at least 0 m"),
        (
            {"along": [0.1, math.nan]},
            "the pulls along the body are not allowed; they must be a list of",
        ),
        ({"mass": 0.0}, "mass 0.0 with error 0.0 is not allowed"),
        ({"stiffness_error": 200.0}, "larger than its error"),
    ],
)
def test_invalid_pulls_are_refused(values, message):
    with pytest.raises(InputError, match=message):
        Pulls(
            **(
                {
                    "along": [0.1, 0.1],
                    "across": [0.5, 0.5],
                    "stiffness": SPRING,
                    "mass": MASS,
                }
                | values
            )
        )


def thrown(
    velocity,
    *,
    noise=0.0,
    seed=0,
    friction_law="wheel",
    fraction=None,
    heading=0.3,
    seconds=1.0,
    mu=(MU_T, MU_N),
    bends=(0.0, 0.0, 0.0, 0.0),
) -> CoastingTest:
    """Return a coasting test that moves as a straight body, sampled at 100 Hz, with bends as recorded."""
    time = np.arange(0.0, seconds, 0.01)
    fraction = spin_fraction(SPEC) if fraction is None else fraction
    way = slide(
        velocity,
        time,
        friction_law=friction_law,
        mu_t=mu[0],
        mu_n=mu[1],
        fraction=fraction,
    )
    c = np.cos(heading)
    s = np.sin(heading)
    place = way @ np.array([[c, s], [-s, c]]) + [3.0, -2.0]
    place = place + noise * np.random.default_rng(seed).normal(size=place.shape)
    columns = {"time": time + 7.0, "com_x": place[:, 0], "com_y": place[:, 1]}
    columns |= {
        f"bend_{k}": np.full_like(time, bend) for k, bend in enumerate(bends, start=1)
    }
    return CoastingTest.from_trajectory(
        Trajectory(columns | {"heading": np.full_like(time, heading)}),
        f"throw_{seed}",
        start=7.0,
    )


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("degrees", [0, 20, 45, 80, 90])
def test_a_sliding_point_stops_at_the_distance_of_sharp_friction(degrees):
    """Reference: the independent integrators of the friction tests."""
    velocity = (math.cos(math.radians(degrees)), math.sin(math.radians(degrees)))
    mu_t = SPEC.friction.mu_t
    mu_n = SPEC.friction.mu_n
    late = np.array([0.0, 4.0])
    wheel = slide(
        velocity, late, friction_law="wheel", mu_t=mu_t, mu_n=mu_n, fraction=0.03
    )[-1]
    assert wheel == pytest.approx(sliding_wheel(velocity, 0.03), rel=0.005, abs=1e-4)
    skid = slide(velocity, late, friction_law="ellipse", mu_t=mu_t, mu_n=mu_n)[-1]
    assert skid == pytest.approx(sliding_skid(velocity), rel=0.005, abs=1e-3)


@pytest.mark.parametrize("friction_law", ["axis", "wheel", "ellipse"])
def test_throws_identify_both_coefficients(friction_law):
    fraction = 0.0 if friction_law == "ellipse" else None
    runs = [
        thrown(v, friction_law=friction_law, fraction=fraction, seed=k)
        for k, v in enumerate([(0.5, 0.0), (0.2, 0.8)])
    ]
    fit = fit_coasting(
        runs, SPEC, friction_law=friction_law, wheel_inertia=friction_law != "ellipse"
    )
    assert fit["friction.mu_t"].value == pytest.approx(MU_T, rel=1e-3)
    assert fit["friction.mu_n"].value == pytest.approx(MU_N, rel=1e-3)


def test_a_throw_along_the_body_does_not_identify_normal_friction():
    fit = fit_coasting([thrown((0.5, 0.0), noise=1e-3)], SPEC)
    assert fit["friction.mu_t"].verdict == "identified"
    assert fit["friction.mu_t"].value == pytest.approx(MU_T, rel=0.02)
    assert (
        fit["friction.mu_n"].verdict == "not identifiable"
        and fit["friction.mu_n"].value is None
    )
    fit = fit_coasting([thrown((0.0, 0.8), noise=1e-3)], SPEC)
    assert fit["friction.mu_t"].value is None
    assert fit["friction.mu_n"].value == pytest.approx(MU_N, rel=0.15)


def test_wheel_inertia_is_separated_from_friction():
    """Without the inertia of the wheels the estimated drag is too small by its effect."""
    run = thrown((0.5, 0.0))
    with_spin, without = (
        fit_coasting([run], SPEC, wheel_inertia=w).values["friction.mu_t"]
        for w in (True, False)
    )
    assert with_spin / without == pytest.approx(1 + spin_fraction(SPEC), rel=1e-6)


def test_validation_throws_do_not_influence_the_fit():
    runs = [thrown((0.5, 0.0)), thrown((0.0, 0.8), seed=1)]
    alone = fit_coasting(runs, SPEC)
    other = thrown((0.4, 0.2), seed=2, noise=1e-3)
    beside = fit_coasting(runs, SPEC, validation=[other])
    assert beside.parameters == alone.parameters
    assert beside.rms("validation") == pytest.approx(1.0, abs=0.15)
    rough = fit_coasting(
        runs, SPEC, validation=[thrown((0.4, 0.2), seed=2, mu=(0.12, 0.5))]
    )
    assert rough.rms("validation") > 2
    with pytest.raises(InputError, match="the same data as throw_0"):
        fit_coasting(runs, SPEC, validation=[runs[0]])


def coasting_record(
    plant: Plant, velocity: tuple[float, float], seconds: float
) -> Trajectory:
    """Record the coasting of a plant with an initial velocity."""
    throw(plant, velocity)
    states = [plant.step(vented(SPEC)) for _ in range(round(seconds / plant.tick))]
    com = np.array([state.com for state in states])
    time = plant.tick * np.arange(len(states))
    heading = np.array([state.heading for state in states])
    columns = {"time": time, "com_x": com[:, 0], "com_y": com[:, 1], "heading": heading}
    bends = np.array([state.bend for state in states])
    return Trajectory(
        columns | {f"bend_{k}": bend for k, bend in enumerate(bends.T, start=1)}
    )


def coasted(
    plant: Plant, velocity: tuple[float, float], seconds: float
) -> CoastingTest:
    """Return the coasting test of a plant with an initial velocity."""
    record = coasting_record(plant, velocity, seconds)
    return CoastingTest.from_trajectory(record, f"{plant.name} {velocity}", start=0.0)


@pytest.mark.parametrize(
    ("plant", "friction_law", "wheel_inertia"),
    [
        (AnalyticalSnake(SPEC, friction="wheel", tick=0.01), "wheel", False),
        (
            TwinSnake(SPEC, contact=PreloadedContact("rolling"), tick=0.01),
            "wheel",
            True,
        ),
        (
            TwinSnake(SPEC, contact=PreloadedContact("skid"), tick=0.01),
            "ellipse",
            False,
        ),
    ],
    ids=["analytical", "rolling", "skid"],
)
def test_coefficients_of_a_plant_are_recovered(plant, friction_law, wheel_inertia):
    runs = [coasted(plant, (0.5, 0.0), 1.0), coasted(plant, (0.0, 0.8), 0.4)]
    fit = fit_coasting(
        runs, SPEC, friction_law=friction_law, wheel_inertia=wheel_inertia
    )
    assert fit["friction.mu_t"].value == pytest.approx(SPEC.friction.mu_t, rel=0.01)
    # Contacts stop slip within 10 ms, so the friction tests allow 3 % of the distance.
    error = 0.01 if plant.name == "analytical" else 0.03
    assert fit["friction.mu_n"].value == pytest.approx(SPEC.friction.mu_n, rel=error)


def test_misalignment_is_the_smallest_mean_deviation_from_an_arc():
    """A uniform arc has no misalignment; the reference for a general body is a numerical search."""
    assert misalignment(np.full(4, 0.1), SPEC) == pytest.approx(0.0, abs=1e-15)
    # Headings 0, 0, 0.1, 0, 0: a straight line misses only the middle one of five equal
    # masses.
    assert misalignment(np.array([[0.0, 0.1, -0.1, 0.0]]), SPEC) == pytest.approx(
        [0.02]
    )
    rng = np.random.default_rng(3)
    one, two = rng.normal(size=(2, 4))
    together = misalignment(one + two, SPEC)
    assert 0 < together <= misalignment(one, SPEC) + misalignment(two, SPEC)
    headings = np.concatenate([[0.0], np.cumsum(one)])
    found = optimize.minimize(
        lambda line: np.abs(headings - line[0] - line[1] * np.arange(5)).mean(),
        [0.0, 0.0],
        method="Nelder-Mead",
        options={"xatol": 1e-10, "fatol": 1e-12, "maxiter": 4000},
    )
    assert misalignment(one, SPEC) == pytest.approx(found.fun, rel=1e-6)


SIGNS = (1, -1, 1, 1)


@pytest.fixture(scope="module")
def bent_throws() -> list[Trajectory]:
    """Throws of a twin with rest bends of 0.02 rad, along and across, without noise."""
    bends = {
        f"modules.bias_rad_{k}": 0.02 * sign for k, sign in enumerate(SIGNS, start=1)
    }
    spec = with_values(robot(), bends | {"friction.mu_t": MU_T, "friction.mu_n": MU_N})
    return [
        coasting_record(TwinSnake(spec, tick=0.01), v, 0.8)
        for v in ((0.5, 0.0), (0.0, 0.8))
    ]


def test_recorded_bends_give_the_coefficients_of_a_bent_body(bent_throws):
    runs = [
        CoastingTest.from_trajectory(throw, str(k), start=0.0)
        for k, throw in enumerate(bent_throws)
    ]
    fit = fit_coasting(runs, robot())
    assert fit["friction.mu_t"].value == pytest.approx(MU_T, rel=0.015)
    assert fit["friction.mu_t"].verdict == "identified"
    assert fit["friction.mu_n"].value == pytest.approx(MU_N, rel=0.015)


def test_unrecorded_bends_are_not_ignored(bent_throws):
    runs = []
    for k, record in enumerate(bent_throws):
        columns = {
            name: record[name]
            for name in record.columns
            if not name.startswith("bend_")
        }
        runs.append(
            CoastingTest.from_trajectory(Trajectory(columns), str(k), start=0.0)
        )
    found = fit_coasting(runs, robot())["friction.mu_t"]
    # Without the bends, the slip that they cause counts as friction along the wheels.
    slip = math.sqrt(MU_N**2 - MU_T**2) * misalignment(0.02 * np.array(SIGNS), SPEC)
    assert slip > 0.05 * MU_T
    assert found.value == pytest.approx(MU_T + slip, rel=0.01)
    assert found.low < MU_T < found.high
    assert (found.verdict, found.why) == (
        "weakly identified",
        "its 95 % interval exceeds ±10 %",
    )


def test_bends_of_a_body_without_sideways_throws_use_the_known_normal_friction():
    bends = (0.01, -0.01, 0.01, -0.01)
    fit = fit_coasting([thrown((0.5, 0.0), noise=1e-3, bends=bends)], SPEC)
    assert fit["friction.mu_n"].verdict == "not identifiable"
    slip = math.sqrt(SPEC.friction.mu_n**2 - MU_T**2) * misalignment(
        np.array(bends), SPEC
    )
    assert fit["friction.mu_t"].value == pytest.approx(MU_T - slip, rel=0.01)


def test_unsuitable_throws_are_refused():
    time = np.arange(0.0, 1.0, 0.01)
    still = {"time": time, "com_x": 0 * time, "com_y": 0 * time, "heading": 0 * time}
    with pytest.raises(
        InputError, match="the maximum speed is only 0 m/s, but at least"
    ):
        CoastingTest.from_trajectory(Trajectory(still), "x")
    with pytest.raises(InputError, match="the robot turns by"):
        CoastingTest.from_trajectory(
            Trajectory(still | {"com_x": 0.3 * time, "heading": time}), "x", start=0.0
        )
    with pytest.raises(
        InputError, match="x: the recording has 4 samples; 8 or more are needed"
    ):
        CoastingTest.from_trajectory(
            Trajectory({name: column[:4] for name, column in still.items()}), "x"
        )
    with pytest.raises(InputError, match="2 samples after the push"):
        CoastingTest.from_trajectory(Trajectory(still), "x", start=0.98)
    with pytest.raises(InputError, match="friction law 'viscous' is not allowed here"):
        fit_coasting([thrown((0.5, 0.0))], SPEC, friction_law="viscous")
    with pytest.raises(InputError, match="give at least one"):
        fit_coasting([], SPEC)
