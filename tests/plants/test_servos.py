"""Rigid snakes: servos follow their commands regardless of the load, under the same controllers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from srs_twin.control.gait import Gait
from srs_twin.errors import InputFileError
from srs_twin.plants.analytical import AnalyticalSnake
from srs_twin.plants.twin.snake import TwinSnake
from srs_twin.robot.file import load_robot
from srs_twin.rollout import rollout
from srs_twin.scenario.loading import parse_scenario

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "your-robot.md").read_text(
    "utf-8"
)
TEXT = PAGE.split("```yaml servo_snake.yaml\n")[1].split("```")[0]
TAU, ANGLE = 0.1, 0.6  # response time, s, and commanded angle, rad, of this robot


@pytest.fixture
def write(tmp_path):
    """Return a function that writes the robot of the page, with replaced text, and returns its path."""

    def write_robot(*changes: tuple[str, str]) -> Path:
        text = TEXT
        for before, after in changes:
            assert before in text
            text = text.replace(before, after)
        path = tmp_path / "servo_snake.yaml"
        path.write_text(text, "utf-8")
        return path

    return write_robot


def test_joints_follow_a_critically_damped_response_under_load(write):
    spec = load_robot(write())
    valves = np.tile([1, -1], (spec.segments, 1))
    for plant in (AnalyticalSnake(spec), TwinSnake(spec)):
        for k in range(1, 26):
            t = k * plant.tick / TAU
            expected = ANGLE * (1 - (1 + t) * np.exp(-t))
            # Floor and inertia turn a joint by less than friction coefficient times 1
            # mrad.
            assert plant.step(valves).bend == pytest.approx(expected, abs=1e-3)


def distances(spec, **options):
    """Return the distances that both plants crawl in three seconds, m."""
    model = AnalyticalSnake(spec, load="instantaneous", inertia="connector", **options)
    plants = (model, TwinSnake(spec))
    return [rollout(plant, Gait(1.0), 3.0).com[-1, 0] for plant in plants]


@pytest.mark.slow
def test_plants_agree_on_a_gait_of_a_wheeled_rigid_snake(write):
    model, twin = distances(load_robot(write()), friction="wheel")
    assert twin == pytest.approx(model, rel=0.005)
    assert model > 0.3


@pytest.mark.slow
def test_plants_agree_on_a_rigid_snake_with_skin(write):
    skin = "contact:\n  kind: skin\n" + "".join(
        f'  {key}: {{value: {mu}, unit: "1", status: estimated, source: test}}\n'
        for key, mu in (("forward", 0.1), ("transverse", 0.6))
    )
    lines = TEXT.splitlines(keepends=True)
    wheels = [
        line
        for line in lines
        if line.split(":")[0].strip()
        in ("half_track_m", "wheel_radius_m", "wheel_kg", "mu_t", "mu_n", "friction")
    ]
    path = write(
        *((line, "") for line in wheels),
        ("connectors_kg", "segments_kg"),
        ("bending:\n", f"{skin}bending:\n"),
    )
    model, twin = distances(load_robot(path))
    assert twin == pytest.approx(model, rel=0.02)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            ("  kind: position\n", ""),
            "actuator.tau_fill_s: missing; a robot with actuator pressure needs this key",
        ),
        (
            (
                "actuator:\n",
                (
                    "actuator:\n  dead_zone_rad: {value: 0.3, unit: rad, status: measured,"
                    " source: x}\n"
                ),
            ),
            (
                "actuator.dead_zone_rad: a robot with actuator position cannot have"
                " `dead_zone_rad`; remove this key"
            ),
        ),
        (
            ("kind: position", "kind: servo"),
            "actuator.kind: must be one of pressure, position, not text 'servo'",
        ),
    ],
)
def test_keys_of_the_other_kind_are_refused(write, change, message):
    with pytest.raises(InputFileError) as caught:
        load_robot(write(change))
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("section", "message"),
    [
        (
            {"supply": {"pressure_kpa": 50}},
            "supply.pressure_kpa: servo_snake has servos and therefore no supply",
        ),
        (
            {"pneumatics": {"kind": "orifice"}},
            "pneumatics.kind: servo_snake has servos, which only the pneumatic model"
            " `lag` represents; use `lag`",
        ),
    ],
)
def test_air_is_refused_for_servos(write, section, message):
    data = {
        "robot": str(write()),
        "duration_s": 1,
        "controller": {"kind": "gait", "frequency_hz": 1.0},
    }
    data |= {"plants": {"analytical": {}}}
    assert (
        parse_scenario(data).document
        == parse_scenario(parse_scenario(data).document).document
    )
    with pytest.raises(InputFileError, match=message):
        parse_scenario(data | section)
