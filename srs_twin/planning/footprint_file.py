"""Footprint files, which contain footprint tables and excursions.

A footprint file contains the table of a `Footprint` in the form of Table 8, with a
unit, a status and a source for each column. The directory calibration/footprints
contains the published footprints, and the command `srs-twin calibrate footprint`
measures new footprints.

A file may also list excursions, which are the maximum distances by which the body left
the footprint in n runs on random paths. The margin for a probability p is the k-th
smallest excursion with k = ⌈(n + 1) p⌉. For any distribution, a new run stays within
this margin with a probability of at least k/(n + 1). This method is called split
conformal prediction (Vovk et al. 2005; Lei et al. 2018).
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field, model_validator

from srs_twin.errors import InputError
from srs_twin.io.documents import Document, Loc, dump_yaml
from srs_twin.io.files import StrPath, find_file, shipped_names, write_text
from srs_twin.io.validation import StrictModel, load_model
from srs_twin.planning.footprint import COLUMNS, Footprint, Transient, find_problems
from srs_twin.plants.twin.mjcf.numerics import UNSTATED_CONTACT, ContactName
from srs_twin.robot.sourced import Record, Status, bounded

MEASURED_ON_TWIN = "measured on the twin"
"""Prefix of the `source` text for curvatures that were measured with a twin."""

Fraction = Annotated[float, bounded(0.0, 1.0)]
Excursion = Annotated[float, bounded(-10.0, 1e3)]
Runs = Annotated[list[Excursion], Field(min_length=1, max_length=10_000)]
LOST_M = 1e3
"""Excursion that is stored for a run that misses the goal, m."""

Source = Annotated[str, Field(min_length=1, max_length=1000)]
Offset = Annotated[float, bounded(-1.0, 1.0)]
Metres = Annotated[float, bounded(0.0, 10.0)]
Rows = Field(min_length=3, max_length=101)
Offsets = Record[Annotated[list[Offset], Rows], Literal["1"]]
Curvatures = Record[
    Annotated[list[Annotated[float, bounded(-100.0, 100.0)]], Rows], Literal["1/m"]
]
Speeds = Record[
    Annotated[list[Annotated[float, bounded(1e-3, 10.0)]], Rows], Literal["m/s"]
]
Edges = Record[
    Annotated[list[Annotated[float, bounded(1e-3, 10.0)]], Rows], Literal["m"]
]
Reach = Record[Metres, Literal["m"]]

Shift = Annotated[float, bounded(-10.0, 10.0)]
Spreads = Annotated[list[Annotated[float, bounded(0.0, 100.0)]], Rows]


class ConditionsFile(StrictModel):
    """Conditions of a run with a path follower."""

    plant: Literal["analytical", "twin"]
    """Simulated plant."""
    contact: ContactName | None = None
    """Contact model of the twin (default preloaded), not allowed for other plants."""
    chambers: Literal["lag", "orifice"] = "lag"
    """Chamber model."""
    follower: Literal["bearing", "path"]
    """Steering law."""
    gain_spread: Fraction = 0.0
    """Standard deviation of the relative chamber gains, 0 to 1."""
    tau_spread: Fraction = 0.0
    """Standard deviation of the relative time constants, 0 to 1."""
    bias_spread_rad: Fraction = 0.0
    """Standard deviation of the rest bends, rad, 0 to 1."""
    turn_fraction: Fraction
    """Fraction of the tightest curvature that plans may use, 0 to 1."""
    delay_s: Annotated[float, bounded(0.0, 10.0)]
    """Command delay, s, 0 to 10."""
    position_noise_m: Fraction
    """Position noise of the camera, m, 0 to 1."""
    heading_noise_rad: Annotated[float, bounded(0.0, 3.0)]
    """Heading noise of the camera, rad, 0 to 3."""
    lead_in_m: Annotated[float, bounded(0.0, 100.0)]
    """Length of the straight lead-in, m, 0 to 100."""

    @model_validator(mode="before")
    @classmethod
    def _state_contact(cls, data: object) -> object:
        if (
            isinstance(data, dict)
            and data.get("plant") == "twin"
            and data.get("contact") is None
        ):
            return {**data, "contact": UNSTATED_CONTACT}
        return data

    @model_validator(mode="after")
    def _only_of_a_twin(self) -> ConditionsFile:
        if self.plant != "twin" and self.contact is not None:
            raise ValueError(
                f"contact {self.contact} is allowed only for `plant: twin`, because"
                f" the {self.plant} model has no contact model; remove `contact`"
            )
        return self

    def covers(self, other: ConditionsFile) -> bool:
        """Return whether a margin measured under these conditions is valid for `other`.

        The plant, contact model, chamber model, follower and lead-in must be equal. No
        other quantity may be larger in `other`.
        """
        same = ("plant", "contact", "chambers", "follower", "lead_in_m")
        return all(
            getattr(self, name) == getattr(other, name) for name in same
        ) and all(
            getattr(self, name) >= getattr(other, name) - 1e-12
            for name in _DIFFICULTIES
        )

    def excess_difficulty(self, other: ConditionsFile) -> float:
        """Sum the relative differences of quantities that are smaller in `other`."""
        pairs = ((getattr(self, name), getattr(other, name)) for name in _DIFFICULTIES)
        return float(
            sum((own - covered) / own for own, covered in pairs if own > covered)
        )


SPREADS = ("gain_spread", "tau_spread", "bias_spread_rad")
"""Keys in a robot file for the standard deviations of module parameters."""
_DIFFICULTIES = (
    *SPREADS,
    "turn_fraction",
    "delay_s",
    "position_noise_m",
    "heading_noise_rad",
)
"""Keys of quantities that make path following more difficult if they increase."""


class ExcursionsFile(StrictModel):
    """Excursions of runs under equal conditions."""

    conditions: ConditionsFile
    """Conditions of the runs."""
    source: Source
    """Source of the measurements."""
    path_m: Runs
    """Maximum excursion of each run in ascending order, m (1000 if the run missed the
    goal)."""
    lead_in_m: Runs | None = None
    """Maximum excursion on the lead-in of each run in ascending order, m."""


class TransientFile(StrictModel):
    """Deviation from the steady footprint after one change of offset."""

    from_offset: Offset
    """Offset before the change, -1 to 1."""
    to_offset: Offset
    """Offset after the change, -1 to 1."""
    left_m: Metres
    """Outward shift of the left edge, m, 0 to 10."""
    right_m: Metres
    """Outward shift of the right edge, m, 0 to 10."""
    length_m: Metres
    """Path length over which the edges are shifted, m, 0 to 10."""
    dx_m: Shift = 0.0
    """Forward displacement of the path, m, -10 to 10 (default 0)."""
    dy_m: Shift = 0.0
    """Leftward displacement of the path, m, -10 to 10 (default 0)."""
    dheading_rad: Annotated[float, bounded(-3.15, 3.15)] = 0.0
    """Heading deviation to the left, rad, -3.15 to 3.15 (default 0)."""

    def transient(self) -> Transient:
        """Return the deviation as a `Transient`."""
        return Transient(*self.model_dump().values())


class TransientsFile(StrictModel):
    """Measured responses to changes of offset."""

    status: Status
    """Status of the values."""
    source: Source
    """Source of the measurements."""
    changes: Annotated[list[TransientFile], Field(min_length=1, max_length=200)]
    """Measured responses, one for each change of offset."""


class SpreadFile(StrictModel):
    """Spread of repeated measurements, with one value per offset."""

    source: Source
    """Description of the repetitions, and definition of the spread."""
    curvature_per_m: Spreads
    """Spread of the curvature, 1/m, 0 to 100."""
    speed_m_s: Spreads
    """Spread of the speed, m/s, 0 to 100."""
    left_m: Spreads
    """Spread of the left edge, m, 0 to 100."""
    right_m: Spreads
    """Spread of the right edge, m, 0 to 100."""


_KEYS = dict(
    zip(
        COLUMNS,
        ("offset", "curvature_per_m", "speed_m_s", "left_m", "right_m"),
        strict=True,
    )
)


class FootprintFile(StrictModel):
    """Contents of a footprint file, with one value per offset in each column."""

    name: str = Field(pattern=r"^[a-z][a-z0-9_]*$", min_length=1, max_length=60)
    """Short name."""
    title: str = Field(min_length=1, max_length=200)
    """One-line title."""
    robot: str = Field(min_length=1, max_length=200)
    """Robot that has this footprint."""
    contact: ContactName | None = None
    """Contact model of the twin with which the footprint was measured, if any."""
    offset: Offsets
    """Gait offsets in ascending order, positive to the left, -1 to 1."""
    curvature_per_m: Curvatures
    """Curvature of the path, 1/m, positive to the left, -100 to 100."""
    speed_m_s: Speeds
    """Speed of the centre of mass, m/s, 0.001 to 10."""
    left_m: Edges
    """Distance of the left edge from the path, m, 0.001 to 10."""
    right_m: Edges
    """Distance of the right edge from the path, m, 0.001 to 10."""
    ahead_m: Reach
    """Distance from the centre of mass to the head along the path, m, 0 to 10."""
    behind_m: Reach
    """Distance from the centre of mass to the tail along the path, m, 0 to 10."""
    spread: SpreadFile | None = None
    """Repeatability of the measurement, if known."""
    transients: TransientsFile | None = None
    """Responses to changes of offset, if measured."""
    excursions: Annotated[list[ExcursionsFile], Field(max_length=100)] | None = None
    """Excursions from which margins are computed, if measured."""

    @property
    def twin_contact(self) -> ContactName | None:
        """Contact model of the twin with which the footprint was measured, or None."""
        measured = self.curvature_per_m.source.startswith(MEASURED_ON_TWIN)
        return self.contact or (UNSTATED_CONTACT if measured else None)

    def mismatch(self, robot: str, contact: ContactName | None) -> str | None:
        """Return a warning if the footprint is of another robot or contact model.

        `contact` is the contact model of the twin, or None if no twin runs.
        """
        own = self.twin_contact
        option = f" --contact {contact}" if contact else ""
        if robot != self.robot:
            problem = f"is a footprint of {self.robot}, but the robot here is {robot}"
        elif contact and own not in (None, contact):
            problem = (
                f"was measured on a twin with contact {own}, but this twin has"
                f" contact {contact}"
            )
        else:
            return None
        if robot in shipped_names("robot"):
            problem += (
                f"; `srs-twin calibrate footprint {robot}{option}` measures a suitable"
                " footprint"
            )
        return f"{self.name} {problem}"

    def footprint(self) -> Footprint:
        """Return the footprint table without units, status and sources."""
        columns = {name: tuple(getattr(self, key).value) for name, key in _KEYS.items()}
        changes = self.transients.changes if self.transients else []
        return Footprint(
            self.name,
            self.title,
            **columns,
            ahead=self.ahead_m.value,
            behind=self.behind_m.value,
            transients=tuple(change.transient() for change in changes),
        )

    def contradictions(self) -> Iterator[tuple[Loc, str]]:
        """Yield the location and the message of each inconsistency."""
        rows = len(self.offset.value)
        for key in (*_KEYS.values(),)[1:] if self.spread else ():
            count = len(getattr(self.spread, key))
            if count != rows:
                yield (
                    ("spread", key),
                    f"{count} values are given for {rows} offsets; give one value for"
                    " each offset",
                )
        for name, message in find_problems(self.footprint()):
            yield (_KEYS[name], "value"), message


def load_footprint_file(name_or_path: StrPath) -> FootprintFile:
    """Load and check a shipped footprint (by name) or a footprint file (by path)."""
    return load_model(FootprintFile, find_file("footprint", name_or_path))


def load_footprint(name_or_path: StrPath) -> Footprint:
    """Load a footprint by name, such as gen4_table8, or from a footprint file.

    Raises:
        InputError: the file is not found or cannot be read.
        InputFileError: the file is not a valid footprint file.
    """
    return load_footprint_file(name_or_path).footprint()


def save_footprint(
    file: FootprintFile, path: StrPath, *, header: Sequence[str] = ()
) -> None:
    """Write a footprint file atomically, with `header` as a comment at the top."""
    document = Document(os.fspath(path))
    for loc, message in file.contradictions():
        document.report(loc, message)
    document.raise_problems()
    comment = "".join(f"# {line}\n" for line in header)
    write_text(
        path,
        comment
        + dump_yaml(file.model_dump(mode="json", exclude_none=True), compact=True),
    )


@dataclass(frozen=True)
class Margin:
    """Margins of a footprint on the path and on the straight lead-in, m."""

    path: float = 0.0
    lead_in: float = 0.0


def excursion_quantile(excursions: Sequence[float], probability: float) -> float:
    """Return the limit (m) within which a new run stays with a given probability."""
    count = len(excursions)
    # The tolerance covers rounding errors of products such as 20 · 0.95.
    rank = math.ceil((count + 1) * probability - 1e-9)
    if rank > count:
        least = math.ceil(probability / (1 - probability) - 1e-9)
        raise InputError(
            f"a margin with probability {probability:g} needs at least {least}"
            f" measured runs, but only {count} exist"
        )
    excursion = sorted(excursions)[rank - 1]
    if excursion >= LOST_M:
        raise InputError(
            f"no margin exists for a probability of {probability:g}, because too many"
            " runs did not reach the goal; choose a smaller probability"
        )
    return max(excursion, 0.0)


def margin_for(
    measured: Sequence[ExcursionsFile],
    probability: float,
    conditions: Sequence[ConditionsFile],
) -> Margin:
    """Return the margin within which a run stays with a given probability.

    Args:
        measured: measured excursions, one entry per set of conditions.
        probability: probability that a whole run stays within the margin.
        conditions: conditions of the run, one entry per plant.
    """
    paths = [0.0]
    lead_ins = [0.0]
    for condition in conditions:
        covering = [block for block in measured if block.conditions.covers(condition)]
        if not covering:
            items = condition.model_dump(exclude_none=True).items()
            text = ", ".join(f"{key} {value}" for key, value in items)
            raise InputError(
                f"no deviations from the path have been measured for {text}; measure"
                " them with `srs-twin calibrate margin`"
            )
        # Only one set of measurements is used, because runs would exceed the minimum
        # over several sets too often.
        block = min(
            covering, key=lambda block: block.conditions.excess_difficulty(condition)
        )
        paths.append(excursion_quantile(block.path_m, probability))
        lead_ins.append(
            excursion_quantile(
                block.lead_in_m or [0.0] * len(block.path_m), probability
            )
        )
    return Margin(max(paths), max(lead_ins))
