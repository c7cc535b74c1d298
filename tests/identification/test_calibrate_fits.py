"""`srs-twin calibrate friction | actuator | locomotion | robot` and their input files."""

from __future__ import annotations

import os
import re
import signal
import time
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT
from recorded import SPEC

from srs_twin import AnalyticalSnake, Gait, Trajectory, load_robot, rollout
from srs_twin.cli import main
from srs_twin.cli.console import interruptible
from srs_twin.control.replay import Replay
from srs_twin.errors import InputError, WriteError
from srs_twin.identification.fit_file import load_fit
from srs_twin.identification.fitting import DataOptions
from srs_twin.identification.friction import fit_pulls, is_pull_table, read_pull_table
from srs_twin.identification.locomotion import gait_run
from srs_twin.pneumatics import Schedule
from srs_twin.recordings.recording import Recording, ValveLog
from srs_twin.recordings.takes import logs_of
from srs_twin.robot.spec import GRAVITY

EXAMPLE = ROOT / "calibration/examples/my_snake"
PULLS = "along_mm,across_mm,spring_n_per_m,mass_kg\n3,26,30,0.15\n2.5,25,30,0.15\n2.8,,30,0.15\n"


def pulls_file(folder: Path, text: str = PULLS, name: str = "pulls.csv") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def test_a_table_of_pulls_is_read(tmp_path):
    pulls = read_pull_table(pulls_file(tmp_path))
    assert list(pulls.along) == pytest.approx([3e-3, 2.5e-3, 2.8e-3])
    assert list(pulls.across) == pytest.approx([26e-3, 25e-3])
    assert pulls.coefficients("along")[0] == pytest.approx(30 * 3e-3 / (0.15 * GRAVITY))
    assert is_pull_table(tmp_path / "pulls.csv") and not is_pull_table(
        EXAMPLE / "held.csv"
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (PULLS.replace("2.5,25", "2.5,x"), r"pulls.csv:3:2: 'x' is not a number"),
        (
            PULLS.replace("2.5,25", "-2.5,25"),
            r"pulls.csv:3:1: along_mm: -2.5 is not allowed; a deformation",
        ),
        (
            PULLS.replace("2.5,25,30", "2.5,25,31"),
            r"pulls.csv:3:3: spring_n_per_m: the value is 31 here but 30 above",
        ),
        (
            PULLS.replace("along_mm", "along_kg"),
            r"pulls.csv:1:1: along_kg: unknown unit 'kg'",
        ),
        (
            PULLS.replace(",mass_kg", ",weight"),
            r"pulls.csv:1: the column 'mass_kg' is missing; a table of",
        ),
        (
            PULLS.replace("along_mm", "along_1_mm"),
            r"pulls.csv:1:1: the column 'along_1_mm' must not be numbered",
        ),
        (
            "along_mm,spring_n_per_m,mass_kg\n3,30,0.15\n",
            r"pulls.csv: a single pull along the body does not show",
        ),
        (
            "along_mm,spring_n_per_m,mass_kg\n3,,0.15\n4,,0.15\n",
            r"pulls.csv:2:2: spring_n_per_m: ",
        ),
        (PULLS.replace("2.8,", "2.8,1e999"), r"pulls.csv:4:2: across_mm: inf is not"),
        (
            PULLS.replace(",30,", ",1e300,"),
            r"pulls.csv:2:3: .* must be between 0.01 and 1e\+06",
        ),
        (
            PULLS.replace("mass_kg", "mass_kg,spring_err_n_per_m"),
            r"pulls.csv:1: unknown column 'spring_err.*; did you mean spring_error_n",
        ),
        (
            PULLS.replace("2.5,25,30,0.15", "2.5,25,30"),
            r"pulls.csv:3: the row has 3 cells, but the header has 4",
        ),
    ],
)
def test_invalid_tables_of_pulls_are_refused(tmp_path, text, message):
    with pytest.raises(InputError, match=message):
        read_pull_table(pulls_file(tmp_path, text))


def test_equal_readings_have_the_error_of_their_resolution(tmp_path):
    text = PULLS.split("\n", maxsplit=1)[0] + "\n4.60,n/a,30,0.15" * 8 + "\n"
    found = fit_pulls(read_pull_table(pulls_file(tmp_path, text)))["friction.mu_t"]
    assert found.standard_error / found.value == pytest.approx(0.01 / 12**0.5 / 4.6)


@pytest.mark.parametrize(
    "text", ["direction,force_n\nahead,0.05\n", "time_s,bend_rad\n0,0.03\n1,0.02\n"]
)
def test_table_without_columns_of_pulls_is_refused_with_these_columns(
    tmp_path, capsys, text
):
    path = pulls_file(tmp_path, text)
    with pytest.raises(SystemExit, match="^2$"):
        main(["calibrate", "friction", str(path), "--robot", "gen2"])
    assert (
        "A table of pulls has the columns along_mm,across_mm,"
        in capsys.readouterr().err
    )


def test_friction_is_fitted_to_pulls_by_the_command(tmp_path, srs_twin):
    pulls_file(tmp_path)
    pulls_file(tmp_path, PULLS.replace("2.5,", "2.6,"), "more.csv")
    options = [
        "calibrate",
        "friction",
        "pulls.csv",
        "--robot",
        "gen2",
        "--validate",
        "more.csv",
    ]
    done = srs_twin(*options, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    fit = load_fit(tmp_path / "calibration/fits/gen2_friction.yaml")
    assert (
        fit.command
        == "srs-twin calibrate friction pulls.csv --robot=gen2 --validate=more.csv"
    )
    assert [(data.name, data.role) for data in fit.data] == [
        ("pulls.csv", "fit"),
        ("more.csv", "validation"),
    ]
    mu_t = np.mean([3, 2.5, 2.8]) * 1e-3 * 30 / (0.15 * GRAVITY)
    assert fit.parameters[0].value == pytest.approx(mu_t, rel=1e-6)
    assert f"{mu_t:.5g}" in done.stdout and "validation: residuals" in done.stdout
    page = (tmp_path / "calibration/fits/gen2_friction.html").read_text("utf-8")
    assert "data:image/svg+xml" in page and "friction.mu_n" in page
    assert "://" not in re.sub(r"data:image/svg[^\"]*", "", page)

    # The same fit replaces the file; another fit is refused and leaves no files.
    again = srs_twin(*options, "-q", cwd=tmp_path)
    assert (again.returncode, again.stdout, again.stderr) == (0, "", "")
    other = srs_twin(*options[:3], "--robot", "gen2", cwd=tmp_path)
    assert (
        other.returncode == 2
        and "another fit (srs-twin calibrate friction" in other.stderr
    )
    assert load_fit(tmp_path / "calibration/fits/gen2_friction.yaml") == fit


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            ["friction", "p.csv", "--validate", "p.csv"],
            "p.csv: this data set contains the same data as p.csv, to which the model is fitted",
        ),
        (
            ["friction", "p.csv", "q.csv"],
            "q.csv: only one table of pulls is allowed in a fit; give other tables"
            " with",
        ),
        (
            ["friction", "p.csv", "h.csv"],
            "p.csv is a table of pulls, but h.csv is a recording of a coasting test",
        ),
        (
            ["friction", "grams.csv"],
            "grams.csv: the pulls give friction.mu_t = 5.64e-05, but it must be between"
            " 0.001 and 5; check `spring_n_per_m` 30 and `mass_kg` 150 (gen2 has a mass"
            " of 0.15 kg)",
        ),
        (["friction", "p.csv", "--name", "No"], "--name: 'No' is not allowed"),
        (
            ["friction", "p.csv", "--out", "My-Fit.yaml"],
            "--out names the fit if --name is not given: 'My-Fit' is not allowed",
        ),
        (
            ["friction", "p.csv", "--out", "x.txt"],
            "--out: x.txt is not allowed; the name of a fit file must end in .yaml",
        ),
        (
            ["actuator", "h.csv", "--valves", "p.csv"],
            "--valves: tables of constant pressures need no log",
        ),
        (
            ["actuator", "h.csv", "--parameters", "modules.gan_plus_1"],
            "did you mean modules.gain_plus_N",
        ),
        (
            ["actuator", "h.csv", "--parameters", ","],
            "--parameters ',' contains no parameters",
        ),
        (["locomotion", "w.csv"], "w.valves.csv: no such file"),
        (
            ["locomotion", "w.csv", "--plant", "twn"],
            "unknown plant 'twn'; did you mean twin",
        ),
        (
            ["locomotion", "w.csv", "--plant", "twin", "--friction-law", "wheel"],
            "--friction-law: this option is allowed only with --plant analytical",
        ),
        (
            ["locomotion", "w.csv", "--pressure", "nan"],
            "Invalid value for '--pressure'",
        ),
    ],
)
def test_unsuitable_options_and_data_are_refused(
    tmp_path, monkeypatch, capsys, options, message
):
    pulls_file(tmp_path, name="p.csv")
    pulls_file(tmp_path, PULLS.replace("3,", "3.1,"), name="q.csv")
    pulls_file(tmp_path, PULLS.replace("0.15", "150"), name="grams.csv")
    (tmp_path / "h.csv").write_bytes((EXAMPLE / "held.csv").read_bytes())
    (tmp_path / "w.csv").write_bytes((EXAMPLE / "walk_straight.csv").read_bytes())
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as end:
        main(["calibrate", *options, "--robot", "gen2"])
    assert end.value.code == 2 and message in capsys.readouterr().err
    assert not list(tmp_path.rglob("*.yaml")) and not list(tmp_path.rglob("*.html"))


def test_friction_is_fitted_to_throws_by_the_command(tmp_path, monkeypatch, capsys):
    """Straight bodies decelerate at a constant rate, which determines the friction."""
    deceleration = 0.6
    time_ = np.arange(0.0, 0.8, 0.01)
    for name, speed in (("a", 0.6), ("b", 0.5)):
        way = speed * time_ - deceleration * time_**2 / 2
        x = way[:, None] - SPEC.geometry.pitch * np.arange(5)
        head = ",".join(
            ["time", *(f"{axis}_{i}" for i in range(1, 6) for axis in "xy")]
        )
        rows = [
            ",".join([f"{t:.3f}", *(f"{number:.6f},0" for number in row)])
            for t, row in zip(time_, x, strict=True)
        ]
        (tmp_path / f"{name}.csv").write_text("\n".join([head, *rows, ""]))
    monkeypatch.chdir(tmp_path)
    main_ok(
        "calibrate",
        "friction",
        "a.csv",
        "--validate",
        "b.csv",
        "-r",
        "gen2",
        "--no-wheel-inertia",
    )
    out = capsys.readouterr().out
    fit = load_fit("calibration/fits/gen2_friction.yaml")
    assert fit.method == "coasting"
    assert fit.parameters[0].value == pytest.approx(deceleration / GRAVITY, rel=0.01)
    assert fit.parameters[1].value is None and "friction.mu_n" in out


def main_ok(*options: str) -> None:
    with pytest.raises(SystemExit) as end:
        main(list(options))
    assert end.value.code == 0


def test_a_fit_is_combined_with_its_robot_by_the_command(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    pulls_file(tmp_path)
    pulls_file(tmp_path, name="a b.csv")
    options = ["-q", "-r", "gen2", "--no-wheel-inertia", "a b.csv", "--out", "f.yaml"]
    main_ok("calibrate", "friction", *options)
    assert load_fit("f.yaml").command == (
        "srs-twin calibrate friction 'a b.csv' --robot=gen2 --no-wheel-inertia"
        " --out=f.yaml"
    )
    main_ok("calibrate", "robot", "f.yaml", "--name", "mine")
    assert "robot file written to robots/mine.yaml" in capsys.readouterr().err
    mine = load_robot("robots/mine.yaml")
    gen2 = load_robot("gen2")
    fitted = [parameter.value for parameter in load_fit("f.yaml").parameters]
    assert (mine.friction.mu_t, mine.friction.mu_n) == pytest.approx(fitted)
    assert (mine.name, mine.geometry) == ("mine", gen2.geometry)
    for options, message in (
        (
            ["f.yaml", "--name", "mine"],
            "the file already exists; replace it with --overwrite",
        ),
        (["pulls.csv", "--name", "other"], "pulls.csv"),
        (["f.yaml", "--name", "No Name"], "name"),
    ):
        with pytest.raises(SystemExit) as end:
            main(["calibrate", "robot", *options])
        assert end.value.code == 2 and message in capsys.readouterr().err


def test_pressures_of_options_are_converted_to_pascals():
    given = DataOptions("gen2", pressure=48.3).given()
    assert given["supply_pa"] == pytest.approx(48_300) and "pressure" not in given
    assert "supply_pa" not in DataOptions("gen2").given()


def test_an_interrupted_fit_leaves_no_files(tmp_path, monkeypatch, capsys):
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("srs_twin.identification.calibration.fit_pulls", interrupted)
    pulls_file(tmp_path)
    with pytest.raises(SystemExit) as end:
        main(["calibrate", "friction", "pulls.csv", "-r", "gen2"])
    assert end.value.code == 130
    assert capsys.readouterr().err.endswith("interrupted; nothing was written\n")
    assert [path.name for path in tmp_path.iterdir()] == ["pulls.csv"]


def lose_interrupt():
    try:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(1.0)
    except KeyboardInterrupt:
        pass


@pytest.mark.usefixtures("interruptible")
@pytest.mark.parametrize("error", [RuntimeError, InputError, SystemExit, None])
def test_an_error_after_a_lost_interrupt_is_an_interrupt(capsys, monkeypatch, error):
    """Compiled code may lose the interrupt and then fail in another way or continue."""

    def interrupted(*_):
        lose_interrupt()
        if error is not None:
            raise error("a compiled function failed")
        time.sleep(60.0)
        pytest.fail("the interrupt was not repeated")

    with pytest.raises(SystemExit) as end, interruptible("nothing was written"):
        interrupted()
    assert end.value.code == 130
    assert capsys.readouterr().err == "interrupted; nothing was written\n"
    monkeypatch.setattr("srs_twin.cli.app.command", interrupted)
    with pytest.raises(SystemExit) as end:
        main(["doctor"])
    assert end.value.code == 130
    assert signal.getsignal(signal.SIGINT) == signal.default_int_handler


@pytest.mark.usefixtures("interruptible")
def test_a_full_disk_after_an_interrupt_is_reported():
    """Results may be missing, so the message of the interrupt is not enough."""
    with pytest.raises(WriteError, match="no space"), interruptible("nothing"):
        lose_interrupt()
        raise WriteError("no space left on the disk")


# Inputs of fits and replays from recordings


def test_a_replayed_gait_equals_the_gait():
    gait = Gait(1.7, 0.1)
    gait.reset(SPEC, 0.02)
    again = Replay(gait.script(2.0), 1.7)
    runs = [
        rollout(AnalyticalSnake(SPEC, supply_pa=48e3), controller, 2.0)
        for controller in (gait, again)
    ]
    assert (runs[0].com == runs[1].com).all()
    ticks = []  # and tick by tick, as for a plant that follows no script
    for controller in (gait, again):
        plant = AnalyticalSnake(SPEC, supply_pa=48e3)
        state = None
        state = plant.reset()
        controller.reset(SPEC, 0.02)
        for _ in range(40):
            state = plant.step(controller.step(state))
        ticks.append(state.com)
    assert ticks[0] == pytest.approx(ticks[1], abs=1e-12)


def test_replayed_valves_keep_their_last_state_and_check_the_robot():
    states = np.full((2, 4, 2), -1, dtype=np.int8)
    states[1, 0, 0] = 1
    replay = Replay(Schedule(1.0, np.array([0.0, 0.5]), states))
    assert (
        replay.script(3.0).span == 3.0
        and (replay.script(3.0).states[-1] == states[-1]).all()
    )
    assert replay.script(0.4).states.shape[0] == 1
    assert replay.layouts == ("3/2", "in_out")
    assert Replay(Schedule(1.0, np.zeros(1), 0 * states[:1])).layouts == ("in_out",)
    with pytest.raises(
        InputError,
        match="the recorded valves belong to 4 segments, but gen4_module has 1",
    ):
        replay.reset(load_robot("gen4_module"), 0.02)


def test_logs_are_found_next_to_their_recordings():
    assert logs_of(["a/b.csv", "c.csv"], []) == ["a/b.valves.csv", "c.valves.csv"]
    assert logs_of(["a.csv"], ["x.csv"]) == ["x.csv"]
    with pytest.raises(InputError, match="1 valve logs are given for 2 recordings"):
        logs_of(["a.csv", "b.csv"], ["x.csv"])


@pytest.mark.parametrize("carrier", [20.0, 50.0])
def test_the_frequency_of_a_gait_is_not_that_of_its_carrier(carrier):
    clock = np.arange(0.0, 6.0, 0.002)
    fills = clock * carrier % 1 < 0.6
    for filling, expected in (
        (fills & (clock * 1.5 % 1 < 0.5), pytest.approx(1.5, rel=0.02)),
        (fills, None),
    ):
        states = np.where(filling, 1.0, -1.0)[:, None, None] * np.ones((4, 2))
        log = ValveLog("valve", clock, states, "x", "", ())
        assert log.gait_frequency() == expected


@pytest.mark.parametrize(
    ("kind", "vented", "filled"), [("valve", -1.0, 1.0), ("pressure", 0.0, 40e3)]
)
def test_a_recording_with_a_log_becomes_a_gait_run(kind, vented, filled):
    """A chamber is filled from 11 s to 12.5 s; valves of a log of pressures vent."""
    values = np.full((3, 4, 2), vented)
    values[1, 0, 0] = filled
    log = ValveLog(kind, np.array([10.0, 11.0, 12.5]), values, "x", "", ())

    def recorded_from(start: float) -> Recording:
        motion = Trajectory({"time": start + np.arange(0.0, 1.0, 0.01)})
        return Recording(motion, summary=None, valves=log)

    late = recorded_from(11.5)
    assert recorded_from(10.0).starts_at_rest() and not late.starts_at_rest()
    run = gait_run(late, "take", 48e3)
    assert run.controller.frequency is None
    assert (run.chambers is None) == (kind == "valve")
    states = run.controller.script(0.9).states
    expected = np.full((1, 4, 2), -1)
    expected[0, 0, 0] = 1 if kind == "valve" else -1
    assert (states == expected).all()
