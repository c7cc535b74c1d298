"""Published values beside kept intervals, in the terms of ASME V&V 20; a row each.

    uv run python benchmarks/published_intervals.py

Reads `calibration/intervals/`, which `srs-twin uncertainty SCENARIO --write` fills.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

FOLDER = Path(__file__).parents[1] / "calibration/intervals"
SCATTER = 0.01


def main() -> None:
    """Print the table."""
    print(
        "| scenario | plant | published | value | E | u_num | u_input | u_D | 95 % | holds | width | score |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|---|")
    for path in sorted(FOLDER.glob("*.json")):
        document = json.loads(path.read_text("utf-8"))
        for plant, metrics in document["plants"].items():
            for name, row in metrics.items():
                stated = row["published"]
                if not stated or name != "com_speed_m_s":
                    continue
                low, high = row["interval_95"]
                score = high - low + 40 * max(low - stated, stated - high, 0.0)
                numbers = (
                    stated,
                    row["value"],
                    row["value"] - stated,
                    row["u_num"],
                    row["u_input"],
                    SCATTER * stated,
                )
                cells = [f"{1000 * number:.3g}" for number in numbers]
                holds = "yes" if low <= stated <= high else "no"
                shown = f"{1000 * low:.0f} to {1000 * high:.0f}"
                rest = shown, holds, f"{1000 * np.subtract(high, low):.0f}", f"{1000 * score:.0f}"
                print("| " + " | ".join([document["scenario"], plant, *cells, *rest]) + " |")


if __name__ == "__main__":
    main()
