"""Predicted and published motion of robots from other laboratories.

The predictions for a robot are stored in a file in calibration/predictions, and the
published values in a file with the same name in calibration/published/others. The git
history proves that the predictions were committed before the published values. The
folder calibration/predictions/recomputed contains values that are not predictions,
because they were computed after the published values were known.
"""

from __future__ import annotations

import subprocess
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from srs_twin.errors import UnknownNameError
from srs_twin.io.documents import load_yaml
from srs_twin.io.files import data_root
from srs_twin.io.validation import StrictModel, load_model
from srs_twin.scenario.expectation import IntervalVerdict, interval_verdict
from srs_twin.studies.uncertainty.metric_uncertainty import MIN_BOUNDING_SAMPLES

_GIT_SECONDS = 10.0


class PublishedValue(StrictModel):
    """Published value of a quantity that describes the motion of a robot."""

    value: Annotated[float, Field(ge=-100.0, le=100.0, allow_inf_nan=False)]
    """Value in the unit of the quantity."""
    of: Literal["robot", "simulation"]
    """Origin of the value, which was measured on the robot ("robot") or simulated by
    the builders of the robot ("simulation").
    """
    known: bool
    """Whether we knew the value at the time of the prediction."""
    source: Annotated[str, Field(min_length=1, max_length=300)]
    """Publication, with the section or page."""


class PublishedFile(StrictModel):
    """File with the published values of a robot."""

    values: Annotated[dict[str, PublishedValue], Field(min_length=1)]
    """Published values, keyed by quantity."""


@dataclass(frozen=True, kw_only=True)
class Quantiles:
    """Quantiles of a quantity over randomly sampled robots.

    Attributes:
        median: median of the quantity.
        interval_95: lower and upper end of the 95 % interval.
        interval_95_error: standard errors of both ends, or None if they are unknown.
        robots: number of sampled robots, or 0 if the number is unknown.
    """

    median: float
    interval_95: tuple[float, float]
    interval_95_error: tuple[float, float] | None
    robots: int

    def contains(self, published: PublishedValue) -> bool:
        """Return whether the 95 % interval contains a published value."""
        low, high = self.interval_95
        return low <= published.value <= high

    def verdict(self, published: PublishedValue) -> IntervalVerdict:
        """Return the verdict on whether the 95 % interval contains a published value.

        The verdict is undecided if too few robots were sampled or the value is too
        close to an end of the interval.
        """
        if self.robots < MIN_BOUNDING_SAMPLES:
            return IntervalVerdict.UNDECIDED
        return interval_verdict(
            published.value, self.interval_95, self.interval_95_error
        )

    def cells(self, published: PublishedValue) -> tuple[str, ...]:
        """Return the interval, the published value and the verdict as table cells."""
        low, high = self.interval_95
        result = "inside" if self.contains(published) else "outside"
        if self.verdict(published) is IntervalVerdict.UNDECIDED:
            result += ", undecided"
        return f"{low:.3g} to {high:.3g}", f"{published.value:.3g}", result


@dataclass(frozen=True, kw_only=True)
class PredictedQuantity:
    """Predicted quantity of a robot, together with the published value.

    Attributes:
        robot: name of the robot file.
        quantity: name of the quantity.
        predicted: predicted quantiles.
        recomputed: quantiles computed after the published value was known, or None.
        published: published value, or None if there is no published value.
        prediction_commit: last commit that changed a predicted value, or None outside a
            git checkout.
        comparison_commit: commit that added the published values of the robot, or None.
    """

    robot: str
    quantity: str
    predicted: Quantiles
    recomputed: Quantiles | None
    published: PublishedValue | None
    prediction_commit: str | None
    comparison_commit: str | None

    def document(self) -> dict[str, object]:
        """Return the predicted quantity as JSON values."""
        document: dict[str, object] = {
            "robot": self.robot,
            "quantity": self.quantity,
            "unit": "rad/s" if self.quantity.startswith("yaw_rate") else "m/s",
            "median": self.predicted.median,
            "interval_95": list(self.predicted.interval_95),
            "robots": self.predicted.robots,
            "recomputed": self.recomputed and asdict(self.recomputed),
            "recomputed_verdict": None,
            "published": None,
            "inside": None,
            "verdict": None,
            "of": None,
            "known_before": None,
            "source": None,
            "prediction_commit": self.prediction_commit,
            "comparison_commit": self.comparison_commit,
        }
        published = self.published
        if published is not None:
            document |= {
                "published": published.value,
                "inside": self.predicted.contains(published),
                "verdict": self.predicted.verdict(published).value,
                "of": published.of,
                "known_before": published.known,
                "source": published.source,
            }
            if self.recomputed is not None:
                verdict = self.recomputed.verdict(published)
                document["recomputed_verdict"] = verdict.value
        return document


def load_predicted_quantities() -> list[PredictedQuantity]:
    """Load all predicted quantities, ordered by robot.

    Raises:
        UnknownNameError: a published quantity was not predicted.
    """
    folder = data_root() / "calibration"
    rows = []
    for path in sorted((folder / "predictions").glob("*.yaml")):
        predicted = _predictions(path)
        recomputed = _predictions(path.parent / "recomputed" / path.name)
        published_path = folder / "published" / "others" / path.name
        values: dict[str, PublishedValue] = {}
        if published_path.exists():
            values = load_model(PublishedFile, published_path).values
        for name in values:
            if name not in predicted:
                raise UnknownNameError(f"quantity of {path.stem}", name, predicted)
        prediction_commit = _commit(path, "--max-count=1", "-G[0-9][.][0-9]")
        comparison_commit = _commit(published_path, "--diff-filter=A")
        rows += [
            PredictedQuantity(
                robot=path.stem,
                quantity=name,
                predicted=numbers,
                recomputed=recomputed.get(name),
                published=values.get(name),
                prediction_commit=prediction_commit,
                comparison_commit=comparison_commit,
            )
            for name, numbers in predicted.items()
        ]
    return rows


def _predictions(path: Path) -> dict[str, Quantiles]:
    """Return the quantiles of each quantity in a file, or {} for a missing file.

    The file spatial_530mm.yaml keeps an older format, because a committed prediction
    must not be edited.
    """
    if not path.exists():
        return {}
    document = load_yaml(path).data
    robots = document.get("robots", 0)
    count = robots if isinstance(robots, int) else len(robots)
    quantities = document.get("quantities")
    unit = ""
    if quantities is None:
        quantities = {
            name: row["all"]
            for name, row in document.items()
            if name.startswith("fastest_")
        }
        unit = "_m_s"
    result = {}
    for name, row in quantities.items():
        low, high = row[f"interval_95{unit}"]
        errors = row.get("interval_95_error")
        result[name] = Quantiles(
            median=row[f"median{unit}"],
            interval_95=(low, high),
            interval_95_error=errors and (errors[0], errors[1]),
            robots=count,
        )
    return result


def _commit(path: Path, *options: str) -> str | None:
    command = ["git", "log", "--format=%h", *options, "--", path.name]
    try:
        done = subprocess.run(
            command,
            cwd=path.parent,
            capture_output=True,
            text=True,
            timeout=_GIT_SECONDS,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return next(reversed(done.stdout.split()), None)
