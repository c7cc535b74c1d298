"""Baseline: the verdicts that are committed; a later run must come to the same."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from srs_twin.errors import InputError
from srs_twin.files import atomic_write, data_root, shown
from srs_twin.provenance import versions
from srs_twin.reproduction.outcomes import MISSED, VERDICTS, Judged, Outcome


@dataclass(frozen=True)
class Baseline:
    """What came of each row when the baseline was written.

    Attributes:
        outcomes: row → column → outcome.
        versions: package → version that it was written with.
    """

    outcomes: Mapping[str, Mapping[str, Outcome]]
    versions: Mapping[str, str]

    def changes(self, rows: Sequence[Judged]) -> list[str]:
        """Return a line for each verdict that is not the one it was; a row that is new has no change.

        A better verdict is a change as well: a tolerance may have been widened.

        Args:
            rows: judged now.
        """
        found = []
        for row in rows:
            for column, outcome in row.outcomes.items():
                before = self.outcomes.get(row.claim.id, {}).get(column)
                if before is not None and outcome.verdict != before.verdict:
                    found.append(f"{row.claim.id}, {column}: {outcome.verdict}, was {before.verdict}")
        return found


def baseline_file() -> Path:
    """Return the path of the shipped baseline."""
    return data_root() / "calibration/published/baseline.json"


def load_baseline(path: Path | None = None) -> Baseline:
    """Load a baseline, the shipped one by default.

    Raises:
        InputError: it is not there, or none of ours.
    """
    place = path or baseline_file()
    try:
        given = json.loads(place.read_text("utf-8"))
        outcomes = {
            name: {column: _outcome(each) for column, each in columns.items()}
            for name, columns in given["rows"].items()
        }
        return Baseline(outcomes, dict(given["versions"]))
    except OSError as error:
        raise InputError(f"{shown(place)}: cannot be read ({error.strerror})") from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{shown(place)}: not a baseline; --write-baseline writes one") from error


def write_baseline(rows: Sequence[Judged], path: Path | None = None) -> Path:
    """Write the outcomes of rows as the baseline, whole or not at all; return where.

    Raises:
        InputError: it cannot be written.
    """
    place = path or baseline_file()
    document = {"versions": versions(), "rows": outcomes_document(rows, digits=4)}
    with atomic_write(place) as part:
        part.write_text(json.dumps(document, indent=1, ensure_ascii=False) + "\n", "utf-8")
    return place


def outcomes_document(rows: Sequence[Judged], *, digits: int | None = None) -> dict[str, Any]:
    """Return outcomes as JSON values: row → column → verdict, values, value, error, why.

    Args:
        rows: judged.
        digits: significant ones that are kept; None: all.
    """

    def number(value: float) -> float | None:
        if not math.isfinite(value):
            return None
        return value if digits is None else float(f"{value:.{digits}g}")

    return {
        row.claim.id: {
            column: {
                "verdict": each.verdict,
                "values": [number(value) for value in each.values],
                "value": number(each.value),
                "error": number(each.error),
                "why": each.why,
            }
            for column, each in row.outcomes.items()
        }
        for row in rows
    }


def _outcome(given: Mapping[str, Any]) -> Outcome:
    def number(value: float | None) -> float:
        return math.nan if value is None else float(value)

    verdict = given["verdict"] if given["verdict"] in VERDICTS else MISSED
    values = tuple(map(number, given["values"]))
    return Outcome(verdict, values, number(given["value"]), number(given["error"]), str(given["why"]))
