"""Published values and prediction intervals in the terms of ASME V&V 20; one row per plant.

    uv run python benchmarks/published_intervals.py [FILE ...]

Reads the given `intervals.json` files, or those written by `srs-twin uncertainty
SCENARIO --write`.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from srs_twin.scenario.expectation import interval_verdict

FOLDER = Path(__file__).parents[1] / "calibration/intervals"
SCATTER = 0.01


def main(files: Sequence[str]) -> None:
    """Print the table of the given files, or of the stored intervals."""
    print(
        "| scenario | plant | published | value | E | u_num | u_input | u_D | 95 % |"
        " errors of the ends | verdict | width | score |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|---|---|")
    for path in map(Path, files) if files else sorted(FOLDER.glob("*.json")):
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
                errors = row["interval_95_error"]
                rest = (
                    f"{1000 * low:.1f} to {1000 * high:.1f}",
                    ", ".join(f"{1000 * error:.2g}" for error in errors),
                    interval_verdict(stated, (low, high), errors).value,
                    f"{1000 * np.subtract(high, low):.0f}",
                    f"{1000 * score:.0f}",
                )
                print(
                    "| "
                    + " | ".join([document["scenario"], plant, *cells, *rest])
                    + " |"
                )


if __name__ == "__main__":
    main(sys.argv[1:])
