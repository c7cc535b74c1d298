"""Fit files, which store a fit with its data, command line and package versions.

A fit file lists each data set with its SHA-256 and its role, "fit" or "validation". No
sample may have both roles.
"""

from __future__ import annotations

import hashlib
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Annotated, ClassVar, Literal, Protocol, TypeVar

import numpy as np
from pydantic import Field

from srs_twin.errors import InputError, UnknownNameError
from srs_twin.identification.estimate import (
    FitEstimate,
    Parameter,
    Role,
    Verdict,
    with_value,
)
from srs_twin.identification.parameters import parameter_unit
from srs_twin.io.documents import Loc, dump_yaml
from srs_twin.io.files import StrPath, require_file, write_text
from srs_twin.io.validation import StrictModel, load_model
from srs_twin.robot.sourced import bounded
from srs_twin.trajectory import HtmlResult, Trajectory


@dataclass(frozen=True)
class DataSet:
    """Data set used for a fit or for its validation.

    Attributes:
        name: file name or label.
        sha256: SHA-256 of the file, or of the values if there is no file.
        from_s: start of the used interval, s, or None for the start of the data.
        to_s: end of the used interval, s, or None for the end of the data.
    """

    name: str
    sha256: str
    role: Role
    samples: int
    from_s: float | None = None
    to_s: float | None = None

    def overlaps(self, other: DataSet) -> bool:
        """Return whether the two data sets have samples in common."""
        if self.sha256 != other.sha256:
            return False
        if (
            self.from_s is None
            or self.to_s is None
            or other.from_s is None
            or other.to_s is None
        ):
            return True
        return self.from_s < other.to_s and other.from_s < self.to_s


class Data(Protocol):
    """Protocol for measurements that a fit can use."""

    def data_set(self, role: Role) -> DataSet:
        """Return the name, hash and size of the data."""


Measured = TypeVar("Measured", bound=Data)


def assign_roles(
    label: str, fitted: Iterable[Measured], validation: Iterable[Measured]
) -> list[tuple[Measured, Role]]:
    """Return the data of a fit, each paired with the role "fit" or "validation".

    The argument `label` is the plural noun for the data in error messages.
    """
    result: list[tuple[Measured, Role]] = [(data, "fit") for data in fitted]
    if not result:
        raise InputError(f"no {label} are given; give at least one")
    result += [(data, "validation") for data in validation]
    check_disjoint(data.data_set(role) for data, role in result)
    return result


def data_sets(fitted: Iterable[Data], validation: Iterable[Data]) -> list[DataSet]:
    """Return the data sets of a fit, each with its role."""
    return [
        data.data_set(role) for data, role in assign_roles("data", fitted, validation)
    ]


def check_disjoint(sets: Iterable[DataSet]) -> None:
    """Check that no sample is used for both fit and validation."""
    all_sets = list(sets)
    fitted = [entry for entry in all_sets if entry.role == "fit"]
    validation = [entry for entry in all_sets if entry.role == "validation"]
    for used, new in product(fitted, validation):
        if used.overlaps(new):
            raise InputError(
                f"{new.name}: this data set contains the same data as {used.name}, to"
                " which the model is fitted; validate with other data"
            )


def array_hash(*arrays: np.ndarray) -> str:
    """Return the SHA-256 of arrays and their shapes as a hexadecimal string."""
    digest = hashlib.sha256()
    for array in arrays:
        values = np.ascontiguousarray(array, dtype=float)
        digest.update(repr(values.shape).encode() + values.tobytes())
    return digest.hexdigest()


def trajectory_hash(trajectory: Trajectory) -> str:
    """Return the SHA-256 of the source file, or of the columns if no file exists."""
    source = trajectory.metadata.get("source")
    if isinstance(source, dict) and isinstance(source.get("sha256"), str):
        return str(source["sha256"])
    return array_hash(*(trajectory[name] for name in sorted(trajectory.columns)))


Number = Annotated[float, bounded(-1e12, 1e12)]
Count = Annotated[int, bounded(0, 10**9)]
Text = Annotated[str, Field(min_length=1, max_length=200)]
Long = Annotated[str, Field(max_length=1000)]
Averages = Annotated[dict[str, Number], Field(max_length=20)]
Fraction = Annotated[float, bounded(-1.0, 1.0)]
Size = Annotated[float, bounded(0.0, 1e12)]
Method = Literal[
    "pulls",
    "coasting",
    "actuator",
    "static",
    "locomotion",
    "damping",
    "offsets",
    "edges",
]

_MAX_COMMAND_LENGTH = 2000


def short_command(command: str) -> str:
    """Truncate a command to the maximum length in a fit file."""
    if len(command) <= _MAX_COMMAND_LENGTH:
        return command
    return command[: _MAX_COMMAND_LENGTH - 1] + "…"


_DIGITS = 9
"""Number of significant digits in a fit file."""

_NUMBERS = ("value", "standard_error", "low", "high")
"""Keys of a parameter that are omitted if the parameter has no value."""


class DataEntry(StrictModel):
    """Data set with its role."""

    name: Text
    """File name or label of the data."""
    sha256: Annotated[
        str, Field(pattern="^[0-9a-f]{64}$", min_length=64, max_length=64)
    ]
    """SHA-256 of the data as a hexadecimal string."""
    role: Role
    """Role of the data, which is validation if the fit does not use the data."""
    samples: Count
    """Number of samples, 0 to 1e9."""
    from_s: Number | None = None
    """Start of the used interval, s (default: start of the data)."""
    to_s: Number | None = None
    """End of the used interval, s (default: end of the data)."""
    measured: Averages | None = None
    """Measured averages, keyed by names that include the units."""
    predicted: Averages | None = None
    """Averages predicted with the fitted parameters, keyed by names with units."""

    def data_set(self) -> DataSet:
        """Return the data set of the entry."""
        return DataSet(**self.model_dump(exclude={"measured", "predicted"}))


class ParameterEntry(StrictModel):
    """Fitted parameter."""

    name: Text
    """Parameter name in the form section.key, with a number for a list element."""
    unit: Annotated[str, Field(min_length=1, max_length=20)]
    """Unit of `value`, `standard_error`, `low` and `high`."""
    verdict: Verdict
    """Verdict on the identifiability of the parameter."""
    value: Number | None = None
    """Estimated value, missing if the parameter is not identifiable."""
    standard_error: Size | None = None
    """Standard error of the estimate."""
    low: Number | None = None
    """Lower end of the 95 % confidence interval."""
    high: Number | None = None
    """Upper end of the 95 % confidence interval."""
    why: Long = ""
    """Reason for the verdict."""


class QualityFile(StrictModel):
    """Quality of a fit."""

    samples: Count
    """Number of fitted samples."""
    independent_samples: Annotated[float, bounded(0.0, 1e9)]
    """Equivalent number of independent samples."""
    rms: Size | None = None
    """RMS of the weighted residuals of the fit, which is 1 for the expected noise."""
    validation_rms: Size | None = None
    """RMS of the weighted residuals of the validation data."""
    converged: bool
    """Whether the search converged."""
    misfit: Annotated[list[Long], Field(max_length=20)] | None = None
    """Descriptions of the signals that the model does not explain (default: none)."""


class FitFile(StrictModel, HtmlResult):
    """File with the result of a fit."""

    page: ClassVar[str] = "fit"

    name: Annotated[
        str, Field(pattern=r"^[a-z][a-z0-9_]*$", min_length=1, max_length=60)
    ]
    """Short name of the fit."""
    title: Text
    """One-line title of the fit."""
    robot: Text
    """Name or path of the robot from which the fit started."""
    method: Method
    """Method of the fit."""
    command: Annotated[str, Field(min_length=1, max_length=_MAX_COMMAND_LENGTH)]
    """Command that produced the fit."""
    versions: Annotated[dict[str, Text], Field(max_length=30)]
    """Version of each package."""
    data: Annotated[list[DataEntry], Field(min_length=1, max_length=200)]
    """Data sets used for the fit and for the validation."""
    held: Annotated[dict[str, Number], Field(max_length=100)]
    """Values that were fixed in the fit and affect the estimates."""
    parameters: Annotated[list[ParameterEntry], Field(min_length=1, max_length=100)]
    """Fitted parameters."""
    correlation: Annotated[
        list[Annotated[list[Fraction], Field(max_length=100)]], Field(max_length=100)
    ]
    """Correlation matrix of the parameters that have a value, in the listed order."""
    cancels: Annotated[
        list[Annotated[dict[str, Fraction], Field(max_length=100)]],
        Field(max_length=100),
    ]
    """Unidentifiable directions, each as components keyed by parameter name."""
    derived: Annotated[list[ParameterEntry], Field(max_length=20)] | None = None
    """Quantities computed from the parameters, such as a frequency (default: none)."""
    quality: QualityFile
    """Quality of the fit."""

    def estimate(self) -> FitEstimate:
        """Return the stored estimate, which has no residuals."""
        parameters = tuple(
            Parameter(**parameter.model_dump()) for parameter in self.parameters
        )
        rows = with_value(parameters)
        correlation = np.full((len(parameters), len(parameters)), np.nan)
        if rows:
            correlation[np.ix_(rows, rows)] = self.correlation
        quality = self.quality
        return FitEstimate(
            parameters,
            correlation,
            cancels=tuple(self.cancels),
            samples=quality.samples,
            independent=quality.independent_samples,
            residual_scale=quality.rms or 0.0,
            held=dict(self.held),
            converged=quality.converged,
            derived=tuple(
                Parameter(**quantity.model_dump()) for quantity in self.derived or ()
            ),
        )

    def unidentified(self) -> list[str]:
        """Return the names of the parameters without an estimated or constant value."""
        return [
            parameter.name
            for parameter in self.parameters
            if parameter.value is None and parameter.name not in self.held
        ]

    def contradictions(self) -> Iterator[tuple[Loc, str]]:
        """Yield the location and the message of each inconsistency in the file."""
        yield from _check_data(self.data)
        missing = self.unidentified()
        for k, data in enumerate(self.data):
            if missing and data.predicted is not None:
                yield (
                    ("data", k, "predicted"),
                    f"a prediction is given, although {', '.join(missing)} has no"
                    " value; remove the prediction",
                )
        for k, parameter in enumerate(self.parameters):
            for loc, message in _check_parameter(parameter):
                yield ("parameters", k, *loc), message
        for name, count in Counter(
            parameter.name for parameter in self.parameters
        ).items():
            if count > 1:
                yield (
                    ("parameters",),
                    f"the parameter {name} is listed {count} times; list it once",
                )
        yield from _check_correlation(
            self.correlation, len(with_value(self.parameters))
        )


def fit_file(
    estimate: FitEstimate,
    *,
    name: str,
    title: str,
    robot: str,
    method: Method,
    command: str,
    versions: dict[str, str],
    data: Sequence[DataSet],
) -> FitFile:
    """Create a fit file from an estimate."""
    check_disjoint(data)
    rows = with_value(estimate.parameters)
    matrix = estimate.correlation[np.ix_(rows, rows)]
    quality = QualityFile(
        samples=estimate.samples,
        independent_samples=_rounded(estimate.independent),
        rms=_rounded_or_none(estimate.rms("fit")),
        validation_rms=_rounded_or_none(estimate.rms("validation")),
        converged=estimate.converged,
        misfit=[line[:1000] for line in estimate.misfit] or None,
    )
    return FitFile(
        name=name,
        title=title,
        robot=robot,
        method=method,
        command=command,
        versions=versions,
        data=[DataEntry(**asdict(entry)) for entry in data],
        held={key: _rounded(value) for key, value in estimate.held.items()},
        parameters=[_parameter_entry(parameter) for parameter in estimate.parameters],
        correlation=[[round(float(v), 6) for v in row] for row in matrix],
        cancels=[dict(direction) for direction in estimate.cancels],
        derived=[_parameter_entry(quantity) for quantity in estimate.derived] or None,
        quality=quality,
    )


def check_fit_suffix(option: str, path: Path) -> None:
    """Check that a path has the suffix of a fit file."""
    if path.suffix not in (".yaml", ".yml"):
        raise InputError(
            f"{option}: {path} is not allowed; the name of a fit file must end in .yaml"
        )


def write_fit(file: FitFile, path: StrPath) -> Path:
    """Write a fit file atomically."""
    write_text(path, dump_yaml(file.model_dump(mode="json", exclude_none=True)))
    return Path(path)


def load_fit(path: StrPath) -> FitFile:
    """Load and validate a fit file."""
    return load_model(FitFile, require_file(Path(path)), {("robot",): "robot"})


def _check_data(data: Sequence[DataEntry]) -> Iterator[tuple[Loc, str]]:
    for k, entry in enumerate(data):
        if (entry.from_s is None) != (entry.to_s is None):
            yield (
                ("data", k),
                "`from_s` and `to_s` belong together; give both or neither",
            )
        elif (
            entry.from_s is not None
            and entry.to_s is not None
            and entry.from_s > entry.to_s
        ):
            yield (
                ("data", k, "to_s"),
                f"must be at least {entry.from_s:g}, the value of `from_s`",
            )
    if not any(entry.role == "fit" for entry in data):
        yield (
            ("data",),
            (
                "no data set has the role `fit`; a fit needs at least one data set"
                " with this role"
            ),
        )
    try:
        check_disjoint(entry.data_set() for entry in data)
    except InputError as error:
        yield ("data",), str(error)


def _check_parameter(entry: ParameterEntry) -> Iterator[tuple[Loc, str]]:
    present = [name for name in _NUMBERS if getattr(entry, name) is not None]
    if entry.verdict == "not identifiable" and present:
        yield (
            (present[0],),
            (
                "a parameter that is not identifiable must not have a value; remove"
                " this key"
            ),
        )
    elif entry.verdict != "not identifiable" and len(present) < len(_NUMBERS):
        missing = next(name for name in _NUMBERS if name not in present)
        yield (
            ("verdict",),
            (
                f"the parameter has the verdict '{entry.verdict}', but `{missing}` is"
                " missing"
            ),
        )
    elif present and not entry.low <= entry.value <= entry.high:  # type: ignore[operator]
        yield (
            ("value",),
            f"must be between `low` and `high`, which are {entry.low:g} and"
            f" {entry.high:g}",
        )
    try:
        unit = parameter_unit(entry.name)
    except UnknownNameError as error:
        yield ("name",), str(error)
    else:
        if entry.unit != unit:
            yield ("unit",), f"must be {unit}, not {entry.unit}"


def _check_correlation(
    matrix: Sequence[Sequence[float]], count: int
) -> Iterator[tuple[Loc, str]]:
    if len(matrix) != count or any(len(row) != count for row in matrix):
        yield (
            ("correlation",),
            f"must be a {count} × {count} matrix with one row for each parameter that"
            " has a value",
        )
        return
    for i, row in enumerate(matrix):
        for j, entry in enumerate(row):
            if i == j and entry != 1.0:
                yield (
                    ("correlation", i, j),
                    (
                        "must be 1, because it is on the diagonal of a correlation"
                        " matrix"
                    ),
                )
            elif j < i and entry != matrix[j][i]:
                yield (
                    ("correlation", i, j),
                    f"must be {matrix[j][i]:g}, because a correlation matrix is"
                    " symmetric",
                )


def _parameter_entry(parameter: Parameter) -> ParameterEntry:
    numbers = {name: _rounded_or_none(getattr(parameter, name)) for name in _NUMBERS}
    return ParameterEntry(**asdict(parameter) | numbers | {"why": parameter.why[:1000]})


def _rounded(value: float) -> float:
    if math.isfinite(value):
        return float(f"{value:.{_DIGITS}g}")
    return 0.0


def _rounded_or_none(value: float | None) -> float | None:
    if value is None:
        return None
    return _rounded(value)
