"""Robot files with skin: keys that each kind of contact needs and does not have, and their messages."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from srs_twin.errors import InputFileError
from srs_twin.io.files import find_file
from srs_twin.robot.file import load_robot, load_robot_file
from srs_twin.scenario.loading import load_scenario, parse_scenario

pytestmark = pytest.mark.fast

TEXT = find_file("robot", "skin_example").read_text("utf-8")
WHEELED = find_file("robot", "gen2").read_text("utf-8")


@pytest.fixture
def problems(tmp_path: Path):
    """Return a function from the text of a robot file to the problems that loading it reports."""

    def load(text: str) -> list[str]:
        path = tmp_path / "robot.yaml"
        path.write_text(text, "utf-8")
        with pytest.raises(InputFileError) as caught:
            load_robot(path)
        return list(caught.value.lines)

    return load


def number_line(text: str, start: str) -> int:
    return next(
        k for k, line in enumerate(text.splitlines(), start=1) if line.startswith(start)
    )


def test_numbers_of_a_skin_reach_the_robot():
    spec = load_robot("skin_example")
    assert (spec.friction.mu_t, spec.friction.backward, spec.friction.mu_n) == (
        0.1,
        0.14,
        0.5,
    )
    assert spec.skin is not None and (spec.skin.friction_law, spec.skin.points) == (
        "cosine",
        6,
    )
    assert spec.mass.segments == (0.025,) * 8 and spec.mass.total == pytest.approx(0.2)
    assert (
        spec.mass.connectors[0] == 0.0125
        and spec.mass.connectors[1] == 0.025
        and spec.mass.wheel == 0.0
    )
    # Two points of a Gauss rule across the belly carry the moment of an evenly loaded
    # width.
    assert 2 * spec.geometry.half_track == pytest.approx(0.05 / math.sqrt(3))


def test_missing_numbers_of_a_skin_are_named(problems):
    forward = next(line for line in TEXT.splitlines() if line.startswith("  forward"))
    (line,) = problems(TEXT.replace(forward + "\n", ""))
    assert "contact.forward: missing; a robot with contact skin needs this key" in line
    assert (
        f":{number_line(TEXT, 'contact')}:" in line
        or f":{number_line(TEXT, 'contact') + 1}:" in line
    )


def test_keys_of_wheels_are_refused_for_a_skin(problems):
    added = "  half_track_m: {value: 0.01, unit: m, status: measured, source: ruler}\n"
    (line,) = problems(TEXT.replace("geometry:\n", f"geometry:\n{added}"))
    assert line.endswith(
        "geometry.half_track_m: a robot with contact skin cannot have `half_track_m`;"
        " remove this key"
    )
    assert f":{number_line(TEXT, 'geometry') + 1}:17: " in line


def test_keys_of_a_skin_are_refused_for_wheels(problems):
    (line,) = problems(WHEELED + "contact: {kind: wheels, law: cosine}\n")
    assert line.endswith(
        "contact.law: a robot with contact wheels cannot have `law`; remove this key"
    )


def test_missing_keys_of_wheels_are_named(problems):
    record = next(
        line for line in WHEELED.splitlines() if line.startswith("  wheel_radius_m")
    )
    (line,) = problems(WHEELED.replace(record + "\n", ""))
    assert (
        "geometry.wheel_radius_m: missing; a robot with contact wheels needs this key"
        in line
    )


def test_unknown_kinds_and_laws_are_refused(problems):
    (line,) = problems(TEXT.replace("kind: skin", "kind: belly"))
    assert "contact.kind: must be one of wheels, skin, not text 'belly'" in line
    (line,) = problems(TEXT.replace("law: cosine", "law: axis"))
    assert "contact.law: must be one of ellipse, cosine, not text 'axis'" in line


def test_wrong_number_of_masses_is_refused(problems):
    (line,) = problems(
        TEXT.replace("segments_kg: {value: 0.025", "segments_kg: {value: [0.1, 0.2]")
    )
    assert (
        "mass.segments_kg.value: 2 masses are given for 8 segments; give 8 masses, or"
        " one number for all of them" in line
    )


def test_backward_friction_is_forward_by_default(tmp_path):
    backward = next(line for line in TEXT.splitlines() if line.startswith("  backward"))
    path = tmp_path / "robot.yaml"
    path.write_text(TEXT.replace(backward + "\n", ""), "utf-8")
    assert load_robot(path).friction.backward == 0.1


def test_overrides_change_the_skin():
    scenario = load_scenario(
        "skin_straight",
        set={"robot.contact.law": "ellipse", "robot.contact.transverse": 0.8},
    )
    assert scenario.robot.skin is not None
    assert (scenario.robot.skin.friction_law, scenario.robot.friction.mu_n) == (
        "ellipse",
        0.8,
    )


DATA = {
    "robot": "skin_example",
    "duration_s": 1,
    "controller": {"kind": "gait", "frequency_hz": 1.0},
}


@pytest.mark.default_cases(at=[0, 2, 4, 5])
@pytest.mark.parametrize(
    ("plants", "message"),
    [
        (
            {"analytical": {"friction": "axis"}},
            "plants.analytical.friction: skin_example has a skin",
        ),
        ({"twin": {"wheels": "skid"}}, "plants.twin.wheels: skin_example has a skin"),
        (
            {"twin": {"friction": "wheel"}},
            "plants.twin.friction: skin_example has a skin",
        ),
        (
            {"twin": {"contact": "preloaded"}},
            "plants.twin.contact: contact 'preloaded' does not support a robot with"
            " skin; use contact 'loaded'",
        ),
        (
            {"analytical": {"inertia": "lumped"}},
            "plants.analytical.inertia: inertia 'lumped' is not allowed for a robot"
            " with skin",
        ),
        (
            {"analytical": {"model": "simplified"}},
            "plants.analytical.model: model 'simplified' does not support a robot with"
            " skin; use model 'complete' or model 'compliant'",
        ),
    ],
)
def test_options_of_wheels_are_refused_for_a_skin(plants, message):
    with pytest.raises(InputFileError, match=message.replace("(", r"\(")):
        parse_scenario(DATA | {"plants": plants})


def test_resolved_scenario_of_a_skin_loads_again():
    scenario = load_scenario("skin_straight")
    assert "friction" not in scenario.document["plants"]["analytical"]
    again = parse_scenario(dict(scenario.document))
    assert again.robot == scenario.robot and again.document == scenario.document


def test_files_without_contact_are_on_wheels():
    assert not load_robot_file("gen2").has_skin
    assert load_robot("gen2").skin is None
