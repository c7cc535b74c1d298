"""Differences between the twin and the analytical model over the published grid of generation 2.

    uv run python benchmarks/agreement.py [--default | --skid | --loads KIND] [--quick]
    uv run python benchmarks/agreement.py --switches
    uv run python benchmarks/agreement.py --refine shipped

By default the physics of both plants are matched: the `wheel` law, the same track and
inertia of the connectors, bends stiff enough to follow their free value, and the
preloaded contact. Other settings:

- `--default`: the shipped robot, the default twin and the default friction of the
  model;
- `--skid`: matched physics on skids, with the `ellipse` law;
- `--loads`: the loaded contact and wheels without inertia about their axles.
  `instantaneous` uses instantaneous loads in both plants, `across` the load distribution of the
  analytical model in both, `static` the static loads.

`--switches` changes the settings step by step from the model of the dissertation to the
shipped twin, for generation 2 at 2 Hz and 48.3 kPa. `--refine` refines time step,
friction regularisation and number of hinges one at a time and all together, for gaits
of generation 2 between 1 and 2 Hz, straight and turning.
"""

from __future__ import annotations

import argparse
from itertools import product
from typing import Any

from common.grid import Run, run_all, table

from srs_twin import LoadedContact, Numerics, PreloadedContact, compare, load_robot
from srs_twin.comparison.metrics import plant_metrics
from srs_twin.plants.twin.mjcf.numerics import LOADS, SLIP_SPEED_M_S, ModelSettings

FREQUENCIES_HZ = (1.0, 1.5, 2.0)
PRESSURES_KPA = (41.0, 48.0, 55.0)
HEAD = (
    "f Hz",
    "p kPa",
    "analytical mm/s",
    "twin mm/s",
    "speed %",
    "analytical rad/s",
    "twin rad/s",
    "yaw %",
    "shape % body",
    "bend RMS %",
)
RANGES_HEAD = (
    "rigid gaps",
    "offset",
    "speed of the model, mm/s",
    "difference in speed, %",
    "in yaw rate, %",
    "shape, % of the body",
    "bends, RMS %",
)
MATCHED_STIFFNESS = 20.0  # N·m/rad; bends follow their free value within 2 % RMS

OFFSETS = (0.0, 0.2, 0.4)
SHIPPED = load_robot("gen2").bending.stiffness
SWITCHES: list[tuple[str, dict[str, Any]]] = [
    ("analytical, `axis`", {"plant": "analytical"}),
    ("analytical, `wheel`", {"plant": "analytical", "options": {"friction": "wheel"}}),
    *(
        (f"twin, k = {k:g} N·m/rad", {"plant": "twin", "stiffness": k})
        for k in (20.0, 5.0, 2.0, 0.88)
    ),
    (f"twin, k = {SHIPPED:g} N·m/rad (shipped)", {"plant": "twin"}),
]

GAITS = ((1.0, 0.0), (2.0, 0.0), (2.0, 0.2))  # Hz, offset
BASE = ModelSettings()
HALF_SLIP = {"contact": LoadedContact(slip_speed=SLIP_SPEED_M_S / 2)}

REFINEMENTS: dict[str, list[tuple[str, dict[str, Any]]]] = {
    "analytical": [
        ("default: 2 ms, tolerance 0.2 mm/s, ε 0.25 mm/s", {}),
        ("time step halved", {"timestep": 0.001}),
        ("time step quartered", {"timestep": 0.0005}),
        ("tolerance halved", {"tolerance": 0.0001}),
        ("ε halved", {"slip_speed": 0.000125}),
        (
            "time step 1/8, tolerance 1/10, ε 1/4",
            {"timestep": 0.00025, "slip_speed": 0.0000625, "tolerance": 0.00002},
        ),
    ],
    "twin": [
        (f"default: {1e3 * BASE.timestep:g} ms, {BASE.hinges_per_segment} hinges", {}),
        ("time step 2 ms", {"timestep": 0.002}),
        ("time step halved", {"timestep": 0.0005}),
        ("time step quartered", {"timestep": 0.00025}),
        ("hinges doubled", {"hinges_per_segment": 2 * BASE.hinges_per_segment}),
        ("slip speed halved", HALF_SLIP),
        (
            "all refined",
            {
                "timestep": 0.00025,
                "hinges_per_segment": 2 * BASE.hinges_per_segment,
                **HALF_SLIP,
            },
        ),
        ("preloaded", {"contact": PreloadedContact()}),
    ],
}


def main() -> None:
    """Print one table each for straight and turning gaits, with and without rigid gaps.

    The last table contains the ranges over each of these tables, as in
    docs/verification.md.
    """
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument(
        "--default",
        action="store_true",
        help="use the default settings instead of matched physics",
    )
    arguments.add_argument(
        "--skid", action="store_true", help="use skids and the ellipse law"
    )
    arguments.add_argument(
        "--loads", choices=LOADS, help="wheel loads in the friction law of the twin"
    )
    arguments.add_argument(
        "--quick",
        action="store_true",
        help="simulate the corner points and the middle point only",
    )
    arguments.add_argument(
        "--switches",
        action="store_true",
        help="change the settings step by step from the model to the shipped twin",
    )
    arguments.add_argument(
        "--refine",
        choices=("shipped", "matched"),
        help="refine each numerical setting, with the shipped or with stiff bends",
    )
    selected = arguments.parse_args()
    if selected.switches:
        switches()
        return
    if selected.refine:
        refinement(MATCHED_STIFFNESS if selected.refine == "matched" else None)
        return
    common: dict[str, float] = (
        {} if selected.default else {"stiffness": MATCHED_STIFFNESS}
    )
    if selected.default:
        friction_law = "axis"
    elif selected.skid:
        friction_law = "ellipse"
    else:
        friction_law = "wheel"
    wheels: dict[str, object] = (
        {}
        if selected.default
        else {"contact": PreloadedContact("skid" if selected.skid else "rolling")}
    )
    loads: dict[str, object] = {} if selected.default else {"inertia": "connector"}
    if selected.loads:
        wheels = {
            "contact": LoadedContact(load=selected.loads),
            "numerics": Numerics(wheel_spin=0.0),
        }
        loads |= {"load": "static" if selected.loads == "static" else "instantaneous"}
    points = list(product(FREQUENCIES_HZ, PRESSURES_KPA))
    if selected.quick:
        points = points[::4]
    ranges = []
    for gaps, offset in product((False, True), (0.0, 0.2)):
        runs = [
            Run(
                plant,
                frequency=f,
                supply_pa=p * 1e3,
                offset=offset,
                gaps=gaps,
                options=options,
                **common,
            )
            for f, p in points
            for plant, options in (
                ("analytical", {"friction": friction_law} | loads),
                ("twin", wheels),
            )
        ]
        done = run_all(runs)
        print(f"\n{'with' if gaps else 'without'} gaps, offset {offset}\n")
        rows = _rows(points, list(zip(done[::2], done[1::2], strict=True)))
        print(table(HEAD, rows), flush=True)
        ranges.append(("yes" if gaps else "no", f"{offset:g}", *_ranges(rows)))
    print()
    print(table(RANGES_HEAD, ranges))


def switches() -> None:
    """Print speed and yaw rate from the model of the dissertation to the shipped twin, change by change."""
    runs = [
        Run(supply_pa=48.3e3, offset=offset, **step)
        for _, step in SWITCHES
        for offset in OFFSETS
    ]
    metrics = [plant_metrics(trajectory) for trajectory in run_all(runs)]
    rows = []
    for i, (name, _) in enumerate(SWITCHES):
        row = metrics[i * len(OFFSETS) : (i + 1) * len(OFFSETS)]
        rows.append(
            [
                name,
                *(
                    f"{1e3 * m['com_speed_m_s']:.1f}, {m['yaw_rate_rad_s']:+.3f}"
                    for m in row
                ),
            ]
        )
    print(table(["", *(f"offset {offset:g}: mm/s, rad/s" for offset in OFFSETS)], rows))


def refinement(stiffness: float | None) -> None:
    """Print the change of speed and yaw rate if each numerical setting is refined.

    Args:
        stiffness: stiffness of the bends, N·m/rad; None for that of the shipped robot.
    """
    head = ["change", *(f"{f:g} Hz, offset {o:g}: mm/s (%), rad/s" for f, o in GAITS)]
    for plant, cases in REFINEMENTS.items():
        if plant == "analytical":
            friction = {"friction": "wheel"}
        else:
            friction = {}
        runs = [
            Run(
                plant,
                frequency=f,
                offset=o,
                supply_pa=48.3e3,
                stiffness=stiffness,
                options=friction | options,
            )
            for _, options in cases
            for f, o in GAITS
        ]
        metrics = [plant_metrics(trajectory) for trajectory in run_all(runs)]
        base = metrics[: len(GAITS)]
        rows = []
        for i, (name, _) in enumerate(cases):
            row = metrics[i * len(GAITS) : (i + 1) * len(GAITS)]
            rows.append([name, *(_cell(m, b) for m, b in zip(row, base, strict=True))])
        print(f"\n{plant}\n\n{table(head, rows)}", flush=True)


def _cell(metrics: dict[str, Any], base: dict[str, Any]) -> str:
    speed = metrics["com_speed_m_s"]
    before = base["com_speed_m_s"]
    return (
        f"{1e3 * speed:.2f} ({100 * (speed / before - 1):+.2f}),"
        f" {metrics['yaw_rate_rad_s']:+.4f}"
    )


def _rows(points: list, pairs: list) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    for (f, p), (reference, candidate) in zip(points, pairs, strict=True):
        a = plant_metrics(reference)
        b = plant_metrics(candidate)
        c = compare(reference, candidate).metrics
        yaw_a = a["yaw_rate_rad_s"]
        yaw_b = b["yaw_rate_rad_s"]
        rows.append(
            (
                f"{f:g}",
                f"{p:g}",
                f"{1e3 * a['com_speed_m_s']:.1f}",
                f"{1e3 * b['com_speed_m_s']:.1f}",
                f"{100 * c['com_speed_rel']:+.1f}",
                f"{yaw_a:.4f}",
                f"{yaw_b:.4f}",
                f"{100 * (yaw_b / yaw_a - 1):+.1f}" if abs(yaw_a) > 1e-3 else "–",
                f"{100 * c['shape_rms_body']:.2f}",
                f"{100 * c['bend_rms_rel']:.2f}",
            )
        )
    return rows


def _ranges(rows: list[tuple[str, ...]]) -> tuple[str, ...]:
    """Return the ranges of speed, differences, shape and bends over the rows of a table."""
    columns = dict(zip(HEAD, zip(*rows, strict=True), strict=True))

    def span(name: str) -> str:
        cells = sorted((cell for cell in columns[name] if cell != "–"), key=float)
        return f"{cells[0]} to {cells[-1]}" if cells else "–"

    def largest(name: str) -> str:
        return f"≤ {max(columns[name], key=float)}"

    return (
        span("analytical mm/s"),
        span("speed %"),
        span("yaw %"),
        largest("shape % body"),
        largest("bend RMS %"),
    )


if __name__ == "__main__":
    main()
