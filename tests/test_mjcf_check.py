"""Models from anybody: what is unfit is refused with its reason, and nothing runs away."""

from __future__ import annotations

import pytest

from srs_twin.errors import InputError
from srs_twin.mjcf.check import check_mjcf

BALL = (
    '<worldbody><geom type="plane" size="1 1 1"/>'
    '<body pos="0 0 .2"><freejoint/><geom size=".1"/></body></worldbody>'
)

BALL_ALONE = '<body pos="0 0 .2"><freejoint/><geom size=".1"/></body>'


@pytest.fixture
def check(tmp_path):
    def write_and_check(inside, **options):
        path = tmp_path / "model.xml"
        path.write_text(f"<mujoco>{inside}</mujoco>")
        return check_mjcf(path, **options)

    return write_and_check


def test_a_sound_model_passes_and_is_measured(check):
    report = check(BALL)
    assert report.faults == ()
    assert report.sizes["bodies"] == report.sizes["joints"] == 1
    assert report.sizes["mass_kg"] == pytest.approx(1000 * 4 / 3 * 3.141592653589793 * 0.1**3)


@pytest.mark.parametrize(
    ("inside", "words"),
    [
        (f'<option timestep="nan"/>{BALL}', "timestep nan s is not allowed; it must be 1e-05 to 0.1 s"),
        (BALL.replace('size=".1"', 'size=".1" friction="-1 0 0"'), "geom_friction[1] has a negative value"),
        (BALL.replace('pos="0 0 .2"', 'pos="0 0 nan"'), "not finite"),
        ("<worldbody><body>", "not readable as XML"),
        ("<worldbody><bod/></worldbody>", "does not compile: XML Error: Schema violation"),
        ('<include file="../other.xml"/>', "<include> names '../other.xml', outside the model's folder"),
        ('<asset><mesh file="/etc/passwd"/></asset>', "outside the model's folder"),
        (
            '<worldbody><body><joint/><geom size=".1"/></body></worldbody>'
            '<actuator><motor joint="" gear="1e30"/></actuator>',
            "does not compile",
        ),
    ],
)
def test_faults_are_named(check, inside, words):
    report = check(inside)
    assert any(words in fault for fault in report.faults), report.faults


def test_what_an_included_file_names_counts_too(check, tmp_path):
    (tmp_path / "part.xml").write_text('<mujoco><include file="/tmp/elsewhere.xml"/></mujoco>')
    (fault,) = check('<include file="part.xml"/>').faults
    assert fault.startswith("part.xml:1: <include> names '/tmp/elsewhere.xml', outside the model's folder")


def test_an_unstable_model_is_found_by_random_control(check):
    report = check(
        '<worldbody><body><joint name="j" armature="1e-6"/><geom size=".01" mass="1e-6"/></body></worldbody>'
        '<actuator><motor joint="j" gear="1e9"/></actuator>'
    )
    assert any("random control raised the warning" in fault for fault in report.faults)


@pytest.mark.slow
def test_a_model_that_never_ends_is_stopped(check):
    # Spheres in one another: nothing is wrong with the file, but every step has 300,000 contacts.
    endless = f'<worldbody><replicate count="800">{BALL_ALONE}</replicate></worldbody>'
    report = check(endless, time_limit_s=3)
    assert len(report.faults) == 1
    assert "3 s" in report.faults[0]


def test_a_missing_file_is_bad_input(tmp_path):
    with pytest.raises(InputError, match="no such file; give an MJCF file or the name of a shipped robot"):
        check_mjcf(tmp_path / "none.xml")
