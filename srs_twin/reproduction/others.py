"""Predicted and published motion of robots that others built.

A prediction is a file in calibration/predictions. The file of the same name in calibration/published/others
has the published values. In a checkout, their commits show that the prediction came first.
"""

from __future__ import annotations

import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from srs_twin.errors import UnknownNameError
from srs_twin.io.documents import load_yaml
from srs_twin.io.files import data_root
from srs_twin.io.validation import StrictModel, load_model

_GIT_SECONDS = 10.0
"""Longest time of a git command, s."""


class PublishedValue(StrictModel):
    """Published motion of a robot."""

    value: Annotated[float, Field(ge=-100.0, le=100.0, allow_inf_nan=False)]
    """Value in the unit of the quantity."""
    of: Literal["robot", "simulation"]
    """robot: measured on the robot; simulation: simulated by its builders."""
    known: bool
    """Whether the value was known when the motion was predicted."""
    source: Annotated[str, Field(min_length=1, max_length=300)]
    """Publication and place."""


class PublishedFile(StrictModel):
    """Published values of a robot."""

    values: Annotated[dict[str, PublishedValue], Field(min_length=1)]
    """Predicted quantity → published value."""


@dataclass(frozen=True)
class PredictedQuantity:
    """Prediction of a quantity, and its published value.

    Attributes:
        robot: name of the robot file.
        quantity: quantity, with the settings of the gait.
        unit: unit of the numbers.
        median: predicted median.
        interval_95: ends of the predicted 95 % interval.
        published: published value, or None.
        prediction_commit: last commit that changed the prediction; None outside a checkout.
        comparison_commit: first commit with published values of the robot; None if there is none.
    """

    robot: str
    quantity: str
    unit: str
    median: float
    interval_95: tuple[float, float]
    published: PublishedValue | None
    prediction_commit: str | None
    comparison_commit: str | None

    @property
    def inside(self) -> bool | None:
        """Whether the published value is in the interval; None without one."""
        low, high = self.interval_95
        return None if self.published is None else low <= self.published.value <= high

    def cells(self) -> tuple[str, ...]:
        """Return robot, quantity, interval, published value and result as texts; needs a published value."""
        published, (low, high) = self.published, self.interval_95
        assert published is not None, "only compared quantities are printed"
        result = "inside" if self.inside else "outside"
        result += " (known)" if published.known else ""
        result += " (simulated)" if published.of == "simulation" else ""
        interval = f"{low:.3g} to {high:.3g}"
        return self.robot, self.quantity, interval, f"{published.value:.3g}", result

    def document(self) -> dict[str, object]:
        """Return JSON values."""
        published = self.published
        return {
            "robot": self.robot,
            "quantity": self.quantity,
            "unit": self.unit,
            "median": self.median,
            "interval_95": list(self.interval_95),
            "published": published and published.value,
            "inside": self.inside,
            "of": published and published.of,
            "known_before": published and published.known,
            "source": published and published.source,
            "prediction_commit": self.prediction_commit,
            "comparison_commit": self.comparison_commit,
        }


def load_predicted_quantities() -> list[PredictedQuantity]:
    """Return all predicted quantities, by robot.

    Raises:
        UnknownNameError: a published quantity was not predicted.
    """
    folder = data_root() / "calibration"
    rows = []
    for path in sorted((folder / "predictions").glob("*.yaml")):
        published_path = folder / "published" / "others" / path.name
        values = load_model(PublishedFile, published_path).values if published_path.exists() else {}
        predicted = _predictions(load_yaml(path).data)
        for name in values:
            if name not in predicted:
                raise UnknownNameError(f"quantity of {path.stem}", name, predicted)
        commits = _commit(path, "--max-count=1"), _commit(published_path, "--diff-filter=A")
        for name, (median, low, high) in predicted.items():
            unit = "rad/s" if name.startswith("yaw_rate") else "m/s"
            rows.append(
                PredictedQuantity(path.stem, name, unit, median, (low, high), values.get(name), *commits)
            )
    return rows


def _predictions(document: Any) -> dict[str, tuple[float, float, float]]:
    """Return median and ends of the 95 % interval by quantity.

    The first prediction, of a spatial snake, has its own keys: it keeps the text that was committed.
    """
    if "quantities" in document:
        return {name: (row["median"], *row["interval_95"]) for name, row in document["quantities"].items()}
    groups = {name: row["all"] for name, row in document.items() if name.startswith("fastest_")}
    return {name: (row["median_m_s"], *row["interval_95_m_s"]) for name, row in groups.items()}


def _commit(path: Path, *options: str) -> str | None:
    """Return the abbreviated commit of a file that `git log` selects; None without git or history."""
    command = ["git", "log", "--format=%h", *options, "--", path.name]
    try:
        done = subprocess.run(
            command, cwd=path.parent, capture_output=True, text=True, timeout=_GIT_SECONDS, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.split()[-1] if done.stdout.split() else None
