r"""Offset runs: what speeds and radii at several steering offsets tell of a robot (Table 8).

Each row is one run: an offset φ, the speed v of the centre of mass and the radius R of its path. The plant is
driven as the robot was, through `Drive`, start and learning included, and held against

$$ v \quad\text{and}\quad \kappa = \operatorname{sgn}(\varphi)/R , $$

at φ = 0, where the table does not say to which side, with the sign of the side to which the other fitted
rows lean. Rows to validate with have no say in the values.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from published_tables import PublishedRun

from srs_twin.errors import DivergedError, InputError
from srs_twin.identification.estimate import Estimate, Parameter, Residual, Role, identifiability
from srs_twin.identification.fit_file import DataSet, fingerprint, with_roles
from srs_twin.identification.footprint import Drive, steady_path
from srs_twin.identification.least_squares import SearchOptions, least_squares
from srs_twin.identification.paths import SteadyPath
from srs_twin.identification.unknowns import Unknown, unknowns, with_values
from srs_twin.rollout import run_many

PERIODS = 5
"""At the end of a run, over which its path is measured."""

NOISE = {"speed": (0.013, "m/s"), "curvature": (0.1, "1/m")}
"""What a row may be off by: half of what offsets 0.3 and -0.3 of Table 8 differ by."""

_STEP = 3e-2  # z
_ENOUGH = 1e-3  # share of the sum of squares by which a step must lower it for the search to go on
_DIVERGED = 1e3


@dataclass(frozen=True)
class OffsetRun:
    """One measured run.

    Attributes:
        offset: φ, positive to the left.
        speed: of the centre of mass, m/s.
        curvature: of its path, 1/m, positive to the left.
    """

    offset: float
    speed: float
    curvature: float

    @property
    def radius(self) -> float:
        """Of the path, m, without a sign."""
        return 1 / abs(self.curvature) if self.curvature else math.inf

    def data_set(self, role: Role) -> DataSet:
        """Return what a fit says of these data."""
        sha256 = fingerprint(np.array([self.offset, self.speed, self.curvature]))
        return DataSet(f"offset {self.offset:g}", sha256, role, 2)


def offset_runs(rows: Sequence[PublishedRun]) -> list[OffsetRun]:
    """Return a table's rows with the signs of their paths.

    Args:
        rows: as printed; radii have no sign. Offset 0 is taken to the side to which these rows lean: pairs
            of opposite offsets among them, so give rows to fit and rows to validate with one after the other.
    """
    by_offset = {row.offset: row for row in rows}
    pairs = [each for each in by_offset if each > 0 and -each in by_offset]
    lean = sum(1 / by_offset[each].radius_m - 1 / by_offset[-each].radius_m for each in pairs)
    return [
        OffsetRun(row.offset, row.speed_m_s, math.copysign(1 / row.radius_m, row.offset or lean))
        for row in rows
    ]


def predicted(
    drive: Drive, offsets: Sequence[float], *, threads: int | None = None
) -> list[SteadyPath | None]:
    """Return the settled path at each offset; None where the plant diverges or gets nowhere.

    Args:
        drive: robot, controller, plant.
        offsets: φ of each run.
        threads: how many runs at once; default one a processor.
    """
    maker = drive.plant_maker()
    jobs = [drive.steady_job(maker, offset, 0.0, PERIODS) for offset in offsets]
    found: list[SteadyPath | None] = []
    for run in run_many(jobs, threads=threads):
        try:
            found.append(None if isinstance(run, DivergedError) else steady_path(drive, run, PERIODS))
        except InputError:
            found.append(None)
    return found


def fit_offsets(
    runs: Sequence[OffsetRun],
    drive: Drive,
    names: Iterable[str],
    *,
    besides: Iterable[str] = (),
    validation: Sequence[OffsetRun] = (),
    starting: Mapping[str, float] | None = None,
    noise: Mapping[str, float] | None = None,
    threads: int | None = None,
) -> Estimate:
    """Return what runs at several offsets tell of a robot.

    Args:
        runs: what was measured.
        drive: how the robot was driven, which plant stands for it, and the robot that the search starts from.
        names: what is unknown, see `unknowns`.
        besides: what is held, but asked after: of these the estimate says which could not be told beside the
            unknowns.
        validation: runs to hold the estimate against.
        starting: other values to start from, by name.
        noise: other values for `NOISE`, by name.
        threads: runs at once; default one a processor.

    Raises:
        InputError: no run, too few for so many unknowns, or one to validate with that is also fitted.
    """
    with_roles("runs at offsets", runs, validation)
    scales = {name: (noise or {}).get(name, scale) for name, (scale, _) in NOISE.items()}
    fitted, kept = (
        _Rows(tuple(runs), drive, "fit", scales, threads),
        _Rows(tuple(validation), drive, "validation", scales, threads),
    )
    wanted = unknowns(drive.spec, names, starts=starting)
    # Validated where the search ended, also in what these data do not tell: never with what it began from.
    validating = kept.residuals if validation else None
    options = SearchOptions(_STEP, tolerance=_ENOUGH)
    estimate = least_squares(fitted.residuals, wanted, options=options, validation=validating)
    others = unknowns(drive.spec, besides)
    hidden = [_hidden(fitted, estimate, wanted, other) for other in others]
    return replace(
        estimate,
        parameters=(*estimate.parameters, *(each for each in hidden if each)),
        correlation=np.pad(
            estimate.correlation, (0, sum(each is not None for each in hidden)), constant_values=np.nan
        ),
        held={each.name: each.start for each in others},
    )


def _hidden(rows: _Rows, estimate: Estimate, wanted: Sequence[Unknown], other: Unknown) -> Parameter | None:
    """Return a held number as not identifiable, None where the data could have told it beside the others."""
    told = [each for each in wanted if each.name in estimate.values]
    everything = [*told, other]
    values = [*(estimate.values[each.name] for each in told), other.start]
    z = np.array([each.coordinate(value) for each, value in zip(everything, values, strict=True)])

    def jacobian(h: float) -> np.ndarray:
        return np.stack([_slope(rows, everything, z, i, h) for i in range(len(z))], axis=1)

    fine, coarse = jacobian(_STEP), jacobian(2 * _STEP)
    noise = estimate.residual_scale * math.sqrt(estimate.samples / estimate.independent)
    widths = np.array([each.coordinate(each.high) - each.coordinate(each.low) for each in everything])
    known = identifiability(fine, coarse - fine, noise, widths)
    if not known.hidden(-1):
        return None
    size = float(np.abs(fine[:, -1]).max())
    beside = ", ".join(each.name for each in told)
    why = (
        f"held at {other.start:g}; beside {beside} its standard error would be {known.errors[-1]:.2g} in "
        f"units that matter, one of which changes the data by {size:.2g} times the noise at most"
    )
    return Parameter(other.name, other.unit, "not identifiable", why=why)


def _slope(rows: _Rows, unknowns: Sequence[Unknown], z: np.ndarray, i: int, h: float) -> np.ndarray:
    """Return the derivative of the weighted residuals by coordinate i."""

    def weighted(at: float) -> np.ndarray:
        moved = z.copy()
        moved[i] = at
        values = {each.name: each.value(float(v)) for each, v in zip(unknowns, moved, strict=True)}
        held = unknowns[-1]
        if i < len(z) - 1:
            del values[held.name]
        return np.concatenate([each.values / each.scale for each in rows.residuals(values)])

    up, down = z[i] + h, max(z[i] - h, unknowns[i].coordinate(unknowns[i].low))
    slope: np.ndarray = (weighted(up) - weighted(down)) / (up - down)
    return slope


class _Rows:
    """Runs of one role, and by how much a robot misses them."""

    def __init__(
        self,
        runs: tuple[OffsetRun, ...],
        drive: Drive,
        role: Role,
        scales: Mapping[str, float],
        threads: int | None,
    ) -> None:
        self._runs, self._drive, self._role, self._scales, self._threads = runs, drive, role, scales, threads
        # Searches and verdicts come back to the same values, and runs are dear.
        self._known: dict[tuple[tuple[str, float], ...], list[SteadyPath | None]] = {}

    def residuals(self, values: Mapping[str, float]) -> list[Residual]:
        """Return measured less predicted, speed and curvature of each run."""
        key = tuple(sorted((name, float(f"{value:.9g}")) for name, value in values.items()))
        if key not in self._known:
            moved = replace(self._drive, spec=with_values(self._drive.spec, values))
            self._known[key] = predicted(moved, [run.offset for run in self._runs], threads=self._threads)
        found = []
        for run, path in zip(self._runs, self._known[key], strict=True):
            for name, (_, unit) in NOISE.items():
                off = getattr(run, name) - getattr(path, name) if path else _DIVERGED
                label = f"offset {run.offset:g} {name}"
                found.append(Residual(label, unit, np.array([off]), self._scales[name], self._role))
        return found
