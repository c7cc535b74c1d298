"""Predictions of each row of Table 8 from the other rows, with model and discrepancy.

    uv run python benchmarks/discrepancy.py

The model predictions are those of the committed baseline. The prior standard deviation
of the discrepancy is a fifth of the published mean, with a length scale of 0.2 in the
offset. The noise is 5 % of the mean, the scatter between mirrored offsets in Table 8.
"""

from __future__ import annotations

import re

import numpy as np

from srs_twin.reproduction.claims import load_claims
from srs_twin.reproduction.verdicts import load_baseline
from srs_twin.studies.uncertainty.discrepancy import Discrepancy

SIZE = 0.2
LENGTH = 0.2
NOISE = 0.05


def main() -> None:
    """Print a table."""
    claims = {claim.id: claim for claim in load_claims()}
    kept = load_baseline().outcomes
    print(
        "| quantity | plant | rms of the model | rms with discrepancy | rows within 95"
        " % | mean width |"
    )
    print("|---|---|---|---|---|---|")
    for quantity in ("speed", "radius"):
        for plant in ("analytical", "twin"):
            rows = []
            for name, claim in claims.items():
                result = re.fullmatch(rf"table8\.{quantity}\.([pm]?)(\d+)", name)
                if result and claim.value is not None:
                    offset = float(result[2]) / 10 * (-1 if result[1] == "m" else 1)
                    value = kept[name][plant].value
                    if (
                        quantity == "radius"
                    ):  # curvature also has a constant term: straight walks are curved
                        # At offset 0 the table has no side; the fit assumes the right
                        # side.
                        side = -1 if offset == 0 else 1
                        rows.append((offset, side / claim.value, side / value))
                    else:
                        rows.append((offset, claim.value, value))
            offset, measured, model = np.array(sorted(rows)).T
            scale = float(np.abs(measured).mean())
            centre = []
            held = []
            widths = []
            for i in range(len(offset)):
                rest = np.arange(len(offset)) != i
                fit = Discrepancy(
                    offset[rest, None],
                    measured[rest],
                    model[None, rest],
                    NOISE * scale,
                    SIZE * scale,
                    LENGTH,
                )
                drawn = fit.draw(offset[[i], None], model[None, [i]])[:, 0]
                drawn += (
                    NOISE * scale * np.random.default_rng(i).normal(size=len(drawn))
                )
                low, middle, high = np.quantile(drawn, [0.025, 0.5, 0.975])
                centre.append(middle)
                held.append(low <= measured[i] <= high)
                widths.append(high - low)
            before, after = (
                np.sqrt(np.mean((item - measured) ** 2))
                for item in (model, np.array(centre))
            )
            what = "curvature" if quantity == "radius" else quantity
            cells = (
                what,
                plant,
                f"{100 * before / scale:.0f} %",
                f"{100 * after / scale:.0f} %",
            )
            print(
                "| " + " | ".join(cells) + f" | {sum(held)} of {len(held)} |"
                f" {100 * np.mean(widths) / scale:.0f} % |"
            )


if __name__ == "__main__":
    main()
