"""Simulated recordings of docs/your-robot.md, with parameters that the walk-through has to identify.

``uv run python docs/your_robot.py`` writes calibration/examples/my_snake, with equal
bytes on every run.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from srs_twin import Gait, Trajectory, TwinSnake, load_robot, rollout
from srs_twin.control.replay import Replay
from srs_twin.identification.parameters import with_values
from srs_twin.io.files import atomic_write
from srs_twin.pneumatics import Schedule
from srs_twin.recordings.recorded_pressures import RecordedPressures
from srs_twin.robot.spec import GRAVITY, RobotSpec

sys.path.insert(0, str(Path(__file__).parents[1] / "tests/helpers"))
from decays import Swing  # noqa: E402
from synthetic_takes import Take, write_motive  # noqa: E402

FOLDER = Path(__file__).parents[1] / "calibration/examples/my_snake"
SUPPLY_PA = 48.3e3
HIDDEN = {
    "friction.mu_t": 0.055,
    "friction.mu_n": 0.48,
    "geometry.rigid_gap_m": 0.021,
    "bending.stiffness_nm_per_rad": 0.38,
    "actuator.tau_fill_s": 0.13,
    "actuator.tau_vent_s": 0.09,
    "modules.gain_plus_1": 1.06,
    "modules.gain_minus_1": 0.97,
    "modules.bias_rad_1": 0.03,
    "modules.gain_plus_2": 0.93,
    "modules.gain_minus_2": 1.02,
    "modules.bias_rad_2": -0.02,
    "modules.gain_plus_3": 1.04,
    "modules.gain_minus_3": 1.08,
    "modules.bias_rad_3": 0.0,
    "modules.gain_plus_4": 0.96,
    "modules.gain_minus_4": 0.91,
    "modules.bias_rad_4": 0.025,
}
"""Parameters of the recorded robot that differ from `gen2`."""

_SPRING_N_PER_M = 30.0
_MASS_KG = 0.15
_HUNG_MASS_KG = 0.2
_SENSOR_NOISE_RAD = 0.003
_PROTRACTOR_NOISE_RAD = 0.004
_RISE_S = 0.5
"""Time in which a regulator reaches a pressure, s."""

_REST_S = 0.5
"""Time before the first valve command, s."""

_CLOCK_OFFSET_S = 12.3
"""Clock of the logs minus clock of the cameras, s."""


def hidden_robot() -> RobotSpec:
    """Return the recorded robot."""
    return with_values(load_robot("gen2"), HIDDEN)


def main(folder: Path) -> None:
    """Write all recordings."""
    robot = hidden_robot()
    for name, seed in (("pulls", 1), ("pulls_check", 2)):
        write(folder / f"{name}.csv", pulls(seed))
    for name, seed, pressures in (
        ("held", 3, (12, 24, 36, 48)),
        ("held_check", 4, (18, 42)),
    ):
        write(folder / f"{name}.csv", static_bends(robot, pressures, seed))
    for name, seed, pressures in (
        ("levels", 12, (12, 24, 36, 48)),
        ("levels_check", 13, (18, 42)),
    ):
        write(folder / f"{name}.csv", levels(robot, pressures, seed))
    write(folder / "release.csv", release(robot, 14))
    for name, seed, fills in (
        ("steps", 5, (0.6, 0.35, 0.9)),
        ("steps_check", 6, (0.5, 0.8)),
    ):
        record(
            folder / name,
            robot,
            steps(robot, fills),
            "clamped",
            Take(layout="pair", labeled=True, seed=seed),
        )
    degraded = Take(layout="head", swaps=8, lost=0.02, gap_frames=3.0)
    for name, seed, frequency, offset in (
        ("walk_straight", 7, 2.0, 0.0),
        ("walk_left", 8, 1.6, 0.25),
        ("walk_check", 9, 1.8, -0.15),
    ):
        record(
            folder / name,
            robot,
            walk(robot, frequency, offset),
            "free",
            replace(degraded, seed=seed),
        )


def pulls(seed: int) -> str:
    """Return a table of pulls to measure friction, with a scatter of 4 %."""
    draw = np.random.default_rng(seed)
    weight = _MASS_KG * GRAVITY / _SPRING_N_PER_M
    rows = [
        [
            1e3
            * weight
            * HIDDEN[f"friction.mu_{direction}"]
            * (1 + 0.04 * draw.standard_normal())
            for direction in "tn"
        ]
        for _ in range(8)
    ]
    head = (
        "along_mm,across_mm,spring_n_per_m,mass_kg,spring_error_n_per_m,mass_error_kg"
    )
    return "\n".join(
        [
            head,
            *(
                f"{a:.2f},{b:.2f},{_SPRING_N_PER_M:g},{_MASS_KG:g},0.3,0.001"
                for a, b in rows
            ),
            "",
        ]
    )


def release(robot: RobotSpec, seed: int) -> str:
    """Return a log of the first segment, which hangs with a body at its end, is held bent and is released."""
    draw = np.random.default_rng(seed)
    g = robot.geometry
    chamber = robot.chamber
    bending = robot.bending
    inertia = float(robot.yaw_inertia()[0]) * _HUNG_MASS_KG / robot.mass.connectors[0]
    hung = Swing(
        g.segment_length,
        g.rigid_gap,
        _HUNG_MASS_KG,
        inertia,
        bending.stiffness,
        bending.damping,
        (),
        HIDDEN["modules.bias_rad_1"],
        robot.actuator.gain,
        chamber.dead_volume,
        chamber.displacement,
        closed=False,
        leak=0.0,
        leads=True,
    )
    time = np.arange(-1.0, 2.0, 0.005)
    bend = hung.record(0.5, 0.5, time)[0] + _SENSOR_NOISE_RAD * draw.standard_normal(
        len(time)
    )
    rows = (f"{t + 1:.3f},{q:.4f}" for t, q in zip(time, bend, strict=True))
    return "\n".join(["time_s,bend_rad", *rows, ""])


def static_bends(robot: RobotSpec, levels: tuple[int, ...], seed: int) -> str:
    """Return a table of static bends of a robot clamped at its head; levels: pressures of one side, kPa."""
    draw = np.random.default_rng(seed)
    rows = []
    for level in (0, *levels, *(-level for level in levels)):
        valves = np.full((robot.segments, 2), -1, dtype=np.int8)
        valves[:, 0 if level > 0 else 1] = 1 if level else -1
        plant = TwinSnake(robot, supply_pa=max(1e3 * abs(level), 1.0), base="clamped")
        run = rollout(
            plant, Replay(Schedule(8.0, np.zeros(1), valves[None])), 8.0, record_hz=50
        )
        # The robot oscillates for a long time; the mean is its static bend.
        bend = run.stack("bend")[200:].mean(
            axis=0
        ) + _PROTRACTOR_NOISE_RAD * draw.standard_normal(robot.segments)
        sides = (max(level, 0), max(-level, 0))
        rows.append([*sides * robot.segments, *(f"{angle:.4f}" for angle in bend)])
    numbers = range(1, robot.segments + 1)
    head = [f"pressure_{side}_{j}_kpa" for j in numbers for side in ("plus", "minus")]
    head += [f"bend_{j}_rad" for j in numbers]
    return "\n".join([",".join(head), *(",".join(map(str, row)) for row in rows), ""])


def levels(robot: RobotSpec, levels: tuple[int, ...], seed: int) -> str:
    """Return a log of bends and pressures while a regulator fills one side of free segments; levels: kPa."""
    draw = np.random.default_rng(seed)
    steps = np.repeat([0, *levels, 0, *(-level for level in levels), 0], 2)
    times = np.ravel(
        [(2.5 * k - 2.5 + _RISE_S, 2.5 * k) for k in range(1, len(steps) // 2 + 1)]
    )
    time = np.arange(0.0, times[-1], 0.05)
    level = np.interp(time, times, steps)
    sides = 1e3 * np.stack([np.maximum(level, 0), np.maximum(-level, 0)], axis=-1)
    pressure = np.repeat(sides[:, None], robot.segments, axis=1)
    chambers = RecordedPressures(robot, time, pressure, supply_pa=SUPPLY_PA)
    rest = Schedule(times[-1], np.zeros(1), _vented(robot)[None])
    bend = chambers.advance(rest, time).bend + _SENSOR_NOISE_RAD * draw.standard_normal(
        (len(time), robot.segments)
    )
    numbers = range(1, robot.segments + 1)
    head = ["time", *(f"bend_{j}_rad" for j in numbers)]
    head += [f"pressure_{side}_{j}_kpa" for j in numbers for side in ("plus", "minus")]
    columns = np.hstack(
        [
            bend,
            pressure.reshape(len(time), -1) / 1e3
            + 0.1 * draw.standard_normal((len(time), 1)),
        ]
    )
    rows = [
        ",".join([f"{t:.2f}", *(f"{value:.4g}" for value in row)])
        for t, row in zip(time, columns, strict=True)
    ]
    return "\n".join([",".join(head), *rows, ""])


def steps(robot: RobotSpec, fills: tuple[float, ...]) -> Schedule:
    """Return a valve schedule that fills each side of the last segment in turn; fills: fill times, s."""
    states = [_vented(robot)]
    starts = [0.0]
    time = _REST_S
    for fill in fills:
        for side in (0, 1):
            for state, duration in ((1, fill), (-1, 0.6)):
                valves = _vented(robot)
                valves[-1, side] = state
                states.append(valves)
                starts.append(time)
                time += duration
    return Schedule(round(time + 0.2, 2), np.array(starts), np.array(states))


def walk(
    robot: RobotSpec, frequency: float, offset: float, periods: int = 6
) -> Schedule:
    """Return a valve schedule with a rest, some gait periods and another rest; frequency in Hz."""
    gait = Gait(frequency, offset)
    gait.reset(robot, 0.02)
    crawl = gait.script(round(periods / frequency / 0.02) * 0.02)
    rest = Schedule(_REST_S, np.zeros(1), _vented(robot)[None])
    return rest.followed_by(crawl).followed_by(rest)


def record(
    path: Path, robot: RobotSpec, valves: Schedule, base: str, take: Take
) -> None:
    """Simulate the robot; write the motion capture, and the valve commands on a different clock."""
    plant = TwinSnake(robot, supply_pa=SUPPLY_PA, base=base)
    duration = round(valves.span / plant.tick) * plant.tick
    run = rollout(plant, Replay(valves), duration, pose=(0.4, -0.3, 0.6), record_hz=100)
    write_motive(
        _visible_columns(run), replace(take, digits=2), path.with_suffix(".csv")
    )
    write(path.with_name(path.name + ".valves.csv"), log(valves))


def log(valves: Schedule) -> str:
    """Return a valve log with one row per change and a last row at the end."""
    segments = valves.states.shape[1]
    head = [
        f"valve_{side}_{j}"
        for j in range(1, segments + 1)
        for side in ("plus", "minus")
    ]
    times = [*valves.starts, valves.span]
    rows = [*valves.states, valves.states[-1]]
    lines = [
        f"{time + _CLOCK_OFFSET_S:.4f},"
        + ",".join(str(int(state)) for state in row.ravel())
        for time, row in zip(times, rows, strict=True)
    ]
    return "\n".join([",".join(["time", *head]), *lines, ""])


def write(path: Path, text: str) -> None:
    """Write a file atomically."""
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="")


def _vented(robot: RobotSpec) -> np.ndarray:
    return np.full((robot.segments, 2), -1, dtype=np.int8)


def _visible_columns(run: Trajectory) -> Trajectory:
    """Return the columns that motion capture can measure."""
    prefixes = ("time", "x_", "y_", "connector_heading_")
    return Trajectory(
        {
            name: column
            for name, column in run.columns.items()
            if name.startswith(prefixes)
        }
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else FOLDER)
