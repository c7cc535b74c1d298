"""Static tables from recordings with constant pressures, and the modules recovered from them."""

from __future__ import annotations

from pathlib import Path
from subprocess import CompletedProcess

import numpy as np
import pytest
from recorded import SPEC, csv_text
from scipy import stats
from synthetic_takes import Take, write_motive

from srs_twin import AnalyticalSnake, load_robot, rollout
from srs_twin.control.replay import Replay
from srs_twin.errors import InputError
from srs_twin.identification.fit_file import load_fit
from srs_twin.identification.parameters import with_values
from srs_twin.identification.static_tables import (
    StaticTable,
    _noise_scale,
    fit_static,
    merge_tables,
    plateau_tables,
    read_static_table,
    write_static_table,
)
from srs_twin.pneumatics import LagPneumatics, Schedule
from srs_twin.pneumatics.chambers import air_bend
from srs_twin.recordings.recorded_pressures import RecordedPressures
from srs_twin.recordings.recording import Recording
from srs_twin.recordings.takes import RecordingReader
from srs_twin.robot.spec import RobotSpec

MODULE = load_robot("gen4_module")
OF_MODULE = {
    "modules.gain_plus_1": 1.2,
    "modules.gain_minus_1": 0.8,
    "modules.bias_rad_1": 0.05,
}
TRUE_MODULE = with_values(MODULE, OF_MODULE)
HOLD = 2.5
RISE = 0.5
RATE = 100.0
LEVELS = (6e3, 12e3, 18e3, 24e3)


def levels(seed: int = 0, points: int = 12) -> np.ndarray:
    """Return pressures to hold, one chamber at a time, shape (points, 1, 2), Pa."""
    held = np.zeros((points, 1, 2))
    order = np.random.default_rng(seed).permutation(np.arange(1, points))
    for side, half in enumerate((order[: points // 2], order[points // 2 :])):
        held[np.sort(half), 0, side] = np.resize(LEVELS, len(half))
    return held


def regulated(held: np.ndarray, hold: float = HOLD) -> tuple[np.ndarray, np.ndarray]:
    """Return times (rows,), s, and pressures (rows, segments, 2) of a regulator, Pa."""
    time = np.arange(0.0, hold * len(held), 1 / RATE)
    row = np.minimum((time / hold + 1e-9).astype(int), len(held) - 1)
    before = held[np.maximum(row - 1, 0)]
    since = time - hold * row
    return (
        time,
        before + (held[row] - before) * np.clip(since / RISE, 0, 1)[:, None, None],
    )


def csv(time: np.ndarray, columns: dict[str, np.ndarray]) -> str:
    return csv_text(["time", *columns], np.column_stack([time, *columns.values()]))


def air(
    pressure: np.ndarray,
    kind: str = "pressure",
    unit: str = "_kpa",
    scale: float = 1e-3,
):
    return {
        f"{kind}_{side}_{j + 1}{unit}": scale * pressure[:, j, k]
        for j in range(pressure.shape[1])
        for k, side in enumerate(("plus", "minus"))
    }


def log_of_bends(
    folder: Path,
    time: np.ndarray,
    pressure: np.ndarray,
    *,
    seed=0,
) -> Path:
    """Write the bends at rest and the pressures to one log file."""
    bend = TRUE_MODULE.modules.array("bias") + air_bend(TRUE_MODULE, pressure)
    bend = bend + 1e-3 * np.random.default_rng(seed).standard_normal(bend.shape)
    path = folder / f"held_{seed}.csv"
    path.write_text(csv(time, {"bend_1": bend[:, 0]} | air(pressure)))
    return path


def taken(
    path: Path, spec: RobotSpec, log: Path | None = None, **how: object
) -> tuple[str, Recording]:
    return path.name, RecordingReader(**how).take(str(path), str(log or path), spec)


@pytest.mark.slow
def test_module_is_recovered_from_markers(tmp_path):
    """Marker noise is 0.2 mm, pressure noise 100 Pa, and the log has its own clock."""
    time, pressure = regulated(levels())
    chambers = RecordedPressures(TRUE_MODULE, time, pressure, supply_pa=48e3)
    plant = AnalyticalSnake(
        TRUE_MODULE, supply_pa=48e3, base="clamped", pneumatics=chambers
    )
    vented = Schedule(time[-1], np.zeros(1), np.full((1, 1, 2), -1, dtype=np.int8))
    motion = rollout(plant, Replay(vented), round(time[-1], 1), record_hz=RATE)
    markers = Take(layout="pair", labeled=True, digits=3, seed=4)
    write_motive(motion, markers, tmp_path / "take.csv")
    noise = 100.0 * np.random.default_rng(1).standard_normal(pressure.shape)
    log = tmp_path / "take.valves.csv"
    log.write_text(csv(time + 3.7, air(pressure + noise)))
    take = taken(tmp_path / "take.csv", MODULE, log, head="snake:1a")
    (table,) = plateau_tables([take], MODULE, 48e3)
    assert len(table.bend) == 12
    error = np.median(take[1].trajectory.stack("bend_error"))
    # The systematic error dominates: the noise of so many frames would average out.
    assert np.median(table.bend_error) == pytest.approx(error / 10, rel=0.3)
    fit = fit_static([table], MODULE)
    for name, value in OF_MODULE.items():
        assert fit[name].value == pytest.approx(value, rel=0.01, abs=2e-3), name


@pytest.mark.slow
def test_the_table_of_a_static_fit_gives_the_same_fit(tmp_path, srs_twin):
    time, pressure = regulated(levels())
    for seed in range(2):
        log_of_bends(tmp_path, time, pressure, seed=seed)

    def calibrate(*words: str) -> CompletedProcess[str]:
        robot = ("-r", "gen4_module")
        return srs_twin("calibrate", "actuator", *words, *robot, cwd=tmp_path)

    def fitted(validation: str, name: str) -> CompletedProcess[str]:
        logs = ("--valves", "held_0.csv", "--valves", validation, "--static")
        return calibrate("held_0.csv", "--validate", validation, *logs, "--name", name)

    done = fitted("held_1.csv", "mine")
    assert done.returncode == 0, done.stderr
    table = "calibration/fits/mine.table.csv"
    assert f"12 plateaus written to {table}" in done.stderr
    fit = load_fit(tmp_path / "calibration/fits/mine.yaml")
    assert [data.role for data in fit.data] == ["fit", "validation"]
    assert "--static" in fit.command
    again = calibrate(table, "--out", "again.yaml")
    assert again.returncode == 0, again.stderr
    assert load_fit(tmp_path / "again.yaml").parameters == fit.parameters
    refused = calibrate(table, "--static")
    assert refused.returncode == 2 and "--static: tables of constant" in refused.stderr
    refused = fitted("held_0.csv", "b")
    assert refused.returncode == 2 and "the same data as held_0.csv" in refused.stderr
    assert not (tmp_path / "calibration/fits/b.table.csv").exists()


def test_unmeasured_points_stay_empty(tmp_path):
    table = StaticTable(
        "x",
        "0" * 64,
        np.arange(8.0).reshape(2, 2, 2) / 3,
        np.array([[0.1, np.nan], [np.nan, 1 / 3]]),
        np.full((2, 2), np.nan),
    )
    write_static_table(merge_tables([table, table]), tmp_path / "x.table.csv")
    read = read_static_table(tmp_path / "x.table.csv", SPEC)
    assert (read.pressure[:, :2] == np.tile(table.pressure, (2, 1, 1))).all()
    assert np.isnan(read.bend_error).all()
    bend = np.tile(table.bend, (2, 1))
    assert read.bend[:, :2] == pytest.approx(bend, abs=0, nan_ok=True)


def test_segments_are_weighted_by_their_own_errors():
    """Without errors all segments have the same weight."""
    rng = np.random.default_rng(0)
    error = rng.uniform(1e-3, 1e-2, (5, 4))
    points = ("x", "0" * 64, np.zeros((5, 4, 2)), rng.normal(0.0, 0.01, (5, 4)))
    for table, expected in (
        (StaticTable(*points, error), np.sqrt((error**2).mean(axis=0))),
        (StaticTable(*points), np.full(4, 0.01)),
    ):
        fit = fit_static([table], SPEC, names=["modules.bias_rad_1"])
        scales = [residual.scale for residual in fit.residuals]
        assert scales == pytest.approx(expected, rel=1e-9)


def test_open_valves_give_plateaus_without_a_pressure_log(tmp_path):
    """Filling gives the supply pressure and venting 0; a valve that holds gives no pressure."""
    states = np.array([[-1, -1], [1, -1], [-1, -1], [-1, 1], [-1, -1]], dtype=np.int8)[
        :, None
    ]
    schedule = Schedule(10.0, 2.0 * np.arange(5), states)
    time = np.arange(0.0, 10.0, 1 / RATE)
    trace = LagPneumatics(TRUE_MODULE, supply_pa=40e3, layout="in_out").advance(
        schedule, time
    )
    noise = 1e-3 * np.random.default_rng(3).standard_normal(trace.bend.shape)
    columns = {"bend_1": (trace.bend + noise)[:, 0]}
    valves = states[np.minimum((time / 2 + 1e-9).astype(int), 4)]
    path = tmp_path / "valves.csv"
    path.write_text(csv(time, columns | air(valves, "valve", "", 1)))
    (table,) = plateau_tables([taken(path, MODULE)], MODULE, 40e3)
    assert table.pressure[:, 0].tolist() == [
        [0, 0],
        [40e3, 0],
        [0, 0],
        [0, 40e3],
        [0, 0],
    ]
    fit = fit_static([table], MODULE)
    for name, value in OF_MODULE.items():
        assert fit[name].value == pytest.approx(value, rel=3e-3, abs=1e-3), name
    path.write_text(
        csv(
            time,
            columns
            | air(
                np.where(time < 0.4, -1, 0)[:, None, None] + 0 * valves, "valve", "", 1
            ),
        )
    )
    with pytest.raises(
        InputError,
        match=r"valves\.csv: the recording contains no plateau\. .*a chamber whose"
        r" valves hold \(state 0\) is unknown",
    ):
        plateau_tables([taken(path, MODULE)], MODULE, 40e3)


def test_recordings_without_plateaus_are_refused(tmp_path):
    def refused(pressure: np.ndarray, match: str) -> None:
        path = log_of_bends(tmp_path, time, pressure)
        with pytest.raises(InputError, match=match):
            plateau_tables([taken(path, MODULE)], MODULE, 48e3)

    time, _ = regulated(levels())
    wave = np.zeros((len(time), 1, 2))
    wave[:, 0, 0] = 20e3 * (1 + np.sin(2 * time))
    expected = (
        r"held_0.csv: the recording contains no plateau. The pressures are constant"
        r" for at most 0\.\d+ s, but 0.55 s \(5 times"
        r" the largest"
    )
    refused(wave, expected)
    # A ramp of 1 kPa/s repeatedly stays within the band for 2 s.
    wave[:, 0, 0] = 1e3 * time
    refused(
        wave,
        "no plateau. The pressures are constant for at most 2 s, but .* and"
        " 12 more frames",
    )
    held = levels()
    held[:, 0, 1] = 0
    held[:, 0, 0] = np.resize([0, 12e3], len(held))
    refused(
        regulated(held)[1],
        "the column 'pressure_plus_1' has only 2 different pressures; 3 or more",
    )
    # Bends that creep continuously.
    creeping = np.zeros((len(time), 1, 2))
    path = tmp_path / "creep.csv"
    path.write_text(csv(time, {"bend_1": 0.01 * time} | air(creeping)))
    with pytest.raises(
        InputError,
        match=r"creep.csv: the recording contains no plateau. .* for at most 30 s, but"
        r" .* with settled bends are needed",
    ):
        plateau_tables([taken(path, MODULE)], MODULE, 48e3)


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("rows", [2, 3, 4, 20])
def test_plateaus_are_found_in_logs_with_few_rows_per_plateau(tmp_path, rows):
    """In the two shortest logs most second differences are from steps, not from noise."""
    held = 1e3 * np.array([0.0, 8.0, 16.0, 24.0, 18.0, 10.0, 2.0])
    log_time = np.concatenate(
        [2.5 * k + np.linspace(0.0, 2.0, rows) for k in range(len(held))]
    )
    log = np.zeros((len(log_time), 1, 2))
    log[:, 0, 0] = np.repeat(held, rows)
    (tmp_path / "log.csv").write_text(csv(log_time, air(log)))
    time = np.arange(0.0, log_time[-1], 1 / RATE)
    pressure = np.zeros((len(time), 1, 2))
    pressure[:, 0, 0] = np.interp(time, log_time, log[:, 0, 0])
    noise = 1e-3 * np.random.default_rng(2).standard_normal((len(time), 1))
    bend = TRUE_MODULE.modules.array("bias") + air_bend(TRUE_MODULE, pressure) + noise
    (tmp_path / "bends.csv").write_text(csv(time, {"bend_1": bend[:, 0]}))
    (table,) = plateau_tables(
        [taken(tmp_path / "bends.csv", MODULE, tmp_path / "log.csv")], MODULE, 48e3
    )
    assert table.pressure[:, 0, 0] == pytest.approx(held, abs=1.0)
    # About 140 frames of white noise follow the first 5 τ of each plateau.
    assert np.median(table.bend_error) == pytest.approx(1e-3 / 140**0.5, rel=0.25)
    expected = TRUE_MODULE.modules.array("bias") + air_bend(TRUE_MODULE, table.pressure)
    assert (np.abs(table.bend - expected) < 4 * table.bend_error).all()


@pytest.mark.parametrize(
    ("ramp", "step", "fraction"), [(0.0, 0.0, 0.0), (20.0, 0.0, 0.0), (0.0, 100.0, 0.2)]
)
def test_noise_of_a_log_is_estimated_without_ramps_and_steps(ramp, step, fraction):
    """Steps in a share of the differences move the median to a higher quantile of the noise."""
    row = np.arange(20_000)
    noise = np.random.default_rng(0).standard_normal(len(row))
    fit = _noise_scale((noise + ramp * row + step * (row // 5 % 7))[:, None])
    assert fit == pytest.approx(
        6**0.5 * stats.norm.ppf(0.5 + 0.25 / (1 - fraction)), rel=0.03
    )
    assert np.isfinite(_noise_scale(noise[:2]))


def test_the_start_of_creep_is_excluded(tmp_path):
    """Bends settle within seconds; only the end of a plateau is averaged."""
    time = np.arange(0.0, 12.0, 1 / RATE)
    bend = (
        0.5
        - 0.1 * np.exp(-time)
        + 1e-3 * np.random.default_rng(0).standard_normal(len(time))
    )
    path = tmp_path / "slow.csv"
    path.write_text(csv(time, {"bend_1": bend} | air(np.full((len(time), 1, 2), 10e3))))
    (table,) = plateau_tables([taken(path, MODULE)], MODULE, 48e3)
    assert table.bend[0, 0] == pytest.approx(0.5, abs=1e-3)
