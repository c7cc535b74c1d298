"""Fit files: what a fit found, from which data, by which command and versions; calibration/fits/*.yaml.

Which data made the fit and which were kept for validation stands beside each hash; a file in which the same
data are both is refused. What is not identifiable has no number in it.
"""

from __future__ import annotations

import hashlib
import math
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Protocol, TypeVar

import numpy as np
from pydantic import Field

from srs_twin.errors import InputError, UnknownNameError
from srs_twin.identification.estimate import Estimate, Parameter, Role, Verdict
from srs_twin.identification.unknowns import unit_of
from srs_twin.io.documents import Loc, dump_yaml
from srs_twin.io.files import existing, write_text
from srs_twin.io.validation import Strict, load_model
from srs_twin.robot.sourced import between
from srs_twin.trajectory import Shown, Trajectory


@dataclass(frozen=True)
class DataSet:
    """One set of data.

    Attributes:
        name: of its file, or what it is called.
        sha256: of the file, or of the numbers where there is none, hexadecimal.
        role: "fit", or "validation": looked at when the fit is done.
        samples: how many.
        from_s: where the part that was used begins, s; None: all of it was.
        to_s: where it ends, s.
    """

    name: str
    sha256: str
    role: Role
    samples: int
    from_s: float | None = None
    to_s: float | None = None

    def overlaps(self, other: DataSet) -> bool:
        """Say whether both hold the same samples."""
        if self.sha256 != other.sha256:
            return False
        if self.from_s is None or self.to_s is None or other.from_s is None or other.to_s is None:
            return True
        return self.from_s < other.to_s and other.from_s < self.to_s


class Data(Protocol):
    """What was measured, in any form."""

    def data_set(self, role: Role) -> DataSet:
        """Return what a fit says of these data."""


Measured = TypeVar("Measured", bound=Data)


def with_roles(
    what: str, fitted: Iterable[Measured], validation: Iterable[Measured]
) -> list[tuple[Measured, Role]]:
    """Return all data of a fit with their roles.

    Args:
        what: what the data are called, in the plural.
        fitted: what the fit is made from.
        validation: what it is held against.

    Raises:
        InputError: nothing to fit, or data of both roles with samples in common.
    """
    found: list[tuple[Measured, Role]] = [(each, "fit") for each in fitted]
    if not found:
        raise InputError(f"{what} are wanted; none was given")
    found += [(each, "validation") for each in validation]
    keep_apart(each.data_set(role) for each, role in found)
    return found


def data_sets(fitted: Iterable[Data], validation: Iterable[Data]) -> list[DataSet]:
    """Return what a fit says of all its data."""
    return [each.data_set(role) for each, role in with_roles("data", fitted, validation)]


def keep_apart(sets: Iterable[DataSet]) -> None:
    """Refuse data that a fit would be validated with although it has seen them.

    Raises:
        InputError: a set of each role have samples in common.
    """
    everything = list(sets)
    fitted = [each for each in everything if each.role == "fit"]
    kept = [each for each in everything if each.role == "validation"]
    for seen, new in product(fitted, kept):
        if seen.overlaps(new):
            raise InputError(
                f"{new.name}: the same data as {seen.name}, which the fit is made from; what validates a fit "
                "must be new to it"
            )


def fingerprint(*arrays: np.ndarray) -> str:
    """Return the SHA-256 of numbers and their shapes, hexadecimal."""
    total = hashlib.sha256()
    for array in arrays:
        values = np.ascontiguousarray(array, dtype=float)
        total.update(repr(values.shape).encode() + values.tobytes())
    return total.hexdigest()


def trajectory_hash(trajectory: Trajectory) -> str:
    """Return the SHA-256 of the recorded file, or of the columns where there is none."""
    source = trajectory.metadata.get("source")
    if isinstance(source, dict) and isinstance(source.get("sha256"), str):
        return str(source["sha256"])
    return fingerprint(*(trajectory[name] for name in sorted(trajectory.columns)))


Number = Annotated[float, between(-1e12, 1e12)]
Count = Annotated[int, between(0, 10**9)]
Text = Annotated[str, Field(min_length=1, max_length=200)]
Long = Annotated[str, Field(max_length=1000)]
Averages = Annotated[dict[str, Number], Field(max_length=20)]
Share = Annotated[float, between(-1.0, 1.0)]
Size = Annotated[float, between(0.0, 1e12)]
Method = Literal["pulls", "coasting", "actuator", "static", "locomotion", "offsets", "edges"]

_DIGITS = 9
_NUMBERS = ("value", "standard_error", "low", "high")


class DataEntry(Strict):
    """One set of data and what it was used for."""

    name: Text
    """File, or what the data are called."""
    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$", min_length=64, max_length=64)]
    """Of the data."""
    role: Role
    """fit: the values come from it; validation: the fit has not seen it."""
    samples: Count
    """How many, 0 to 1e9."""
    from_s: Number | None = None
    """Where the part that was used begins, s (default: all)."""
    to_s: Number | None = None
    """Where it ends, s (default: all)."""
    measured: Averages | None = None
    """Averages of it, by name with unit."""
    predicted: Averages | None = None
    """The same of the plant with what was found."""

    def data_set(self) -> DataSet:
        """Return the entry as the fits have it."""
        return DataSet(**self.model_dump(exclude={"measured", "predicted"}))


class ParameterEntry(Strict):
    """One number that was looked for."""

    name: Text
    """As in robot files, section.key, with a number behind it for lists."""
    unit: Annotated[str, Field(min_length=1, max_length=20)]
    """Of all numbers here."""
    verdict: Verdict
    """What these data say of it."""
    value: Number | None = None
    """The estimate; none where it is not identifiable."""
    standard_error: Size | None = None
    """Of the estimate."""
    low: Number | None = None
    """Lower end of the 95 % confidence interval."""
    high: Number | None = None
    """Upper end."""
    why: Long = ""
    """What the verdict rests on."""


class QualityFile(Strict):
    """How well the data were met."""

    samples: Count
    """Samples that were fitted."""
    independent_samples: Annotated[float, between(0.0, 1e9)]
    """What they are worth."""
    rms: Size | None = None
    """Weighted residuals of the fit; 1 where they are as large as expected."""
    validation_rms: Size | None = None
    """Of the validation."""
    converged: bool
    """Whether the search came to an end."""
    misfit: Annotated[list[Long], Field(max_length=20)] | None = None
    """What is left where the model does not explain the data (default: it does)."""


class FitFile(Strict, Shown):
    """What a fit found."""

    page: ClassVar[str] = "fit"

    name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$", min_length=1, max_length=60)]
    """Short name."""
    title: Text
    """One line for people."""
    robot: Text
    """Robot that the fit started from, a name or a path."""
    method: Method
    """What was fitted."""
    command: Annotated[str, Field(min_length=1, max_length=2000)]
    """How it was made."""
    versions: Annotated[dict[str, Text], Field(max_length=30)]
    """Package: version."""
    data: Annotated[list[DataEntry], Field(min_length=1, max_length=200)]
    """All data."""
    held: Annotated[dict[str, Number], Field(max_length=100)]
    """What was taken as known and the values refer to."""
    parameters: Annotated[list[ParameterEntry], Field(min_length=1, max_length=100)]
    """What was looked for."""
    correlation: Annotated[list[Annotated[list[Share], Field(max_length=100)]], Field(max_length=100)]
    """Of what has a number, in the order of the parameters."""
    cancels: Annotated[list[Annotated[dict[str, Share], Field(max_length=100)]], Field(max_length=100)]
    """Directions in which nothing changes: name and share."""
    quality: QualityFile
    """How well the data were met."""

    def estimate(self) -> Estimate:
        """Return the estimate, without residuals."""
        parameters = tuple(Parameter(**each.model_dump()) for each in self.parameters)
        rows = [k for k, each in enumerate(parameters) if each.value is not None]
        correlation = np.full((len(parameters), len(parameters)), np.nan)
        if rows:
            correlation[np.ix_(rows, rows)] = self.correlation
        quality = self.quality
        return Estimate(
            parameters,
            correlation,
            cancels=tuple(self.cancels),
            samples=quality.samples,
            independent=quality.independent_samples,
            residual_scale=quality.rms or 0.0,
            held=dict(self.held),
            converged=quality.converged,
        )

    def withheld(self) -> list[str]:
        """Return what was looked for and has no number, neither found nor held; nothing can be predicted."""
        return [each.name for each in self.parameters if each.value is None and each.name not in self.held]

    def contradictions(self) -> Iterator[tuple[Loc, str]]:
        """Yield path and message of what does not fit together."""
        yield from _apart(self.data)
        missing = self.withheld()
        for k, data in enumerate(self.data):
            if missing and data.predicted is not None:
                yield ("data", k, "predicted"), f"predicted without a number for {', '.join(missing)}"
        for k, each in enumerate(self.parameters):
            yield from ((("parameters", k, *loc), said) for loc, said in _doubts(each))
        for name, count in Counter(each.name for each in self.parameters).items():
            if count > 1:
                yield ("parameters",), f"{name} stands here {count} times"
        yield from _square(self.correlation, sum(each.value is not None for each in self.parameters))


def fit_file(
    estimate: Estimate,
    *,
    data: Sequence[DataSet],
    averages: Mapping[str, tuple[dict[str, float], dict[str, float]]] | None = None,
    **about: Any,
) -> FitFile:
    """Return what is written of an estimate.

    Args:
        estimate: what was found.
        data: all data with their roles.
        averages: name of data → what was measured, and what the plant gives with what was found.
        **about: name, title, robot, method, command and versions of the `FitFile`.

    Raises:
        InputError: data that are of both roles, or predictions without a number for what was looked for.
    """
    keep_apart(data)
    rows = [k for k, each in enumerate(estimate.parameters) if each.value is not None]
    matrix = estimate.correlation[np.ix_(rows, rows)]
    quality = QualityFile(
        samples=estimate.samples,
        independent_samples=_rounded(estimate.independent),
        rms=_maybe(estimate.rms("fit")),
        validation_rms=_maybe(estimate.rms("validation")),
        converged=estimate.converged,
        misfit=[line[:1000] for line in estimate.misfit] or None,
    )
    file = FitFile(
        **about,
        data=[_data_entry(each, (averages or {}).get(each.name, (None, None))) for each in data],
        held={key: _rounded(value) for key, value in estimate.held.items()},
        parameters=[_entry(each) for each in estimate.parameters],
        correlation=[[round(float(v), 6) for v in row] for row in matrix],
        cancels=[dict(each) for each in estimate.cancels],
        quality=quality,
    )
    if averages and file.withheld():
        raise InputError(
            f"{file.name}: {', '.join(file.withheld())} got no number, so that nothing can be predicted; "
            "hold one of them at a value that the file states"
        )
    return file


def _data_entry(data: DataSet, averages: tuple[Mapping[str, float] | None, ...]) -> DataEntry:
    measured, predicted = (
        None if each is None else {name: float(f"{value:.6g}") for name, value in each.items()}
        for each in averages
    )
    return DataEntry(**asdict(data), measured=measured, predicted=predicted)


def write_fit(file: FitFile, path: str | os.PathLike[str]) -> Path:
    """Write a fit file, whole or not at all.

    Raises:
        InputError: the place cannot be written.
    """
    write_text(path, dump_yaml(file.model_dump(mode="json", exclude_none=True)))
    return Path(path)


def load_fit(path: str | os.PathLike[str]) -> FitFile:
    """Load and check a fit file.

    Raises:
        InputError: not found or not readable.
        InputFileError: everything that is wrong with it.
    """
    return load_model(FitFile, existing(Path(path)))


def _apart(data: Sequence[DataEntry]) -> Iterator[tuple[Loc, str]]:
    for k, each in enumerate(data):
        if (each.from_s is None) != (each.to_s is None):
            yield ("data", k), "from_s and to_s stand together"
        elif each.from_s is not None and each.to_s is not None and each.from_s > each.to_s:
            yield ("data", k, "to_s"), f"must be {each.from_s:g} or more"
    if not any(each.role == "fit" for each in data):
        yield ("data",), "none of role fit; a fit is made from data"
    try:
        keep_apart(each.data_set() for each in data)
    except InputError as error:
        yield ("data",), str(error)


def _doubts(each: ParameterEntry) -> Iterator[tuple[Loc, str]]:
    given = [name for name in _NUMBERS if getattr(each, name) is not None]
    if each.verdict == "not identifiable" and given:
        yield (given[0],), "what is not identifiable has no number"
    elif each.verdict != "not identifiable" and len(given) < len(_NUMBERS):
        missing = next(name for name in _NUMBERS if name not in given)
        yield ("verdict",), f"{each.verdict}, but {missing} is missing"
    elif given and not each.low <= each.value <= each.high:  # type: ignore[operator]
        yield ("value",), f"must lie between low and high, {each.low:g} and {each.high:g}"
    try:
        unit = unit_of(each.name)
    except UnknownNameError as error:
        yield ("name",), str(error)
    else:
        if each.unit != unit:
            yield ("unit",), f"must be {unit}, not {each.unit}"


def _square(matrix: Sequence[Sequence[float]], count: int) -> Iterator[tuple[Loc, str]]:
    if len(matrix) != count or any(len(row) != count for row in matrix):
        yield ("correlation",), f"must have {count} rows of {count}, one for each parameter with a number"
        return
    for i, row in enumerate(matrix):
        for j, entry in enumerate(row):
            if i == j and entry != 1.0:
                yield ("correlation", i, j), "must be 1 on the diagonal"
            elif j < i and entry != matrix[j][i]:
                yield ("correlation", i, j), f"must be {matrix[j][i]:g}, as across the diagonal"


def _entry(each: Parameter) -> ParameterEntry:
    numbers = {name: _maybe(getattr(each, name)) for name in _NUMBERS}
    return ParameterEntry(**asdict(each) | numbers | {"why": each.why[:1000]})


def _rounded(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}") if math.isfinite(value) else 0.0


def _maybe(value: float | None) -> float | None:
    return None if value is None else _rounded(value)
