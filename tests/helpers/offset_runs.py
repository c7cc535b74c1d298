r"""Fits to speeds and radii at several steering offsets (Table 8).

Each row is one run with offset φ, speed v of the centre of mass and radius R of the
path. The plant is driven with the same start and learning as the robot (`GaitSetup`)
and compared with

$$ v \quad\text{and}\quad \kappa = \operatorname{sgn}(\varphi)/R . $$

The table has no side for φ = 0; the sign there follows from the asymmetry of the other
fitted rows. Validation rows do not affect the estimate.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from published_tables import PublishedRun

from srs_twin.errors import DivergedError, InputError
from srs_twin.identification.estimate import FitEstimate, Parameter, Residual, Role
from srs_twin.identification.fit_file import DataSet, array_hash, assign_roles
from srs_twin.identification.footprint import GaitSetup, steady_path
from srs_twin.identification.identifiability import identifiability
from srs_twin.identification.least_squares import SearchOptions, least_squares
from srs_twin.identification.parameters import (
    FreeParameter,
    free_parameters,
    with_values,
)
from srs_twin.identification.paths import SteadyPath
from srs_twin.rollout import run_many

PERIODS = 5
"""Number of periods at the end of a run over which the path is measured."""

NOISE = {"speed": (0.013, "m/s"), "curvature": (0.1, "1/m")}
"""Standard deviation of a row: half the difference between offsets 0.3 and -0.3 in Table 8."""

_STEP = 3e-2  # z
_ENOUGH = (
    1e-3  # smallest relative decrease of the sum of squares per step of the search
)
_DIVERGED = 1e3


@dataclass(frozen=True)
class OffsetRun:
    """One measured run.

    Attributes:
        offset: φ, positive to the left.
        speed: speed of the centre of mass, m/s.
        curvature: curvature of the path, 1/m, positive to the left.
    """

    offset: float
    speed: float
    curvature: float

    @property
    def radius(self) -> float:
        """Radius of the path, m, without a sign."""
        return 1 / abs(self.curvature) if self.curvature else math.inf

    def data_set(self, role: Role) -> DataSet:
        """Return the record of these data in a fit."""
        sha256 = array_hash(np.array([self.offset, self.speed, self.curvature]))
        return DataSet(f"offset {self.offset:g}", sha256, role, 2)


def offset_runs(rows: Sequence[PublishedRun]) -> list[OffsetRun]:
    """Return the rows of a table with signed curvatures.

    Args:
        rows: printed rows without signs of the radii. The sign of offset 0 follows from
            the pairs of opposite offsets among the rows, so convert fitted and
            validation rows separately.
    """
    by_offset = {row.offset: row for row in rows}
    pairs = [item for item in by_offset if item > 0 and -item in by_offset]
    lean = sum(
        1 / by_offset[item].radius_m - 1 / by_offset[-item].radius_m for item in pairs
    )
    return [
        OffsetRun(
            row.offset,
            row.speed_m_s,
            math.copysign(1 / row.radius_m, row.offset or lean),
        )
        for row in rows
    ]


def predicted(
    drive: GaitSetup, offsets: Sequence[float], *, threads: int | None = None
) -> list[SteadyPath | None]:
    """Return the steady path at each offset; None if the plant diverges or does not advance.

    Args:
        drive: robot, controller and plant.
        offsets: φ of each run.
        threads: number of parallel runs; default: one per processor.
    """
    maker = drive.plant_factory()
    jobs = [drive.steady_job(maker, offset, 0.0, PERIODS) for offset in offsets]
    result: list[SteadyPath | None] = []
    for run in run_many(jobs, threads=threads):
        try:
            result.append(
                None
                if isinstance(run, DivergedError)
                else steady_path(drive, run, PERIODS)
            )
        except InputError:
            result.append(None)
    return result


def fit_offsets(
    runs: Sequence[OffsetRun],
    drive: GaitSetup,
    names: Iterable[str],
    *,
    besides: Iterable[str] = (),
    validation: Sequence[OffsetRun] = (),
    starting: Mapping[str, float] | None = None,
    noise: Mapping[str, float] | None = None,
    threads: int | None = None,
) -> FitEstimate:
    """FitEstimate robot parameters from runs at several offsets.

    Args:
        runs: measured runs.
        drive: controller and plant, and the initial robot of the search.
        names: unknown parameters, see `unknowns`.
        besides: fixed parameters to test: the estimate names those that could not be
            identified in addition.
        validation: runs to validate the estimate.
        starting: other initial values, by name.
        noise: other values of `NOISE`, by name.
        threads: number of parallel runs; default: one per processor.

    Raises:
        InputError: there is no run, there are more unknowns than data, or a validation
            run is also fitted.
    """
    assign_roles("runs at offsets", runs, validation)
    scales = {
        name: (noise or {}).get(name, scale) for name, (scale, _) in NOISE.items()
    }
    fitted = _Rows(tuple(runs), drive, "fit", scales, threads)
    kept = _Rows(tuple(validation), drive, "validation", scales, threads)
    wanted = free_parameters(drive.spec, names, starts=starting)
    # Validate with the final values of all parameters, also of unidentifiable ones.
    validating = kept.residuals if validation else None
    options = SearchOptions(_STEP, tolerance=_ENOUGH)
    estimate = least_squares(
        fitted.residuals, wanted, options=options, validation=validating
    )
    others = free_parameters(drive.spec, besides)
    hidden = [_hidden(fitted, estimate, wanted, other) for other in others]
    return replace(
        estimate,
        parameters=(*estimate.parameters, *(item for item in hidden if item)),
        correlation=np.pad(
            estimate.correlation,
            (0, sum(item is not None for item in hidden)),
            constant_values=np.nan,
        ),
        held={item.name: item.start for item in others},
    )


def _hidden(
    rows: _Rows,
    estimate: FitEstimate,
    wanted: Sequence[FreeParameter],
    other: FreeParameter,
) -> Parameter | None:
    """Return a fixed parameter as not identifiable; None if the data could identify it in addition."""
    prediction = [item for item in wanted if item.name in estimate.values]
    everything = [*prediction, other]
    values = [*(estimate.values[item.name] for item in prediction), other.start]
    z = np.array(
        [item.coordinate(value) for item, value in zip(everything, values, strict=True)]
    )

    def jacobian(h: float) -> np.ndarray:
        return np.stack(
            [_derivative(rows, everything, z, i, h) for i in range(len(z))], axis=1
        )

    fine = jacobian(_STEP)
    coarse = jacobian(2 * _STEP)
    noise = estimate.residual_scale * math.sqrt(estimate.samples / estimate.independent)
    widths = np.array(
        [item.coordinate(item.high) - item.coordinate(item.low) for item in everything]
    )
    names = [item.name for item in everything]
    known = identifiability(fine, coarse - fine, noise, widths, names)
    if not known.is_unidentifiable(-1):
        return None
    size = float(np.abs(fine[:, -1]).max())
    beside = ", ".join(item.name for item in prediction)
    why = (
        f"held at {other.start:g}; beside {beside} its standard error would be"
        f" {known.errors[-1]:.2g} in units that matter, one of which changes the data"
        f" by {size:.2g} times the noise at most"
    )
    return Parameter(other.name, other.unit, "not identifiable", why=why)


def _derivative(
    rows: _Rows, unknowns: Sequence[FreeParameter], z: np.ndarray, i: int, h: float
) -> np.ndarray:
    """Return the derivative of the weighted residuals with respect to coordinate i."""

    def weighted(at: float) -> np.ndarray:
        moved = z.copy()
        moved[i] = at
        values = {
            item.name: item.value(float(v))
            for item, v in zip(unknowns, moved, strict=True)
        }
        held = unknowns[-1]
        if i < len(z) - 1:
            del values[held.name]
        return np.concatenate(
            [item.values / item.scale for item in rows.residuals(values)]
        )

    up = z[i] + h
    down = max(z[i] - h, unknowns[i].coordinate(unknowns[i].low))
    derivative: np.ndarray = (weighted(up) - weighted(down)) / (up - down)
    return derivative


class _Rows:
    """Runs of one role and their residuals."""

    def __init__(
        self,
        runs: tuple[OffsetRun, ...],
        drive: GaitSetup,
        role: Role,
        scales: Mapping[str, float],
        threads: int | None,
    ) -> None:
        self._runs = runs
        self._drive = drive
        self._role = role
        self._scales = scales
        self._threads = threads
        # The search repeats values, and runs are expensive.
        self._known: dict[tuple[tuple[str, float], ...], list[SteadyPath | None]] = {}

    def residuals(self, values: Mapping[str, float]) -> list[Residual]:
        """Return measured minus predicted speed and curvature of each run."""
        key = tuple(
            sorted((name, float(f"{value:.9g}")) for name, value in values.items())
        )
        if key not in self._known:
            moved = replace(self._drive, spec=with_values(self._drive.spec, values))
            self._known[key] = predicted(
                moved, [run.offset for run in self._runs], threads=self._threads
            )
        result = []
        for run, path in zip(self._runs, self._known[key], strict=True):
            for name, (_, unit) in NOISE.items():
                difference = (
                    getattr(run, name) - getattr(path, name) if path else _DIVERGED
                )
                label = f"offset {run.offset:g} {name}"
                result.append(
                    Residual(
                        label,
                        unit,
                        np.array([difference]),
                        self._scales[name],
                        self._role,
                    )
                )
        return result
