"""Analytical models compared with each other and with their limits; gap factor of the dissertation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from smooth import Wave
from snakes import chain, robot
from synthetic import Snake, with_metadata

from srs_twin import (
    AnalyticalSnake,
    Gait,
    InputError,
    RobotSpec,
    rollout,
)
from srs_twin.comparison.compare import compare
from srs_twin.errors import InputFileError
from srs_twin.experiment import run_scenario
from srs_twin.plants.base import SnakeState
from srs_twin.robot.friction import FRICTION_LAWS
from srs_twin.scenario.loading import parse_scenario

MASSES = (0.03, 0.05, 0.02, 0.04, 0.1)
SMOOTH = {"mu_t": 1.0, "mu_n": 15.0}  # for the viscous law
SUPPLY = 48.3e3


def bent(plant: AnalyticalSnake, duration: float = 1.0, hz: float = 500) -> SnakeState:
    """Return the motion of a plant with smooth chambers."""
    plant.reset()
    schedule = plant.pneumatics.schedule(
        np.full((plant.spec.segments, 2), -1), duration
    )
    return plant.play(schedule, round(duration * hz))


def rms(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).mean()))


def ladder(
    amplitude: float, friction_law: str, mu: dict[str, float]
) -> tuple[float, float]:
    """Return the relative differences of path and torques between `simplified` and `complete`."""
    spec = robot(**mu)
    complete, simplified = (
        bent(
            AnalyticalSnake(
                spec,
                model=model,
                friction=friction_law,
                timestep=5e-4,
                slip_speed=0.02,
                pneumatics=Wave(spec, amplitude=amplitude, bias=amplitude / 4),
            )
        )
        for model in ("complete", "simplified")
    )
    path = np.abs(simplified.com - complete.com).max() / np.abs(complete.com).max()
    return path, rms(simplified.torque - complete.torque) / rms(complete.torque)


def test_simplified_equals_complete_to_second_order_in_the_bends():
    """Chords shorten by q²: half the bends have a quarter of the relative difference."""
    actual = np.array([ladder(a, "viscous", SMOOTH) for a in (0.2, 0.1, 0.05)])
    order = np.log2(actual[:-1] / actual[1:])
    assert order == pytest.approx(np.full((2, 2), 2.0), abs=0.1)
    assert actual[-1, 0] < 1e-4
    # Bends of a radian are another matter: that is why the dissertation has a complete
    # model.
    assert ladder(0.8, "viscous", SMOOTH)[0] > 0.02


def phase(
    spec: RobotSpec, wave: Wave, times: np.ndarray, *, frozen: bool, inertia: np.ndarray
) -> np.ndarray:
    """Return the mean heading of a body that bends without external moment, θ̇ = −h/I, by SciPy.

    Positions are sums of chords from the tail, their rates come from complex steps in
    time; nothing is from the package.
    """
    mass = spec.mass.array()

    def place(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        heading = np.append(np.cumsum(q[::-1])[::-1], 0.0)  # over the tail's
        heading = heading - heading.mean()
        chord = spec.geometry.segment_length * np.sin(q / 2) / (
            q / 2
        ) + spec.geometry.rigid_gap * np.cos(q / 2)
        if frozen:
            chord = np.full(len(q), spec.geometry.pitch) + 0 * q
        mean = (heading[1:] + heading[:-1]) / 2
        x, y = (
            np.append(np.cumsum((chord * f(mean))[::-1])[::-1], 0.0)
            for f in (np.cos, np.sin)
        )
        return np.array([x - mass @ x / mass.sum(), y - mass @ y / mass.sum()]), heading

    def turning(t: float, _: np.ndarray) -> float:
        q, dq, _ = (values[0] for values in wave.free(np.array([t])))
        (x, y), heading = place(q + 1e-20j * dq)
        h = mass @ (x.real * y.imag - y.real * x.imag) + inertia @ heading.imag
        return -h / 1e-20 / (mass @ (x.real**2 + y.real**2) + inertia.sum())

    start = 1e-3  # a bend of 1e-10 rad, but none of zero
    return solve_ivp(
        turning, (start, times[-1]), [0.0], t_eval=times, rtol=1e-10, atol=1e-12
    ).y[0]


@pytest.mark.slow
@pytest.mark.parametrize("friction_law", FRICTION_LAWS)
def test_without_friction_torque_the_heading_drifts_by_the_geometric_phase(
    friction_law,
):
    """The floor moves the centre of mass only; the bends alone rotate the body."""
    spec = chain(MASSES)
    wave = Wave(spec, bias=0.3)
    plant = AnalyticalSnake(
        spec,
        model="simplified",
        friction_torque=False,
        friction=friction_law,
        timestep=5e-4,
        pneumatics=wave,
    )
    h = bent(plant, 2.0)
    expected = phase(spec, wave, h.time, frozen=True, inertia=np.zeros(5))
    assert h.heading == pytest.approx(expected, abs=2e-6)
    assert np.abs(h.heading).max() > 0.05
    # Its moment of momentum, from places, stays zero.
    arm = h.position - h.com[:, None]
    velocity = np.gradient(h.position, h.time, axis=0)
    terms = spec.mass.array() * (
        arm[..., 0] * velocity[..., 1] - arm[..., 1] * velocity[..., 0]
    )
    assert (
        np.abs(terms.sum(axis=1)[1:-1]).max() < 2e-3 * np.abs(terms).sum(axis=1).max()
    )
    turned = AnalyticalSnake(
        spec, model="simplified", friction=friction_law, timestep=5e-4, pneumatics=wave
    )
    assert np.abs(bent(turned, 2.0).heading - h.heading).max() > 0.01


@pytest.mark.parametrize("inertia", ["connector", "lumped"])
def test_lumped_inertia_is_that_of_the_dissertation(inertia):
    """J_i = Σ m_i L²/3 over the segments at connector i (E19), observed in the rotation without friction."""
    spec = chain(MASSES, mu_t=0.0, mu_n=0.0)
    own = {
        "point": np.zeros(5),
        # A block of 18 mm by 30 mm and two wheels of 1.5 g and 8 mm at ± 15 mm.
        "connector": (
            (np.array(MASSES) - 0.003) * (0.018**2 + 0.03**2) / 12
            + 0.003 * (0.015**2 + 0.008**2 / 4)
        ),
        "lumped": np.array([0.03, 2 * 0.05, 2 * 0.02, 2 * 0.04, 0.1]) * 0.055**2 / 3,
    }
    wave = Wave(spec, bias=0.3)
    h = bent(
        AnalyticalSnake(spec, inertia=inertia, timestep=5e-4, pneumatics=wave), 1.0
    )
    turned = {
        name: phase(spec, wave, h.time, frozen=False, inertia=j)
        for name, j in own.items()
    }
    assert h.heading == pytest.approx(turned[inertia], abs=2e-6)
    others = [turned[name] for name in own if name != inertia]
    assert min(np.abs(other - h.heading).max() for other in others) > 1e-3


@pytest.mark.parametrize(
    ("options", "friction_law"),
    [
        ({}, "axis"),
        ({"inertia": "lumped"}, "wheel"),
        ({"model": "compliant"}, "wheel"),
        pytest.param({"model": "simplified"}, "ellipse", marks=pytest.mark.slow),
        ({"model": "simplified", "friction_torque": False}, "axis"),
    ],
    ids=["complete", "lumped", "compliant", "simplified", "no torque"],
)
def test_mass_cancels(options, friction_law):
    """Seven times the mass and stiffness: the same path, seven times the torques and the work."""
    spec = chain(MASSES)
    heavy = replace(
        spec,
        mass=replace(spec.mass, connectors=tuple(7 * m for m in MASSES)),
        bending=replace(spec.bending, stiffness=7 * spec.bending.stiffness),
    )
    light, loaded = (
        rollout(
            AnalyticalSnake(s, friction=friction_law, supply_pa=SUPPLY, **options),
            Gait(2.0, 0.2),
            1.0,
        )
        for s in (spec, heavy)
    )
    assert loaded.position == pytest.approx(light.position, abs=1e-8)
    assert loaded["heading"] == pytest.approx(light["heading"], abs=1e-7)
    assert loaded.stack("torque") == pytest.approx(
        7 * light.stack("torque"), rel=1e-5, abs=1e-6
    )
    assert loaded["work"] == pytest.approx(7 * light["work"], rel=1e-6, abs=1e-9)


def test_simplified_differs_from_complete_in_a_gait():
    """At the bends of a gait the three models differ; only the one without friction torque cannot steer."""
    spec = robot()
    gait = Gait(2.0, 0.2)

    def turned(**options) -> float:
        run = rollout(AnalyticalSnake(spec, supply_pa=SUPPLY, **options), gait, 4.0)
        return float(run["heading"][-1] - run["heading"][100]) / 3

    complete = turned()
    simplified = turned(model="simplified")
    unturned = turned(model="simplified", friction_torque=False)
    assert complete > 0.5 and simplified > 0.5
    assert abs(unturned) < 0.2 * complete


# Invalid settings


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (
            {"inertia": "heavy"},
            "inertia 'heavy' is unknown; allowed: point, connector, lumped",
        ),
        (
            {"model": "simple"},
            (
                "model 'simple' is unknown; allowed: complete, simplified, compliant,"
                " quasistatic; did you mean simplified?"
            ),
        ),
        (
            {"friction": "coulomb"},
            (
                "friction law 'coulomb' is unknown; allowed: axis, wheel, viscous,"
                " ellipse, cosine"
            ),
        ),
    ],
)
def test_unknown_names_raise_with_the_known_names(options, words):
    with pytest.raises(InputError) as error:
        AnalyticalSnake(robot(), **options)
    assert str(error.value) == words


def test_model_settings_are_described():
    about = AnalyticalSnake(
        robot(),
        model="simplified",
        friction_torque=False,
        inertia="lumped",
        friction="ellipse",
    ).describe()
    assert {
        name: about[name]
        for name in (
            *("model", "friction_torque", "inertia", "friction", "track_m"),
            *("timestep_s", "tolerance_m_s", "slip_speed_m_s"),
        )
    } == {
        "model": "simplified",
        "friction_torque": False,
        "inertia": "lumped",
        "friction": "ellipse",
        "track_m": 0.015,
        "timestep_s": 0.002,
        "tolerance_m_s": 0.0002,
        "slip_speed_m_s": 0.00025,
    }


# The dissertation's factor


def gapless(speed: float = 0.15):
    run = Snake(speed=speed, rigid_gap=0.0, frequency=1.7).trajectory()
    return with_metadata(run, segment_length_m=0.037, rigid_gap_m=0.0)


def gapped(speed: float = 0.2):
    run = Snake(speed=speed, frequency=1.7).trajectory("twin")
    return with_metadata(run, segment_length_m=0.037, rigid_gap_m=0.018)


def test_gap_factor_multiplies_the_reference_speed():
    plain = compare(gapless(), gapped())
    factor = compare(gapless(), gapped(), gap_factor=True)
    assert plain.metrics["gap_factor"] == 1.0
    assert factor.metrics["gap_factor"] == pytest.approx((0.037 + 0.018) / 0.037)
    assert plain.metrics["com_speed_rel"] == pytest.approx(0.2 / 0.15 - 1, rel=1e-5)
    assert factor.metrics["com_speed_rel"] == pytest.approx(
        0.2 / (0.15 * 55 / 37) - 1, rel=1e-5
    )
    same = plain.metrics.keys() - {"gap_factor", "com_speed_rel"}
    assert {name: factor.metrics[name] for name in same} == {
        name: plain.metrics[name] for name in same
    }


def test_gap_factor_raises_if_gaps_would_count_twice():
    with pytest.raises(InputError) as error:
        compare(gapped(), gapped(), gap_factor=True)
    assert "because this run already has rigid gaps in its geometry" in str(error.value)
    assert str(error.value).endswith("run it without gaps")


@pytest.mark.parametrize("lost", ["segment_length_m", "rigid_gap_m"])
def test_gap_factor_needs_the_lengths_of_the_candidate(lost):
    with pytest.raises(
        InputError, match="the metadata lack `segment_length_m` or `rigid_gap_m`"
    ):
        compare(gapless(), with_metadata(gapped(), **{lost: None}), gap_factor=True)


SCENARIO = {
    "robot": "gen2",
    "duration_s": 2,
    "controller": {"kind": "gait", "frequency_hz": 2.0},
    "comparison": {"gap_factor": True},
}


def refusal(**changes) -> list[str]:
    with pytest.raises(InputFileError) as error:
        parse_scenario(SCENARIO | changes)
    return [line.removeprefix("scenario: ") for line in error.value.lines]


@pytest.mark.slow
def test_scenario_can_request_the_gap_factor(tmp_path):
    scenario = parse_scenario(
        SCENARIO | {"plants": {"analytical": {"gaps": False}, "twin": {}}}
    )
    assert scenario.file.comparison.gap_factor
    result = run_scenario(scenario, tmp_path / "run")
    found = result.metrics["comparison"]
    assert found["gap_factor"] == pytest.approx(55 / 37)
    plants = result.metrics["plants"]
    model, twin = (plants[name]["com_speed_m_s"] for name in ("analytical", "twin"))
    assert found["com_speed_rel"] == pytest.approx(twin / (model * 55 / 37) - 1)


def test_scenario_rejects_a_meaningless_gap_factor():
    (line,) = refusal()
    assert (
        line == "comparison.gap_factor: the analytical plant already has the rigid"
        " gaps in its geometry; set `plants.analytical.gaps: false`"
    )
    (line,) = refusal(plants={"analytical": {"gaps": False}})
    assert (
        line == "comparison.gap_factor: a comparison needs both plants; add the other"
        " one to `plants`"
    )
    (line,) = refusal(comparison={"gap_factor": "yes"})
    assert line.startswith("comparison.gap_factor: ")
