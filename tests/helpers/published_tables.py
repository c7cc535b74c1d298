"""Tables 1 to 10 of the dissertation as data, from calibration/published/table*.yaml.

There are five kinds of tables: symbols with meanings, parameters with values,
algorithms, runs of a robot, and generations. Values have the unit in their key,
together with the printed text. Errata refer to calibration/README.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from srs_twin.io.documents import load_yaml
from srs_twin.io.files import data_root
from srs_twin.reproduction.claims import CLAIMS_BYTES, claims_file

TABLES = tuple(f"table{number}" for number in range(1, 11))
"""Names of the tables."""


@dataclass(frozen=True)
class PublishedRun:
    """One run of Table 8, signs as printed.

    Attributes:
        offset: phase offset, positive to the left.
        speed_m_s: linear velocity, m/s.
        left_m: left edge of the bounding box, m, negative.
        right_m: right edge of the bounding box, m.
        radius_m: radius of the path, m, without a sign.
    """

    offset: float
    speed_m_s: float
    left_m: float
    right_m: float
    radius_m: float


def claim(name: str) -> dict[str, Any]:
    """Return a published claim."""
    claims = load_yaml(claims_file(), limit=CLAIMS_BYTES).data
    return next(each for each in claims if each["id"] == name)


def load_table(name: str) -> dict[str, Any]:
    """Return the content of a published table, such as table8."""
    document = load_yaml(data_root() / f"calibration/published/{name}.yaml")
    document.raise_problems()
    return dict(document.data)


def published_runs() -> tuple[PublishedRun, ...]:
    """Return the rows of Table 8, in its order."""
    rows = load_table("table8")["rows"]
    return tuple(PublishedRun(**{k: float(v) for k, v in row.items()}) for row in rows)
