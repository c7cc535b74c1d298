"""What the damping of the bends does: spectra, damping times, a material of constant loss, and speeds.

    uv run python benchmarks/damping.py [--spectra] [--material] [--steps] [--table]
    [--picture FILE]

`--spectra`: frequencies at which the bends deviate from the free bends, and the damping
times that give the loss factor of docs/planar-models.md#damping there. `--material`: speeds with a
material whose loss factor hardly depends on the frequency (three Maxwell branches), and
with a damper of the same loss. `--steps`: speeds for several damping times and steps,
with both readings of the delay. `--table`: speeds over stiffness and loss factor.
`--picture`: the spectra as curves.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from common.grid import table
from matplotlib.figure import Figure
from scipy.optimize import least_squares

from srs_twin import AnalyticalSnake, Gait, RobotSpec, TwinSnake, load_robot, rollout
from srs_twin.comparison.metrics import plant_metrics
from srs_twin.plants.twin.mjcf.numerics import stable_step
from srs_twin.pneumatics import Schedule, Trace
from srs_twin.pneumatics.lag import LagPneumatics

sys.path.append(str(Path(__file__).parents[1] / "tests/helpers"))
from free_bends import free_bends

LOSS, FACTOR = 0.12, 1.5
"""Median and factor of the loss factor (docs/planar-models.md#damping)."""
BRANCH_TIMES_S = (0.4, 0.04, 0.004)
"""Relaxation times of the Maxwell branches, s."""
BAND_HZ = np.geomspace(0.3, 40, 60)
"""Frequencies at which the loss factor of the branches is fitted, Hz."""
SAMPLES_HZ = 1000
PERIODS = 8


@dataclass(frozen=True)
class Case:
    """A gait of a robot.

    Attributes:
        robot: name.
        frequency: Hz.
        offset: 1.
        supply_pa: Pa.
    """

    robot: str
    frequency: float
    offset: float
    supply_pa: float

    @property
    def name(self) -> str:
        """Name in tables."""
        offset = f", offset {self.offset:g}" if self.offset else ""
        return f"{self.robot}, {self.frequency:g} Hz{offset}"

    @property
    def duration(self) -> float:
        """Duration of a run, a whole number of ticks, s."""
        return round(PERIODS / self.frequency / 0.02) * 0.02

    def run(self, plant: AnalyticalSnake | TwinSnake, record_hz: float = 50.0) -> Any:
        """Return the trajectory of the gait."""
        return rollout(
            plant, Gait(self.frequency, self.offset), self.duration, record_hz=record_hz
        )

    def speeds(self, plant: AnalyticalSnake | TwinSnake) -> tuple[float, float]:
        """Return speed (mm/s) and yaw rate (rad/s) of the gait."""
        metrics = plant_metrics(self.run(plant))
        return 1e3 * metrics["com_speed_m_s"], metrics["yaw_rate_rad_s"]


CASES = (
    Case("gen1", 0.33, 0.0, 25.9e3),
    Case("gen1", 1.0, 0.0, 25.9e3),
    Case("gen2", 1.0, 0.0, 48.3e3),
    Case("gen2", 2.0, 0.0, 48.3e3),
    Case("gen2", 2.0, 0.2, 48.3e3),
    Case("gen3", 0.9, 0.0, 48.3e3),
    Case("gen4", 1.5, 0.0, 51e3),
    Case("gen4", 1.5, 0.3, 51e3),
)


def damped(spec: RobotSpec, time: float) -> RobotSpec:
    """Return a robot with another damping time of its bends, s."""
    return replace(spec, bending=replace(spec.bending, damping_time=time))


def deviations(case: Case, spec: RobotSpec) -> np.ndarray:
    """Return q − q_f of the twin in a gait, shape (samples, segments), rad, without the first half."""
    twin = TwinSnake(spec, supply_pa=case.supply_pa)
    run = case.run(twin, SAMPLES_HZ)
    free = free_bends(twin, Gait(case.frequency, case.offset), run.time).bend
    return (run.stack("bend") - free)[len(run.time) // 2 :]


def spectrum(case: Case, spec: RobotSpec) -> tuple[np.ndarray, np.ndarray]:
    """Return frequencies (Hz) and the power of q − q_f summed over the segments (rad² per line)."""
    values = deviations(case, spec)
    power = (np.abs(np.fft.rfft(values - values.mean(axis=0), axis=0)) ** 2).sum(axis=1)
    return np.fft.rfftfreq(len(values), 1 / SAMPLES_HZ), power


def equivalent_frequency(frequency: np.ndarray, power: np.ndarray) -> float:
    """Return the frequency at which a damper must have the loss factor, Hz.

    A damper dissipates in proportion to f² |E|², a material of constant loss to f |E|².
    Both dissipate the same if the loss factors are equal at Σ f² |E|² / Σ f |E|².
    """
    return float((frequency**2 * power).sum() / (frequency * power).sum())


def damping_time(case: Case, loss: float) -> tuple[float, float]:
    """Return the damping time (s) that gives a loss factor, and the frequency of that factor (Hz)."""
    spec = load_robot(case.robot)
    time = 0.004
    found = 0.0
    for _ in range(6):
        found = equivalent_frequency(*spectrum(case, damped(spec, time)))
        time = loss / (2 * np.pi * found)
    return time, found


class ConstantLoss(LagPneumatics):
    """Chambers in a material with Maxwell branches, which are expressed as a change of the free bends.

    A branch has the moment k_b (e − z) with e = q_f − q and τ_b ż = e − z. The moments
    of spring and branches are those of a stiffer spring with the free bend q_f − Σ k_b
    z / K, where K is the sum of all stiffnesses. Within a step e changes linearly, as
    in the plant.
    """

    depends_on_bend = True

    def __init__(
        self, spec: RobotSpec, fractions: np.ndarray, *, supply_pa: float, step: float
    ) -> None:
        """Take the stiffness of each branch over that of the spring."""
        self._fractions = fractions / (1 + fractions.sum())
        self._times = np.array(BRANCH_TIMES_S)
        self.coupling_step_s = step
        super().__init__(spec, supply_pa=supply_pa)

    def reset(self) -> None:
        """Relax the branches."""
        super().reset()
        self._branches = np.zeros((len(self._times), self._segments))

    def _simulate(
        self,
        schedule: Schedule,
        times: np.ndarray,
        bend: np.ndarray | None,
        bend_rate: np.ndarray | None,
    ) -> Trace:
        before = self.bend.copy()
        trace = super()._simulate(schedule, times, bend, bend_rate)
        if bend is None or bend_rate is None or not schedule.span:
            return trace
        speed = (self.bend - before) / schedule.span - bend_rate
        at = self._follow(before - bend, speed, times)
        end = self._follow(before - bend, speed, np.array([schedule.span]))
        trace.bend[:] -= np.einsum("b,btj->tj", self._fractions, at[0])
        trace.bend_rate[:] -= np.einsum("b,btj->tj", self._fractions, at[1])
        self._branches = end[0][:, 0]
        return trace

    def _follow(
        self, start: np.ndarray, speed: np.ndarray, times: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return z and ż of the branches at times (s) of a linear change of e, shape (branches, times, n)."""
        tau = self._times[:, None, None]
        t = times[None, :, None]
        rest = start - speed * tau
        decay = np.exp(-t / tau) * (self._branches[:, None] - rest)
        return rest + speed * t + decay, speed - decay / tau


def branches(loss: float) -> np.ndarray:
    """Return the stiffnesses of branches over that of the spring, for a loss factor."""

    def error(fractions: np.ndarray) -> np.ndarray:
        found = modulus(fractions, BAND_HZ)
        return found.imag / found.real / loss - 1

    return least_squares(
        error, np.full(len(BRANCH_TIMES_S), loss / 2), bounds=(0, np.inf)
    ).x


def modulus(fractions: np.ndarray, frequency: float | np.ndarray) -> np.ndarray:
    """Return the complex stiffness at frequencies (Hz) over that of the spring, in their shape."""
    phase = 2j * np.pi * np.multiply.outer(frequency, BRANCH_TIMES_S)
    return np.asarray(1 + (fractions * phase / (1 + phase)).sum(axis=-1))


def material_plant(
    case: Case, loss: float, frequency: float, step: float
) -> AnalyticalSnake:
    """Return `compliant` with Maxwell branches and the stiffness of the robot file at a frequency (Hz)."""
    spec = load_robot(case.robot)
    fractions = branches(loss)
    spring = spec.bending.stiffness / modulus(fractions, frequency).real
    whole = replace(
        spec.bending, stiffness=spring * (1 + fractions.sum()), damping_time=1e-6
    )
    spec = replace(spec, bending=whole)
    chambers = ConstantLoss(spec, fractions, supply_pa=case.supply_pa, step=step)
    return AnalyticalSnake(
        spec,
        model="compliant",
        friction="wheel",
        inertia="connector",
        timestep=step,
        pneumatics=chambers,
    )


def compliant(case: Case, spec: RobotSpec, step: float) -> AnalyticalSnake:
    """Return `compliant` with the damper of a robot."""
    return AnalyticalSnake(
        spec,
        model="compliant",
        friction="wheel",
        inertia="connector",
        timestep=step,
        supply_pa=case.supply_pa,
    )


def show_spectra() -> None:
    """Print damping times and the frequencies of the deviations."""
    rows = []
    for case in CASES:
        time, frequency = damping_time(case, LOSS)
        power = spectrum(case, damped(load_robot(case.robot), time))
        fraction = np.cumsum(power[0] * power[1]) / (power[0] * power[1]).sum()
        low, middle, high = (
            power[0][np.searchsorted(fraction, level)] for level in (0.1, 0.5, 0.9)
        )
        times = [
            f"{1e3 * loss / (2 * np.pi * frequency):.1f}"
            for loss in (LOSS, LOSS / FACTOR**2, LOSS * FACTOR**2)
        ]
        rows.append(
            [
                case.name,
                f"{frequency:.1f}",
                f"{low:.1f}",
                f"{middle:.1f}",
                f"{high:.1f}",
                *times,
            ]
        )
    head = [
        "gait",
        "f, Hz",
        "10 % below, Hz",
        "50 %",
        "90 %",
        "T, ms",
        "lower",
        "upper",
    ]
    print(table(head, rows))


def draw_spectra(file: Path) -> None:
    """Draw the loss of a material of constant loss below each frequency, over the frequency."""
    figure = Figure(figsize=(6, 3.2), layout="constrained")
    axes = figure.subplots()
    for case in CASES:
        time, _ = damping_time(case, LOSS)
        frequency, power = spectrum(case, damped(load_robot(case.robot), time))
        loss = np.cumsum(frequency * power)
        axes.semilogx(frequency[1:], loss[1:] / loss[-1], label=case.name)
    axes.set(
        xlim=(0.2, 100),
        xlabel="frequency (Hz)",
        ylabel="share of the loss below",
        ylim=(0, 1),
    )
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7)
    figure.savefig(file, dpi=120)


def show_material(step: float = 2.5e-4) -> None:
    """Print speeds with a constant loss factor and with a damper."""
    print("branches:", np.round(branches(LOSS), 4))
    rows = []
    for case in CASES:
        time, frequency = damping_time(case, LOSS)
        damper = case.speeds(
            compliant(case, damped(load_robot(case.robot), time), step)
        )
        material = case.speeds(material_plant(case, LOSS, frequency, step))
        change = 100 * (material[0] / damper[0] - 1)
        rows.append(
            [
                case.name,
                f"{1e3 * time:.1f}",
                f"{damper[0]:.1f} ({damper[1]:.3f})",
                f"{material[0]:.1f} ({material[1]:.3f})",
                f"{change:+.1f}",
            ]
        )
        print(rows[-1], flush=True)
    print(
        table(
            ["gait", "T, ms", "damper, mm/s (rad/s)", "constant loss", "difference, %"],
            rows,
        )
    )


def show_steps() -> None:
    """Print speeds for damping times and steps, with both readings of the delay, and of `compliant`."""
    rows = []
    # Generation 1 is left out, because its bends vibrate at 1.7 Hz, where the damping
    # has no effect.
    for case in CASES[2:]:
        for time in (0.00214, 0.004, 0.008, 0.012, 0.016):
            robot = damped(load_robot(case.robot), time)
            cells = [
                case.speeds(TwinSnake(robot, supply_pa=case.supply_pa, timestep=h))
                for h in (0.001, 0.0005, 0.00025)
            ]
            cells.append(
                case.speeds(TwinSnake(without_lead(robot), supply_pa=case.supply_pa))
            )
            cells.append(case.speeds(compliant(case, robot, 5e-4)))
            rows.append(
                [
                    case.name,
                    f"{1e3 * time:g}",
                    *(f"{v:.1f} ({w:.3f})" for v, w in cells),
                ]
            )
            print(rows[-1], flush=True)
    print(
        table(
            ["gait", "T, ms", "1 ms", "0.5 ms", "0.25 ms", "no lead", "compliant"], rows
        )
    )


def without_lead(spec: RobotSpec) -> RobotSpec:
    """Return a robot whose damping delays the free bend, with the same delay in all (`bending.lead`)."""
    delay = spec.bending.damping_time - spec.actuator.tau_mode
    actuator = replace(
        spec.actuator,
        tau_mode=spec.bending.damping_time,
        tau_fill=spec.actuator.tau_fill - delay,
        tau_vent=spec.actuator.tau_vent - delay,
    )
    return replace(spec, actuator=actuator)


def show_table() -> None:
    """Print speeds of the twin over stiffness and loss factor."""
    rows = []
    for case in CASES:
        nominal = load_robot(case.robot)
        _, frequency = damping_time(case, LOSS)
        model = case.speeds(
            AnalyticalSnake(
                nominal, friction="wheel", inertia="connector", supply_pa=case.supply_pa
            )
        )
        for loss in (LOSS / FACTOR**2, LOSS, LOSS * FACTOR**2):
            time = loss / (2 * np.pi * frequency)
            cells = []
            for factor in (0.5, 1.0, 2.0):
                bending = replace(
                    nominal.bending,
                    damping_time=time,
                    stiffness=factor * nominal.bending.stiffness,
                )
                step = stable_step(0.001, time)
                plant = TwinSnake(
                    replace(nominal, bending=bending),
                    supply_pa=case.supply_pa,
                    timestep=step,
                )
                speed, yaw = case.speeds(plant)
                turn = f", {yaw:.2f} rad/s" if case.offset else ""
                cells.append(
                    f"{speed:.0f} ({100 * (speed / model[0] - 1):+.0f} %{turn})"
                )
            rows.append([case.name, f"{loss:.3f}", f"{1e3 * time:.2f}", *cells])
            print(rows[-1], flush=True)
    print(table(["gait", "η", "T, ms", "k/2", "k", "2 k"], rows))


def main() -> None:
    """Print the tables that the options ask for."""
    words = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    shows = {
        "--spectra": show_spectra,
        "--material": show_material,
        "--steps": show_steps,
        "--table": show_table,
    }
    for name, show in shows.items():
        words.add_argument(name, dest="shows", action="append_const", const=show)
    words.add_argument("--picture", type=Path)
    options = words.parse_args()
    for show in options.shows or ():
        show()
    if options.picture:
        draw_spectra(options.picture)


if __name__ == "__main__":
    main()
