"""`srs-twin calibrate footprint`, its files, and the shipped footprints."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from srs_twin import DivergedError, InputError, load_robot, rollout
from srs_twin.cli import main
from srs_twin.identification import excursions, footprint as study_module
from srs_twin.identification.footprint import (
    RECORD_HZ,
    FootprintMeasurement,
    FootprintStudy,
    GaitSetup,
    footprint_study,
    steady_path,
)
from srs_twin.identification.footprint_report import (
    calibrate_command,
    footprint_file,
    robot_hash,
)
from srs_twin.identification.paths import SteadyPath
from srs_twin.io.documents import dump_yaml, parse_yaml
from srs_twin.io.files import shipped_folder
from srs_twin.planning.footprint import Transient, validate_footprint
from srs_twin.planning.footprint_file import (
    load_footprint,
    load_footprint_file,
    save_footprint,
)
from srs_twin.planning.planner import plan
from srs_twin.planning.problem import Problem
from srs_twin.robot.world import Circle, Goal, Pose, World

SHORT = (
    "calibrate",
    "footprint",
    "gen2",
    "--plant",
    "analytical",
    "--offsets=0.2,-0.2,0",
    "--no-transients",
    "--phases",
    "1",
    "--periods",
    "3",
)
FILE = Path("calibration/footprints/gen2_gait.yaml")


def test_a_short_footprint_measurement_by_the_command(srs_twin, tmp_path, monkeypatch):
    done = srs_twin(*SHORT, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (
        "curvature 1/m" in done.stdout and f"footprint written to {FILE}" in done.stderr
    )
    body = load_footprint(tmp_path / FILE)
    assert body.offsets == (-0.2, 0.0, 0.2) and not body.transients
    for curvature, speed, left in zip(
        body.curvatures, body.speeds, body.left, strict=True
    ):
        assert all(
            f"{value:.4f}" in done.stdout for value in (curvature or 0.0, speed, left)
        )
    file = load_footprint_file(tmp_path / FILE)
    assert (
        file.speed_m_s.status == "calibrated"
        and "analytical model compliant" in file.curvature_per_m.source
    )
    lines = (tmp_path / FILE).read_text("utf-8").splitlines()
    assert (
        lines[0] == "# measured by: srs-twin calibrate footprint gen2 --name gen2_gait"
        " --controller gait --frequency 2 --pressure 48.3 --plant analytical"
        " --offsets=-0.2,0,0.2 --no-transients --periods 3 --phases 1"
    )
    assert lines[1].endswith(robot_hash(load_robot("gen2"))) and "mujoco 3." in lines[2]

    # The same measurement replaces the file; another one is refused.
    before = (tmp_path / FILE).read_bytes()
    options = lines[0].removeprefix("# measured by: srs-twin ").split()
    again = srs_twin(*options, "--quiet", "--workers", "1", cwd=tmp_path)
    assert (again.returncode, again.stdout, again.stderr) == (0, "", "")
    assert (tmp_path / FILE).read_bytes() == before
    other = srs_twin(*SHORT, "--periods", "4", cwd=tmp_path)
    assert (
        other.returncode == 2
        and other.stderr
        == f"{FILE}: the file already contains another footprint; replace it with"
        " --overwrite, or choose another file with --name or --out\n"
    )
    assert (tmp_path / FILE).read_bytes() == before
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as end:
        main([*SHORT, "--periods", "4", "--overwrite", "-q"])
    assert end.value.code == 0
    assert (tmp_path / FILE).read_bytes() != before
    assert sorted(path.name for path in (tmp_path / FILE).parent.iterdir()) == [
        FILE.name
    ]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["gen9"], "unknown robot 'gen9'; did you mean gen"),
        (
            ["gen2", "--controller", "itc"],
            "unknown controller 'itc'; did you mean ilc?",
        ),
        (["gen2", "--plant", "twins"], "unknown plant 'twins'; did you mean twin?"),
        (
            ["gen2", "--offsets=a,b"],
            "--offsets 'a,b' is not allowed; give a list of numbers, for example"
            " --offsets=-0.3,0,0.3",
        ),
        (["gen2", "--offsets=nan,0,0.3"], "offset nan is not allowed"),
        (["gen2", "--offsets=0,0.1,0.3"], "some below 0 and some above 0"),
        (
            ["gen2", "--offsets=-0.1,0.1"],
            "a planner needs between 3 and 101 offsets",
        ),
        (
            ["gen2", "--offsets=-0.1,0.1,0.1"],
            "give each offset once, in ascending order",
        ),
        (["gen2", "--offsets=-1,0,0.1"], "gait offset -1.0 is not allowed"),
        (
            ["gen4", "--controller", "ilc", "--offsets=-0.4,0,0.3"],
            "ilc offset -0.4 is not allowed",
        ),
        (["gen2", "--pressure", "70"], "gen2 supports at most 68.9476 kPa"),
        (["gen2", "--pressure", "nan"], "Invalid value for '--pressure'"),
        (["gen2", "--frequency", "0"], "frequency 0.0 Hz is not allowed"),
        (["gen2", "--frequency", "4.1"], "it must be 4 Hz or less"),
        (
            ["gen4", "--controller", "ilc", "--target", "0"],
            "ilc target 0.0 is not allowed",
        ),
        (["gen2", "--contact", "lose"], "did you mean loaded?"),
        (
            ["gen2", "--plant", "analytical", "--contact", "loaded"],
            "contact 'loaded' is allowed only for the twin",
        ),
        (
            ["gen2", "--periods", "2"],
            "periods 2 is not allowed; it must be between 3 and 200",
        ),
        (
            ["gen2", "--chambers", "orifce"],
            "unknown chambers 'orifce'; did you mean orifice?",
        ),
        (
            ["gen2", "--phases", "65"],
            "phases 65 is not allowed; it must be between 1 and 64",
        ),
        (
            ["gen2", "--name", "../x"],
            "--name: '../x' is not allowed; use at most 60 lower-case letters",
        ),
        (["gen2", "--out", "/dev/null/x"], "cannot write there"),
        (["gen4_module"], "one segment"),
    ],
)
def test_invalid_footprint_options_are_refused_before_any_run(
    options, message, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(
        study_module, "run_many", lambda *_, **__: pytest.fail("something ran")
    )
    with pytest.raises(SystemExit) as end:
        main(["calibrate", "footprint", *options])
    said = capsys.readouterr().err
    assert end.value.code == 2 and message in said and "Traceback" not in said
    assert not list(tmp_path.iterdir())


def test_an_interrupted_footprint_leaves_no_files(tmp_path, monkeypatch, capsys):
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(study_module, "run_many", interrupted)
    with pytest.raises(SystemExit) as end:
        main(list(SHORT))
    assert (
        end.value.code == 130
        and capsys.readouterr().err == "interrupted; nothing was written\n"
    )
    assert not list(tmp_path.rglob("*.yaml"))


@pytest.mark.parametrize("contact", ["preloaded", "loaded"])
def test_a_measurement_is_stored_with_its_contact(contact, tmp_path):
    drive = GaitSetup(load_robot("gen2"), 2.0, 48.3e3, contact=contact)
    assert drive.plant_factory()().contact.name == contact
    asked = footprint_study(
        drive, offsets=(-0.2, 0.0, 0.2), changes=(), periods=3, phases=1
    )
    assert f" --contact {contact} " in calibrate_command(asked, "gen2", "short")
    curvatures = (-1.23456, 0.0, 1.2)
    paths = [SteadyPath(0.12344, k, 0.05, 0.06, 0.9, 0.1) for k in curvatures]
    spread = SteadyPath(0.001, 0.02, 0.003, 0.004, 0.0, 0.0)
    change = Transient(-0.2, 0.2, 0.01, 0.02, 0.3, 0.04, -0.05, -0.16)
    measured = FootprintMeasurement(
        drive, asked.offsets, tuple(paths), (spread,) * 3, (change,), 2, 5
    )
    save_footprint(footprint_file(measured, "short"), tmp_path / "short.yaml")
    file = load_footprint_file(tmp_path / "short.yaml")
    assert file.contact == contact
    assert file.title.endswith(", 2 Hz, 48.3 kPa, as measured on the twin")
    assert (
        "over 5 gait periods from each of 2 gait phases" in file.curvature_per_m.source
    )
    # A straight robot reaches farther than 0.1 m behind its centre of mass.
    straight = (drive.spec.geometry.body_length + drive.spec.geometry.width) / 2
    columns = ("speed_m_s", "curvature_per_m", "left_m", "right_m", "ahead_m")
    assert [getattr(file, column).value for column in columns] == [
        [0.1234] * 3,
        [-1.2346, 0.0, 1.2],
        [0.05] * 3,
        [0.06] * 3,
        0.9,
    ]
    assert file.behind_m.value == pytest.approx(straight, abs=5e-5)
    spreads = [getattr(file.spread, column)[2] for column in columns[:4]]
    assert spreads == [0.001, 0.02, 0.003, 0.004]
    assert [entry.transient() for entry in file.transients.changes] == [change]
    text = (tmp_path / "short.yaml").read_text("utf-8")
    longer = re.sub(r"(spread:(?:.|\n)*left_m: \[[^]]*)\]", r"\1, 0.0]", text)
    (tmp_path / "short.yaml").write_text(longer, "utf-8")
    with pytest.raises(
        InputError, match="spread.left_m: 4 values are given for 3 offsets"
    ):
        load_footprint_file(tmp_path / "short.yaml")


def test_random_paths_have_their_length_and_never_turn_back():
    firsts = []
    for seed in range(60):
        arcs = np.array(excursions._random_arcs(np.random.default_rng(seed), -2.0, 1.5))
        lengths = arcs[:, 1]
        assert 3.45 <= lengths.sum() <= 3.5 + 1e-9
        assert lengths.min() > 0.05 and lengths.max() <= 0.8
        assert np.abs(np.cumsum(arcs.prod(axis=1))).max() <= 1.4 + 1e-9
        firsts.append(lengths[0])
    assert 0.3 <= min(firsts) < 0.32 and max(firsts) > 0.75


def test_a_diverged_run_is_named_in_the_message(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    runs = [
        object(),
        DivergedError("twin", 1.5, "the state before the step contains nan"),
        object(),
    ]
    monkeypatch.setattr(study_module, "run_many", lambda *_, **__: runs)
    with pytest.raises(SystemExit) as end:
        main(list(SHORT))
    assert end.value.code == 3
    assert (
        "offset 0: twin diverged at t = 1.5 s: the state before the step contains nan"
        in capsys.readouterr().err
    )


def test_arrays_are_written_row_by_row_and_read_back():
    data = {
        "a": [1.0, -2.5, 3],
        "b": [{"x": 1.0, "y": -0.25}, {"x": 2.0, "y": 0.5}],
        "c": ["x", []],
        "d": {},
    }
    text = dump_yaml(data, compact=True)
    assert text.splitlines()[:3] == ["a: [1.0, -2.5, 3]", "b:", "- {x: 1.0, y: -0.25}"]
    assert (
        parse_yaml(text, "text").data
        == data
        == parse_yaml(dump_yaml(data), "text").data
    )


def test_margin_has_the_quantiles_of_the_measured_runs(srs_twin, tmp_path, monkeypatch):
    """Of 20 runs from 0 to 19 mm, the 11th, 19th and 20th are the quantiles of a new run."""

    def tried(function, jobs, **_):
        for job in jobs:
            excursion = 1e-3 * (7 * job.seed % 20) + 4e-5
            yield SimpleNamespace(result=(0.1 * excursion, excursion))

    monkeypatch.setattr(excursions, "run_tasks", tried)
    options = ("follow_fig56", "--runs", "20", "--plants", "analytical", "--out", ".")
    done = srs_twin("calibrate", "margin", *options, cwd=tmp_path)
    assert "analytical 10 18 19 19" in " ".join(done.stdout.split())
    *kept, found = load_footprint_file(tmp_path / "gen2_gait.yaml").excursions
    assert found.source.endswith("margin follow_fig56`: 20 random paths of 3.5 m")
    assert found.path_m == [k / 1000 for k in range(20)]
    assert found.conditions.plant == "analytical" and kept


SHIPPED = {
    "gen2_gait": ("gen2", "gait", 2.0, 48.3e3, 0.2, "lag"),
    "gen4_ilc": ("gen4", "ilc", 1.5, 131e3, 0.3, "lag"),
    "gen2_orifice": ("gen2", "gait", 2.0, 48.3e3, 0.2, "orifice"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_footprints_are_current(name):
    """One offset is repeated at one phase of the gait; the file has the mean over several phases."""
    robot, controller, frequency, supply, offset, chambers = SHIPPED[name]
    spec = load_robot(robot)
    first, second = (
        (shipped_folder("footprint") / f"{name}.yaml")
        .read_text("utf-8")
        .splitlines()[:2]
    )
    assert first.startswith(
        f"# measured by: srs-twin calibrate footprint {robot} --name {name} "
    )
    assert f"--pressure {supply / 1000:g} " in first and " --no-transients" not in first
    assert second.endswith(robot_hash(spec)), (
        "the robot has changed; measure it again with the command above"
    )

    drive = GaitSetup(
        spec,
        frequency,
        supply,
        controller,
        chambers=chambers,
        contact=load_footprint_file(name).twin_contact,
    )
    job = drive.steady_job(drive.plant_factory(), offset, 0.0, FootprintStudy.periods)
    again = steady_path(
        drive,
        rollout(job.plant(), job.controller(), job.duration, record_hz=RECORD_HZ),
        FootprintStudy.periods,
    )
    file = load_footprint_file(name)
    row = file.offset.value.index(offset)
    columns = {
        "curvature": "curvature_per_m",
        "speed": "speed_m_s",
        "left": "left_m",
        "right": "right_m",
    }
    for key, column in columns.items():
        value = getattr(file, column).value[row]
        spread = getattr(file.spread, column)[row]
        assert getattr(again, key) == pytest.approx(
            value, abs=2 * spread + 2e-3 * abs(value)
        ), key
    assert (
        again.ahead <= file.ahead_m.value * 1.01
        and again.behind <= file.behind_m.value * 1.01
    )


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_footprints_are_symmetric_and_can_be_planned_with(name):
    """All modules of a robot are equal, so left and right turns are mirror images."""
    body = validate_footprint(load_footprint(name))
    assert body.curvatures == pytest.approx(
        [-k for k in body.curvatures[::-1]], abs=0.02
    )
    assert body.left == pytest.approx(body.right[::-1], abs=1e-3)
    assert body.speeds == pytest.approx(body.speeds[::-1], rel=0.01)
    changes = {(t.before, t.after): t for t in body.transients}
    assert changes
    for (before, after), change in changes.items():
        other = changes[-before, -after]
        assert change.dheading == pytest.approx(-other.dheading, abs=0.03)
        assert change.dheading * (after - before) < 0, (
            "a turn that comes late is missing"
        )
    answer = plan(
        Problem(
            Pose(0, 0, 0),
            Goal(3.0, 0.0, 0.0, 0.02),
            World((Circle(1.5, 0.0, 0.1),)),
            body,
        )
    )
    assert answer.outcome == "found"
