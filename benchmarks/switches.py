"""Contributions of friction law and compliance to the difference with default settings.

    uv run python benchmarks/switches.py

Settings change step by step from the model of the dissertation to the shipped twin, for
generation 2 at 2 Hz and 48.3 kPa.
"""

from __future__ import annotations

from typing import Any

from grid import Run, run_all, table

from srs_twin import load_robot
from srs_twin.comparison.metrics import plant_metrics

OFFSETS = (0.0, 0.2, 0.4)
SHIPPED = load_robot("gen2").bending.stiffness
STEPS: list[tuple[str, dict[str, Any]]] = [
    ("analytical, `axis`", {"plant": "analytical"}),
    ("analytical, `wheel`", {"plant": "analytical", "options": {"friction": "wheel"}}),
    *(
        (f"twin, k = {k:g} N·m/rad", {"plant": "twin", "stiffness": k})
        for k in (20.0, 5.0, 2.0, 0.88)
    ),
    (f"twin, k = {SHIPPED:g} N·m/rad (shipped)", {"plant": "twin"}),
]


def main() -> None:
    """Print speed and yaw rate after each change."""
    runs = [
        Run(supply_pa=48.3e3, offset=offset, **step)
        for _, step in STEPS
        for offset in OFFSETS
    ]
    metrics = [plant_metrics(trajectory) for trajectory in run_all(runs)]
    rows = []
    for i, (name, _) in enumerate(STEPS):
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


if __name__ == "__main__":
    main()
