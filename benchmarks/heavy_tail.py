"""Two unexplained observations of generation 3 (Section 3.4.3): the bend amplitudes and the lifting tail.

    uv run python benchmarks/heavy_tail.py

Prints bend amplitudes by segment of the twin, `compliant` and `complete` over the gait
range, stiffness and damping, and the amplitudes of `compliant` with single effects
switched off. Then prints the wheel loads of the twin over a period, where the tail
rests on the two wheels of the last connector, and the effect of a tail with two axles
on instantaneous loads. Writes docs/images/heavy_tail.png.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from grid import table
from matplotlib.figure import Figure

from srs_twin import AnalyticalSnake, Gait, RobotSpec, TwinSnake, load_robot, rollout
from srs_twin.comparison.metrics import plant_metrics
from srs_twin.robot.spec import GRAVITY, Tail
from srs_twin.viewing.plots.style import STYLES

IMAGE = Path(__file__).parents[1] / "docs" / "images" / "heavy_tail.png"
SUPPLY = 48.3e3
DURATION = 8.0  # s
GAITS = [(f, offset) for f in (0.75, 1.0) for offset in (0.0, 0.2, -0.2)] + [(2.0, 0.0)]
STIFFNESS = (0.1, 0.15, 0.2, 0.3, 0.44, 0.7, 1.0, 2.0, 5.0)
HEIGHTS = (0.015, 0.020, 0.030)
DAMPING = (0.00214, 0.005, 0.01, 0.02)
SILICONE = 0.01  # s, c/k from the loss factor of silicone
SLOW = 0.1
# For an assembly 8 cm long; the dissertation gives no dimensions.
TAILS = [
    None,
    *(
        Tail(axle=0.06, com=0.045, com_height=h, gyration=0.025)
        for h in (0.015, 0.02, 0.025, 0.03)
    ),
]
PLANTS = ("twin", "compliant", "complete")
# Palette of Okabe and Ito for colour-blind readers; markers and dashes differ as well.
COLORS = (STYLES["twin"].color, STYLES["analytical"].color, "#009E73", "#222222")
LOAD_TICK = 0.005

Change = Callable[[RobotSpec], RobotSpec]


def equal_tail(spec: RobotSpec) -> RobotSpec:
    """Return the robot with a tail as light as the other connectors."""
    return with_masses(spec, spec.mass.array()[:1].repeat(len(spec.mass.connectors)))


def quasi_static(spec: RobotSpec) -> RobotSpec:
    """Return the robot with a tenth of its inertia and unchanged friction."""
    mu = spec.friction
    light = with_masses(spec, SLOW * spec.mass.array())
    return replace(
        light, friction=replace(mu, mu_t=mu.mu_t / SLOW, mu_n=mu.mu_n / SLOW)
    )


def frictionless(spec: RobotSpec) -> RobotSpec:
    """Return the robot without friction."""
    return replace(spec, friction=replace(spec.friction, mu_t=0.0, mu_n=0.0))


def with_masses(spec: RobotSpec, masses: np.ndarray) -> RobotSpec:
    """Return the robot with other connector masses (kg) and proportional wheel masses."""
    wheel = spec.mass.wheel * min(1.0, masses.min() / spec.mass.array().min())
    return replace(
        spec, mass=replace(spec.mass, connectors=tuple(masses), wheel=float(wheel))
    )


SWITCHES: list[tuple[str, tuple[Change, ...], dict[str, Any]]] = [
    ("none", (), {}),
    ("light tail", (equal_tail,), {}),
    ("point masses", (), {"inertia": "point"}),
    ("a tenth of the inertia", (quasi_static,), {}),
    ("light tail and a tenth of the inertia", (equal_tail, quasi_static), {}),
    ("no friction", (frictionless,), {}),
    ("`axis` law", (), {"friction": "axis"}),
    ("`ellipse` law", (), {"friction": "ellipse"}),
]


@dataclass(frozen=True)
class Case:
    """One run of generation 3: a plant and a gait with changes."""

    plant: str
    frequency: float = 1.0
    offset: float = 0.0
    stiffness: float | None = None
    damping_time: float | None = None
    height: float | None = None
    changes: tuple[Change, ...] = ()
    options: dict[str, Any] = field(default_factory=dict)

    def spec(self) -> RobotSpec:
        """Return the robot of this case."""
        spec = load_robot("gen3")
        if self.stiffness is not None:
            spec = replace(
                spec, bending=replace(spec.bending, stiffness=self.stiffness)
            )
        if self.damping_time is not None:
            spec = replace(
                spec, bending=replace(spec.bending, damping_time=self.damping_time)
            )
        if self.height is not None:
            spec = replace(
                spec, geometry=replace(spec.geometry, com_height=self.height)
            )
        for change in self.changes:
            spec = change(spec)
        return spec

    def amplitudes(self) -> np.ndarray:
        """Return the bend amplitude of each segment, head first, rad."""
        if self.plant == "twin":
            plant: Any = TwinSnake(self.spec(), supply_pa=SUPPLY)
        else:
            inertia = "connector" if self.plant == "compliant" else "point"
            options = {
                "friction": "wheel",
                "inertia": inertia,
                "timestep": 0.001,
            } | self.options
            plant = AnalyticalSnake(
                self.spec(), model=self.plant, supply_pa=SUPPLY, **options
            )
        run = rollout(plant, Gait(self.frequency, self.offset), DURATION)
        return np.array(plant_metrics(run)["bend_amplitude_rad"])

    def loads(self) -> tuple[np.ndarray, np.ndarray]:
        """Return wheel loads relative to rest, shape (samples, N, 2), and the acceleration of the tail, g.

        The acceleration has shape (samples, 2), along and across the tail. Samples
        cover whole periods after the first two, every 5 ms.
        """
        plant = TwinSnake(self.spec(), supply_pa=SUPPLY, tick=LOAD_TICK)
        loads = []
        places = []
        headings = []

        def watch(state: Any) -> None:
            loads.append(plant.physics.wheel_loads())
            places.append(state.position[-1])
            headings.append(state.connector_heading[-1])

        rollout(plant, Gait(self.frequency, self.offset), DURATION, observers=[watch])
        settled = round(2 / self.frequency / LOAD_TICK)
        rate = np.gradient(
            np.gradient(np.array(places), LOAD_TICK, axis=0), LOAD_TICK, axis=0
        )
        c = np.cos(headings)
        s = np.sin(headings)
        along = np.stack(
            [rate[:, 0] * c + rate[:, 1] * s, rate[:, 1] * c - rate[:, 0] * s], axis=-1
        )
        rest = plant.spec.mass.array()[:, None] * GRAVITY / 2
        return np.array(loads)[settled:] / rest, along[settled:] / GRAVITY


def amplitudes(cases: Iterable[Case]) -> list[np.ndarray]:
    """Return the amplitudes of all cases, computed on all processors."""
    with ProcessPoolExecutor(max_workers=os.cpu_count()) as pool:
        return list(pool.map(Case.amplitudes, cases))


def row(values: np.ndarray) -> str:
    """Return a table cell with the amplitudes, head first."""
    return ", ".join(f"{value:.3f}" for value in values)


def remarks(values: np.ndarray) -> str:
    """Return which observations hold: head largest, third smallest, fourth larger than third."""
    held = {
        "head": values.argmax() == 0,
        "third": values.argmin() == 2,
        "fourth": values[3] > values[2],
    }
    return ", ".join(name for name, true in held.items() if true) or "–"


def main() -> None:
    """Print the tables and write the figure."""
    over_gaits()
    by_stiffness = over_stiffness()
    by_damping = over_damping()
    switched_off()
    draw(by_stiffness, by_damping, loads_by_height()).savefig(IMAGE, dpi=120)
    on_two_axles()


def over_gaits() -> None:
    """Print the amplitudes over the gait range."""
    result = amplitudes(
        [Case(plant, f, offset) for f, offset in GAITS for plant in PLANTS]
    )
    groups = [result[len(PLANTS) * i :][: len(PLANTS)] for i in range(len(GAITS))]
    rows = [
        [f"{f:g}", f"{offset:g}", *map(row, group), remarks(group[0])]
        for (f, offset), group in zip(GAITS, groups, strict=True)
    ]
    print(table(["f Hz", "offset", *PLANTS, "observations, twin"], rows), end="\n\n")


def over_stiffness() -> np.ndarray:
    """Print amplitudes by stiffness at 0.75 Hz; return those of twin and `compliant`, (2, stiffnesses, 4)."""
    result = amplitudes(
        [Case(plant, 0.75, stiffness=k) for plant in PLANTS[:2] for k in STIFFNESS]
    )
    both = np.array(result).reshape(2, len(STIFFNESS), -1)
    rows = [
        [f"{k:g}", row(twin), row(compliant), remarks(twin)]
        for k, twin, compliant in zip(STIFFNESS, *both, strict=True)
    ]
    print(table(["k, N·m/rad", *PLANTS[:2], "observations, twin"], rows), end="\n\n")
    return both


def over_damping() -> dict[str, np.ndarray]:
    """Print amplitudes by damping at the shipped stiffness; return those of the twin at 2 Hz by change."""
    settings = [(d, changes) for changes in ((), (equal_tail,)) for d in DAMPING]
    kinds = [(plant, f) for f in (0.75, 2.0) for plant in PLANTS[:2]]
    result = amplitudes(
        [
            Case(p, f, damping_time=d, changes=changes)
            for d, changes in settings
            for p, f in kinds
        ]
    )
    names = [
        f"c/k = {1e3 * d:g} ms" + (", light tail" if changes else "")
        for d, changes in settings
    ]
    groups = [result[len(kinds) * i :][: len(kinds)] for i in range(len(settings))]
    rows = [
        [name, *map(row, group), remarks(group[2])]
        for name, group in zip(names, groups, strict=True)
    ]
    heads = [f"{plant}, {f:g} Hz" for plant, f in kinds]
    print(table(["damping", *heads, "observations, twin at 2 Hz"], rows), end="\n\n")
    shown = (0, DAMPING.index(SILICONE), len(DAMPING) + DAMPING.index(SILICONE))
    return {names[i]: groups[i][2] for i in shown}


def switched_off() -> None:
    """Print the amplitudes of `compliant` with the damping of silicone and single effects switched off."""
    gaits = (0.75, 2.0)
    result = amplitudes(
        [
            Case(
                "compliant", f, damping_time=SILICONE, changes=changes, options=options
            )
            for f in gaits
            for _, changes, options in SWITCHES
        ]
    )
    slow = result[: len(SWITCHES)]
    fast = result[len(SWITCHES) :]
    rows = [
        [name, row(a), remarks(a), row(b), remarks(b)]
        for (name, _, _), a, b in zip(SWITCHES, slow, fast, strict=True)
    ]
    head = ["change", *(cell for f in gaits for cell in (f"{f:g} Hz", "observations"))]
    print(table(head, rows), end="\n\n")


def loads_by_height() -> dict[float, np.ndarray]:
    """Print the wheel loads; return those at 1 Hz by the height of the centres of mass (m)."""
    cases = [Case("twin", f, height=height) for height in HEIGHTS for f in (0.75, 1.0)]
    with ProcessPoolExecutor(max_workers=os.cpu_count()) as pool:
        result = list(pool.map(Case.loads, cases))
    head = [
        "height mm",
        "f Hz",
        "mean",
        "minimum",
        "standard deviation",
        "time without load, %",
        "acceleration of the tail along the heading, g: RMS, maximum",
        "across the heading",
    ]
    print(table(head, [load_row(*item) for item in zip(cases, result, strict=True)]))
    return {
        case.height or 0.0: loads
        for case, (loads, _) in zip(cases, result, strict=True)
        if case.frequency == 1
    }


def load_row(case: Case, result: tuple[np.ndarray, np.ndarray]) -> list[str]:
    """Return a table row with the loads of all connectors relative to the load at rest."""
    loads, acceleration = result

    def cell(values: np.ndarray, form: str = ".2f") -> str:
        return ", ".join(format(value, form) for value in values)

    return [
        f"{1e3 * (case.height or 0):g}",
        f"{case.frequency:g}",
        cell(loads.mean(axis=(0, 2))),
        cell(loads.min(axis=(0, 2))),
        cell(loads.std(axis=0).mean(axis=1)),
        cell(100 * (loads <= 0).mean(axis=(0, 2)), ".0f"),
        *(
            f"{np.sqrt((a**2).mean()):.2f}, {np.abs(a).max():.2f}"
            for a in acceleration.T
        ),
    ]


def lifted(tail: Tail | None, frequency: float, damping_time: float) -> list[str]:
    """Return speed, amplitudes, observations, and the share of time with lifted front wheels of the tail."""
    spec = replace(Case("twin", frequency, damping_time=damping_time).spec(), tail=tail)
    plant = TwinSnake(spec, contact="loaded", supply_pa=SUPPLY, tick=LOAD_TICK)
    front = []
    run = rollout(
        plant,
        Gait(frequency),
        DURATION,
        observers=[
            lambda _: front.append(
                plant.physics.wheel_loads()[len(spec.mass.connectors) - 1]
            )
        ],
    )
    up = np.array(front)[round(2 / frequency / LOAD_TICK) :] <= 0
    values = plant_metrics(run)
    bends = np.array(values["bend_amplitude_rad"])
    speed = 1e3 * values["com_speed_m_s"]
    fractions = (up.any(axis=1).mean(), up.all(axis=1).mean())
    return [
        f"{speed:.0f}",
        row(bends),
        remarks(bends),
        *(f"{100 * fraction:.0f}" for fraction in fractions),
    ]


def on_two_axles() -> None:
    """Print the effect of a second axle, by the height of the centre of mass of the tail."""
    cases = [
        (tail, f, lag)
        for f in (0.75, 2.0)
        for lag in (DAMPING[0], SILICONE)
        for tail in TAILS
    ]
    with ProcessPoolExecutor(max_workers=os.cpu_count()) as pool:
        result = list(pool.map(lifted, *zip(*cases, strict=True)))
    names = [
        "one axle" if tail is None else f"two, {1e3 * tail.com_height:g} mm"
        for tail, _, _ in cases
    ]
    lifts = ["one front wheel lifted, %", "both, %"]
    head = ["f Hz", "c/k ms", "tail", "mm/s", "amplitudes, rad", "observations", *lifts]
    rows = [
        [f"{f:g}", f"{1e3 * lag:g}", name, *cells]
        for (_, f, lag), name, cells in zip(cases, names, result, strict=True)
    ]
    print("\n" + table(head, rows))


def draw(
    by_stiffness: np.ndarray,
    by_damping: dict[str, np.ndarray],
    loads: dict[float, np.ndarray],
) -> Figure:
    """Return the figure: amplitudes of the twin by damping and by stiffness, and the loads of its tail."""
    figure = Figure(figsize=(9, 3.4), layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    segments = np.arange(1, by_stiffness.shape[-1] + 1)
    dashes = ("-", "--", ":")
    for (label, values), mark, dash, color in zip(
        by_damping.items(), "os^", dashes, COLORS[:3], strict=True
    ):
        left.plot(
            segments,
            values,
            marker=mark,
            linestyle=dash,
            color=color,
            label=label,
            markersize=5,
        )
    left.set(
        xlabel="segment",
        ylabel="bend amplitude, rad",
        title="twin, 2 Hz, k = 0.44 N·m/rad",
        xticks=segments,
    )
    for j, (mark, color) in enumerate(zip("os^D", COLORS, strict=True)):
        middle.plot(
            STIFFNESS,
            by_stiffness[0][:, j],
            marker=mark,
            color=color,
            label=f"segment {j + 1}",
        )
        middle.plot(
            STIFFNESS, by_stiffness[1][:, j], linestyle="--", color=color, linewidth=0.9
        )
    middle.set(
        xscale="log",
        xlabel="stiffness, N·m/rad",
        title="twin (dashed: compliant), 0.75 Hz",
    )
    time = LOAD_TICK * np.arange(1, round(1 / LOAD_TICK) + 1)
    for (height, load), dash, color in zip(
        loads.items(), dashes, COLORS[:3], strict=True
    ):
        label = f"centres {1e3 * height:g} mm high"
        right.plot(
            time,
            load[: len(time), -1, 0],
            linestyle=dash,
            color=color,
            label=label,
            linewidth=1.2,
        )
    right.axhline(0, color="#222222", linewidth=0.8)
    right.set(
        xlabel="time, s",
        ylabel="load of the left wheel relative to rest",
        title="twin's tail, 1 Hz",
        ylim=(-0.8, 2.3),
    )
    for axes in (left, middle, right):
        axes.grid(True, linewidth=0.4, alpha=0.5)
        axes.title.set_fontsize(9)
    for axes in (left, middle):
        axes.margins(y=0.4)  # room for the legend above the lines
        axes.set_ylim(bottom=axes.dataLim.y0 - 0.05 * axes.dataLim.height)
    for axes in (left, middle, right):
        axes.legend(
            fontsize=7, loc="upper right" if axes is not right else "lower left"
        )
    return figure


if __name__ == "__main__":
    main()
