"""Static tables from recordings with constant pressures, and the modules recovered from them."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from recorded import SPEC
from scipy import stats
from synthetic_takes import Take, write_motive

from srs_twin import AnalyticalSnake, Trajectory, load_robot, rollout
from srs_twin.control.replay import Replay
from srs_twin.errors import InputError
from srs_twin.identification.estimate import FitEstimate
from srs_twin.identification.fit_file import load_fit
from srs_twin.identification.parameters import with_values
from srs_twin.identification.static_tables import (
    StaticTable,
    _noise_scale,
    fit_static,
    is_static_table,
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
OF_CHAIN = {
    f"modules.{name}_{j + 1}": value
    for name, values in {
        "gain_plus": (1.06, 0.93, 1.04, 0.96),
        "gain_minus": (0.97, 1.02, 1.08, 0.91),
        "bias_rad": (0.03, -0.02, 0.0, 0.025),
    }.items()
    for j, value in enumerate(values)
}
TRUE_MODULE = with_values(MODULE, OF_MODULE)
TRUE_CHAIN = with_values(SPEC, OF_CHAIN)
HOLD = 2.5
RISE = 0.5
RATE = 100.0
LEVELS = (6e3, 12e3, 18e3, 24e3)


def levels(segments: int, seed: int = 0, points: int = 12) -> np.ndarray:
    """Return pressures to hold, one chamber of each segment at a time, shape (points, segments, 2), Pa."""
    random = np.random.default_rng(seed)
    held = np.zeros((points, segments, 2))
    for j in range(segments):
        order = random.permutation(np.arange(1, points))
        for side, half in enumerate((order[: points // 2], order[points // 2 :])):
            held[np.sort(half), j, side] = np.resize(LEVELS, len(half))
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


@cache
def bench(robot: RobotSpec) -> tuple[Trajectory, np.ndarray]:
    """Return a robot that hangs from its head under constant pressures, and the pressures."""
    time, pressure = regulated(levels(robot.segments))
    chambers = RecordedPressures(robot, time, pressure, supply_pa=48e3)
    plant = AnalyticalSnake(robot, supply_pa=48e3, base="clamped", pneumatics=chambers)
    vented = Schedule(
        time[-1], np.zeros(1), np.full((1, robot.segments, 2), -1, dtype=np.int8)
    )
    return rollout(plant, Replay(vented), round(time[-1], 1), record_hz=RATE), pressure


def csv(time: np.ndarray, columns: dict[str, np.ndarray]) -> str:
    rows = np.column_stack([time, *columns.values()])
    return "\n".join(
        [
            ",".join(["time", *columns]),
            *(",".join(f"{v:.9g}" for v in r) for r in rows),
            "",
        ]
    )


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
    robot: RobotSpec,
    time: np.ndarray,
    pressure: np.ndarray,
    *,
    noise=1e-3,
    seed=0,
    **columns,
) -> Path:
    """Write the bends at rest and the pressures, or other columns, to one log file."""
    bend = robot.modules.array("bias") + air_bend(robot, pressure)
    bend = bend + noise * np.random.default_rng(seed).standard_normal(bend.shape)
    path = folder / f"held_{seed}.csv"
    named = {f"bend_{j + 1}": column for j, column in enumerate(bend.T)}
    path.write_text(csv(time, named | (columns or air(pressure))))
    return path


def taken(
    path: Path, spec: RobotSpec, log: Path | None = None, **how: object
) -> tuple[str, Recording]:
    return path.name, RecordingReader(**how).take(str(path), str(log or path), spec)


def hits(fit: FitEstimate, truth: dict[str, float]) -> int:
    return sum(
        fit[name].low <= value <= fit[name].high for name, value in truth.items()
    )


@pytest.mark.nightly
def test_modules_are_recovered_from_bend_logs(tmp_path):
    """60 intervals with 95 %: fewer than 51 hits have a probability below 1 in 1,000."""
    total = 0
    time_and_pressure = regulated(levels(4))
    for seed in range(5):
        path = log_of_bends(tmp_path, TRUE_CHAIN, *time_and_pressure, seed=seed)
        (table,) = plateau_tables([taken(path, SPEC)], SPEC, 48e3)
        assert table.bend.shape == (12, 4) and np.isfinite(table.bend).all()
        # About 115 frames of white noise follow the first 5 τ.
        assert np.median(table.bend_error) == pytest.approx(1e-3 / 115**0.5, rel=0.25)
        difference = (
            table.bend
            - TRUE_CHAIN.modules.array("bias")
            - air_bend(TRUE_CHAIN, table.pressure)
        )
        assert np.sqrt(np.mean((difference / table.bend_error) ** 2)) == pytest.approx(
            1.0, abs=0.3
        )
        fit = fit_static([table], SPEC)
        assert fit.residual_scale == pytest.approx(0.9, abs=0.35)
        total += hits(fit, OF_CHAIN)
        for name, value in OF_CHAIN.items():
            assert fit[name].value == pytest.approx(value, rel=2e-3, abs=5e-4), name
    assert stats.binom.cdf(50, 60, 0.95) < 1e-3
    assert total >= 51


@pytest.mark.slow
@pytest.mark.parametrize(
    ("robot", "truth"),
    [
        pytest.param(TRUE_CHAIN, OF_CHAIN, marks=pytest.mark.slow),
        (TRUE_MODULE, OF_MODULE),
    ],
)
def test_modules_are_recovered_from_markers(tmp_path, robot, truth):
    """Marker noise is 0.2 mm, pressure noise 100 Pa, and the log has its own clock."""
    motion, pressure = bench(robot)
    spec = with_values(
        robot, dict.fromkeys(truth, 1.0) | {k: 0.0 for k in truth if "bias" in k}
    )
    write_motive(
        motion,
        Take(layout="pair", labeled=True, digits=3, seed=4),
        tmp_path / "take.csv",
    )
    noise = 100.0 * np.random.default_rng(1).standard_normal(pressure.shape)
    time = np.arange(len(pressure)) / RATE + 3.7
    (tmp_path / "take.valves.csv").write_text(csv(time, air(pressure + noise)))
    take = taken(
        tmp_path / "take.csv", spec, tmp_path / "take.valves.csv", head="snake:1a"
    )
    (table,) = plateau_tables([take], spec, 48e3)
    assert len(table.bend) == 12
    error = np.median(take[1].trajectory.stack("bend_error"))
    # The systematic error dominates: the noise of so many frames would average out.
    assert np.median(table.bend_error) == pytest.approx(error / 10, rel=0.3)
    fit = fit_static([table], spec)
    assert hits(fit, truth) >= (9 if len(truth) > 3 else 2)
    for name, value in truth.items():
        assert fit[name].value == pytest.approx(value, rel=0.01, abs=2e-3), name


@pytest.mark.slow
def test_the_table_gives_the_same_fit_from_the_command_line(tmp_path, srs_twin):
    """Two takes are fitted together and one validates; recordings and their tables give the same fit."""
    time, pressure = regulated(levels(1))
    for seed in range(3):
        log_of_bends(tmp_path, TRUE_MODULE, time, pressure, seed=seed)
    options = [
        "calibrate",
        "actuator",
        "held_0.csv",
        "held_1.csv",
        "--validate",
        "held_2.csv",
        "-r",
        "gen4_module",
    ]
    logs = [word for seed in range(3) for word in ("--valves", f"held_{seed}.csv")]
    done = srs_twin(*options, *logs, "--static", "--name", "mine", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "24 plateaus written to calibration/fits/mine.table.csv" in done.stderr
    fit = load_fit(tmp_path / "calibration/fits/mine.yaml")
    assert [data.role for data in fit.data] == [
        "fit",
        "fit",
        "validation",
    ] and "--static" in fit.command
    path = tmp_path / "calibration/fits/mine.table.csv"
    again = srs_twin(
        "calibrate",
        "actuator",
        str(path),
        "-r",
        "gen4_module",
        "--out",
        "again.yaml",
        cwd=tmp_path,
    )
    assert again.returncode == 0, again.stderr
    assert load_fit(tmp_path / "again.yaml").parameters == fit.parameters
    takes = [taken(tmp_path / f"held_{seed}.csv", MODULE) for seed in range(2)]
    table = merge_tables(plateau_tables(takes, MODULE, 48e3))
    read = read_static_table(path, MODULE)
    for name in ("pressure", "bend", "bend_error"):
        assert (getattr(table, name) == getattr(read, name)).all()
    assert is_static_table(path) and not is_static_table(tmp_path / "held_0.csv")
    options = ["calibrate", "actuator", str(path), "-r", "gen4_module"]
    refused = srs_twin(*options, "--static", cwd=tmp_path)
    assert refused.returncode == 2 and "--static: tables of constant" in refused.stderr
    same = [
        "calibrate",
        "actuator",
        "held_0.csv",
        "--validate",
        "held_0.csv",
        "-r",
        "gen4_module",
        "--static",
    ]
    refused = srs_twin(
        *same, *(["--valves", "held_0.csv"] * 2), "--name", "b", cwd=tmp_path
    )
    assert refused.returncode == 2 and "the same data as held_0.csv" in refused.stderr
    assert not (tmp_path / "calibration/fits/b.table.csv").exists()


def test_unmeasured_points_stay_empty(tmp_path):
    table = StaticTable(
        "x",
        "0" * 64,
        np.arange(8.0).reshape(2, 2, 2) / 3,
        np.array([[0.1, np.nan], [np.nan, 1 / 3]]),
    )
    write_static_table(table, tmp_path / "x.table.csv")
    read = read_static_table(tmp_path / "x.table.csv", SPEC)
    assert (read.pressure[:, :2] == table.pressure).all() and np.isnan(
        read.bend_error
    ).all()
    assert read.bend[:, :2] == pytest.approx(table.bend, abs=0, nan_ok=True)


@pytest.mark.slow
def test_segments_are_weighted_by_their_own_errors(tmp_path):
    """Without errors all segments have the same weight."""
    time, pressure = regulated(levels(4))
    (table,) = plateau_tables(
        [taken(log_of_bends(tmp_path, TRUE_CHAIN, time, pressure, noise=3e-3), SPEC)],
        SPEC,
        48e3,
    )
    scales = [residual.scale for residual in fit_static([table], SPEC).residuals]
    assert scales == pytest.approx(
        np.sqrt((table.bend_error**2).mean(axis=0)), rel=1e-9
    )
    plain = StaticTable(table.name, table.sha256, table.pressure, table.bend)
    assert {residual.scale for residual in fit_static([plain], SPEC).residuals} == {
        0.01
    }


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
    assert hits(fit, OF_MODULE) >= 2
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
    def refused(
        pressure: np.ndarray, time: np.ndarray, match: str, spec: RobotSpec = MODULE
    ) -> None:
        path = log_of_bends(tmp_path, TRUE_MODULE, time, pressure)
        with pytest.raises(InputError, match=match):
            plateau_tables([taken(path, spec)], spec, 48e3)

    time, _ = regulated(levels(1))
    wave = np.zeros((len(time), 1, 2))
    wave[:, 0, 0] = 20e3 * (1 + np.sin(2 * time))
    expected = (
        r"held_0.csv: the recording contains no plateau. The pressures are constant"
        r" for at most 0\.\d+ s, but 0.55 s \(5 times"
        r" the largest"
    )
    refused(wave, time, expected)
    # A ramp of 1 kPa/s repeatedly stays within the band for 2 s.
    wave[:, 0, 0] = 1e3 * time
    refused(
        wave,
        time,
        "no plateau. The pressures are constant for at most 2 s, but .* and"
        " 12 more frames",
    )
    held = levels(1)
    held[:, 0, 1] = 0
    held[:, 0, 0] = np.resize([0, 12e3], len(held))
    refused(
        regulated(held)[1],
        time,
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
