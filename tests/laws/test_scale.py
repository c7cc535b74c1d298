"""A robot of another size makes the same motion, with the numerical settings that follow from its size.

The factors of a scale that is a power of four are powers of two, which multiply without
rounding. What is left there is the tolerance of the iterations: their criteria add
forces and moments, which scale differently (docs/verification.md).
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from scaled_robots import PLANTS, SETTINGS, deviations, motion, scaled

from srs_twin import (
    AnalyticalSnake,
    InputError,
    PreloadedContact,
    TwinSnake,
    load_robot,
)
from srs_twin.pneumatics.valves import count_slots
from srs_twin.robot.scale import SHIPPED, Scale, divide
from srs_twin.scenario.loading import parse_scenario
from srs_twin.scenario.plants import TwinFile

GEN2 = load_robot("gen2")
SPEC = replace(GEN2, friction=replace(GEN2.friction, drag=0.02))


@cache
def reference(name: str, explicit: tuple[str, ...]) -> np.ndarray:
    return motion(PLANTS[name](SPEC, 1.0, explicit), 1.0)


FAR = [1 / 16, 16.0]
NEAR = [pytest.param(s, marks=pytest.mark.slow) for s in (1 / 4, 4.0)]


@pytest.mark.slow
@pytest.mark.parametrize("s", FAR + NEAR)
@pytest.mark.parametrize("name", PLANTS)
def test_default_settings_scale_with_the_robot(name, s):
    found = deviations(name, SPEC, s, (), reference(name, ()))
    assert np.abs(found).max() < (1e-6 if name.startswith("twin") else 1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("s", [0.05, 20.0])
@pytest.mark.parametrize("name", PLANTS)
def test_explicit_settings_admit_every_scale(name, s):
    assert (
        np.abs(deviations(name, SPEC, s, SETTINGS, reference(name, SETTINGS))).max()
        < 1e-4
    )


@pytest.mark.parametrize("s", [0.05, 20.0])
@pytest.mark.parametrize(
    "name",
    [
        pytest.param("complete, wheel, instantaneous", marks=pytest.mark.slow),
        "twin, loaded, wheel",
    ],
)
def test_default_settings_between_the_powers_are_of_similar_accuracy(name, s):
    """The settings differ by 12 % from those that scale."""
    assert np.abs(deviations(name, SPEC, s, (), reference(name, ()))).max() < 5e-3


@pytest.mark.default_cases(at=[0, 3, 4])
@pytest.mark.parametrize("s", [0.05, 20.0])
@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("simplified, axis", ("slip_speed", "tolerance")),
        pytest.param(
            "complete, wheel, instantaneous",
            ("slip_speed", "tolerance"),
            marks=pytest.mark.slow,
        ),
        pytest.param("compliant, ellipse", ("slip_speed",), marks=pytest.mark.slow),
        ("twin, loaded, wheel", ("slip_speed",)),
        ("twin, loaded, ellipse", ("slip_speed",)),
    ],
)
def test_settings_that_differ_between_the_powers_are_known(name, settings, s):
    """Slip speed and tolerance alone explain the deviations of default settings at other scales."""
    assert (
        np.abs(deviations(name, SPEC, s, settings, reference(name, settings))).max()
        < 1e-6
    )


@pytest.mark.default_cases(3)
@pytest.mark.parametrize("name", ["gen1", "gen2", "gen3", "gen4", "gen4_module"])
def test_shipped_robots_have_the_scale_of_the_declared_settings(name):
    assert load_robot(name).scale == SHIPPED


@pytest.mark.default_cases(3)
@pytest.mark.parametrize(
    ("factor", "time"),
    [(0.26, 0.5), (0.24, 0.5), (1 / 16, 0.25), (16.0, 4.0), (4.0, 2.0)],
)
def test_time_unit_is_the_power_of_two_next_to_the_root_of_the_scale(factor, time):
    assert scaled(SPEC, factor).scale == Scale(time)


@pytest.mark.default_cases(at=[0, 2, 3, 4])
@pytest.mark.parametrize(
    "time",
    [0.223606797749979, 0.3162277660168379, 0.7071067811865476, 1.0, 4.47213595499958],
)
def test_scaled_tick_has_the_slots_of_the_original(time):
    scale = Scale.of_pitch(SPEC.geometry.pitch * time**2)
    assert count_slots(0.02 * time, scale) == 200
    assert divide(0.02 * time, 0.001 * scale.time) == pytest.approx(0.001 * time)


@pytest.mark.default_cases(3)
@pytest.mark.parametrize(
    ("interval", "part", "result"),
    [
        (0.02, 0.001, 0.001),
        (0.005, 0.001, 0.001),
        (0.0005, 0.001, 0.0005),
        (0.0021, 0.001, 0.00105),
    ],
)
def test_interval_is_divided_into_whole_parts(interval, part, result):
    assert divide(interval, part) == result


def test_defaults_of_plants_and_scenarios_are_the_same():
    geometry = {
        "segment_length_m": 0.6,
        "rigid_gap_m": 0.3,
        "half_track_m": 0.24,
        "wheel_radius_m": 0.13,
    }
    geometry |= {"com_height_m": 0.24, "width_m": 0.65}
    bending = {"stiffness_nm_per_rad": 3e4, "pitch_stiffness_nm_per_rad": 6500.0}
    bending |= {"roll_stiffness_nm_per_rad": 6500.0}
    bending |= {"damping_time_s": 0.01, "out_of_plane_damping_time_s": 0.04}
    document = {
        "title": "large",
        "duration_s": 1.6,
        "record_hz": 12.5,
        "controller": {"kind": "gait", "frequency_hz": 0.5},
        "robot": {
            "base": "gen2",
            "geometry": geometry,
            "mass": {"connectors_kg": 120.0, "wheel_kg": 6.0},
            "bending": bending,
        },
    }
    scenario = parse_scenario(document)
    for kind, plant in (("analytical", AnalyticalSnake), ("twin", TwinSnake)):
        settings = scenario.build_plant(kind).describe()
        default = plant(scenario.robot).describe()
        for key in ("tick_s", "timestep_s", "slip_speed_m_s"):
            assert settings[key] == default[key], key
    assert scenario.document["plants"]["twin"]["timestep_s"] == 0.004


@pytest.mark.parametrize("contact", ["loaded", PreloadedContact()])
def test_robot_that_mujoco_would_take_as_massless_is_refused(contact):
    with pytest.raises(
        InputError,
        match=r"too small for the twin, .* moment of inertia .* MuJoCo needs more",
    ):
        TwinSnake(scaled(SPEC, 0.01), contact=contact)


def test_defaults_of_a_plant_scale_with_the_time_unit_and_given_values_do_not():
    scale = SimpleNamespace(time=4.0)
    default = TwinFile().timestep_s
    scaled = TwinFile().scaled_to(scale, 0.08)
    assert (scaled.timestep_s, scaled.tick_s) == (4 * default, 0.08)
    given = TwinFile(timestep_s=default).scaled_to(scale, 0.08)
    assert given.timestep_s == default
