"""Propagation of uncertain robot parameters to all metrics of a scenario.

Each plant is simulated with quasi-random samples of the parameters. Where possible, the
analytical model `compliant` simulates all samples as a low-fidelity model. The twin
then simulates only the first samples, and `predict_twin` predicts its metrics at the
remaining samples.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from srs_twin.errors import InputError
from srs_twin.experiment import INTERVALS, twin_contact
from srs_twin.identification.priors import Priors
from srs_twin.io.arguments import checked
from srs_twin.io.documents import Overrides
from srs_twin.io.file_sets import remove_completion_mark, replace_files
from srs_twin.io.files import (
    StrPath,
    check_output_folder,
    folder_or_temporary,
    write_text,
)
from srs_twin.robot.file import RobotFile
from srs_twin.scenario.loading import load_scenario
from srs_twin.scenario.plants import PLANTS
from srs_twin.scenario.provenance import judged_provenance
from srs_twin.scenario.scenario import Scenario
from srs_twin.studies.sweep.execution import (
    Engine,
    Progress,
    make_engine,
    open_sweep,
    quiet,
)
from srs_twin.studies.sweep.points import Value
from srs_twin.studies.sweep.table import write_columns
from srs_twin.studies.uncertainty.metric_uncertainty import (
    RANGES,
    MetricUncertainty,
    SobolIndices,
    UncertaintyDocument,
    predict_twin,
    sampling_errors,
)
from srs_twin.studies.uncertainty.study import (
    COMPLIANT,
    DAMPING,
    LEAD,
    SEGMENTS,
    UncertaintyStudy,
)
from srs_twin.studies.uncertainty.surrogates import PolynomialChaos
from srs_twin.viewing.plots.labels import metric_label

if TYPE_CHECKING:
    from srs_twin.studies.sweep.points import Sweep
    from srs_twin.studies.sweep.task import Row

RESULT = "intervals.json"

SAMPLES = "samples.parquet"

PICTURE = "intervals.png"

FILES = (RESULT, SAMPLES, PICTURE)

REFERENCE_ROWS = 3
"""Number of reference runs after the samples. The first run uses the parameter medians.
The others use the robot file, once with the full and once with half the time step.
"""

_MIN_KNOWN = 0.9
"""Minimum fraction of samples with a value for a metric to be included."""

_CENTRES = (0.1, 0.3, 0.5, 0.7, 0.9)
"""Quantiles of a parameter's prior that are assumed as measured values."""

_MEASUREMENT_ERROR = 0.1
"""Half-width of the 95 % interval of an assumed measurement, relative to the measured
value.
"""

_PREDICTION_SAMPLES = 4096
"""Number of surrogate evaluations used to compute the effect of a measurement."""


@dataclass(frozen=True)
class Measurement:
    """Effect of measuring one parameter on the 95 % interval of the target metric.

    Attributes:
        parameter: path of the measured parameter.
        interval_95: interval if the measured value is the median of the prior.
        width: interval width after the measurement, averaged over several possible
            measured values.
        width_now: interval width before the measurement.
    """

    parameter: str
    interval_95: list[float]
    width: float
    width_now: float


@dataclass(frozen=True)
class Swing:
    """Effect of one quantity on the target metric, with the others at their medians.

    Attributes:
        low: metric at the lower end of the quantity's 95 % interval.
        high: metric at the upper end of the quantity's 95 % interval.
        error: twice the RMS of the surrogate's leave-one-out residuals.
    """

    parameter: str
    low: float
    high: float
    error: float


def check_can_be_kept(scenario: Scenario) -> None:
    """Check that the intervals of a scenario can be stored for its expectations."""
    if scenario.left_out:
        fields = ", ".join(
            dict.fromkeys(
                field for entry in scenario.left_out for field in entry["because"]
            )
        )
        raise InputError(
            f"--write stores only intervals of unmodified scenarios, but {fields} was"
            " changed; remove the change or --write"
        )
    check_output_folder(INTERVALS, (f"{scenario.name}.json",), option="")


@dataclass(frozen=True)
class Propagation:
    """Result of an uncertainty study.

    Attributes:
        study: study that produced the result.
        rows: metric values, keyed by fidelity and metric, shape (samples +
            `REFERENCE_ROWS`,). The key `SEGMENTS` contains the values for different
            stiffness and damping times.
    """

    study: UncertaintyStudy
    rows: Mapping[str, Mapping[str, np.ndarray]] = field(repr=False)

    @cached_property
    def plants(self) -> dict[str, dict[str, MetricUncertainty]]:
        """Uncertainty of each metric, keyed by plant and metric."""
        return {plant: self._uncertainties(plant) for plant in self.study.plants}

    def _uncertainties(self, plant: str) -> dict[str, MetricUncertainty]:
        low_fidelity = self.rows.get(COMPLIANT) if plant == "twin" else None
        published = {
            (expected.subject, expected.metric): expected.stated
            for expected in self.study.scenario.expect
            if expected.stated is not None
        }
        uncertainties = {}
        for metric, column in self.rows[plant].items():
            samples = runs = column[:-REFERENCE_ROWS]
            at_medians, value, half_timestep = map(float, column[-REFERENCE_ROWS:])
            if not np.isfinite(value) or _known_fraction(runs) < _MIN_KNOWN:
                continue
            surrogate = np.zeros(2 * len(RANGES))
            if low_fidelity is not None:
                low = low_fidelity.get(metric, np.full(1, np.nan))[: self.study.samples]
                if _known_fraction(low) < _MIN_KNOWN:
                    continue
                samples, surrogate = predict_twin(self.study.fractions, low, runs)
            uncertainties[metric] = MetricUncertainty(
                value,
                half_timestep,
                at_medians,
                samples,
                int(np.isfinite(runs).sum()),
                sampling_errors(samples),
                surrogate,
                published=published.get((plant, metric)),
            )
        return self._with_indices(uncertainties)

    def _with_indices(
        self, uncertainties: dict[str, MetricUncertainty]
    ) -> dict[str, MetricUncertainty]:
        """Add Sobol indices, which are undefined for correlated parameters."""
        names = [
            name for name, entry in uncertainties.items() if _varies(entry.samples)
        ]
        if not names or not self.study.priors.independent:
            return uncertainties
        results = np.stack(
            [_fill_missing(uncertainties[name].samples) for name in names], axis=1
        )
        chaos = PolynomialChaos.fit(self.study.fractions, results)
        for k, name in enumerate(names):
            first, total = chaos.indices[..., k]
            indices = SobolIndices(first, total, chaos.index_half_width[..., k])
            uncertainties[name] = replace(uncertainties[name], indices=indices)
        return uncertainties

    @property
    def target(self) -> tuple[str, str]:
        """Plant and metric that the summary shows.

        The target metric is the first metric with a published value, or the speed if no
        values are published.
        """
        plants = [plant for plant in PLANTS if plant in self.plants]
        for plant in reversed(plants):
            for metric, uncertainty in self.plants[plant].items():
                if uncertainty.published:
                    return plant, metric
        names = self.plants[plants[-1]]
        if not names:
            raise InputError(
                f"{self.study.scenario.name}: no metric of the {plants[-1]} plant has a"
                f" value in at least {100 * _MIN_KNOWN:.0f} % of the samples"
            )
        return plants[-1], (
            "com_speed_m_s" if "com_speed_m_s" in names else next(iter(names))
        )

    def measure_next(self) -> list[Measurement]:
        """Return the measurements (±10 %) that narrow the interval, narrowest first."""
        chaos = self._chaos
        width_now = float(np.ptp(self._target.interval("interval_95")))
        if not width_now > 0 or self._target.indices is None:
            return []
        fractions = self.study.draw(_PREDICTION_SAMPLES, self.study.seed + 1)
        # With random residuals, the predicted intervals include the surrogate error.
        rng = np.random.default_rng(self.study.seed)
        residuals = rng.choice(chaos.residuals[:, 0], _PREDICTION_SAMPLES)
        measurements = []
        for i, prior in enumerate(self.study.priors.parameters):
            ends = []
            for centre in prior.quantile(np.array(_CENTRES)):
                sd = _MEASUREMENT_ERROR / 1.96 * abs(float(centre))
                measured = prior.with_measurement(float(centre), sd)
                fractions_after = fractions.copy()
                fractions_after[:, i] = prior.cdf(measured.quantile(fractions[:, i]))
                values = chaos.at(fractions_after)[:, 0] + residuals
                ends.append(np.quantile(values, RANGES["interval_95"]))
            width = float(np.mean(np.ptp(ends, axis=1)))
            if width < width_now:
                middle = ends[len(ends) // 2].tolist()
                measurements.append(Measurement(prior.path, middle, width, width_now))
        return sorted(measurements, key=lambda measurement: measurement.width)

    def swings(self) -> list[Swing]:
        """Return the effect of each quantity, sorted by descending total index."""
        names = self.study.names
        chaos = self._chaos
        indices = self._target.indices
        if indices is None:
            return []
        count = len(names)
        # Each quantity is evaluated at the two ends of its 95 % interval. All other
        # quantities are just below their medians, so that the first of two discrete
        # values is selected.
        fractions = np.full((2 * count, count), 0.5 - 1e-9)
        fractions[np.arange(2 * count), np.repeat(np.arange(count), 2)] = np.tile(
            RANGES["interval_95"], count
        )
        ends = chaos.at(self.study.snapped(fractions))[:, 0].reshape(count, 2).tolist()
        error = 2 * float(np.sqrt((chaos.residuals[:, 0] ** 2).mean()))
        return [
            Swing(names[i], ends[i][0], ends[i][1], error)
            for i in np.argsort(-indices.total, kind="stable")
        ]

    @property
    def segments(self) -> dict[str, list[float]] | None:
        """Minimum and maximum speed of the twin with varied parameters, m/s.

        Stiffness and damping time vary for the key `stiffness_and_damping`, and only
        the damping time varies for the key `damping`. The property is None if runs are
        missing or have failed.
        """
        speeds = self.rows.get(SEGMENTS, {}).get("com_speed_m_s")
        if speeds is None or not np.isfinite(speeds).all():
            return None
        # The first three runs use the stiffness of the robot file.
        ranges = {"stiffness_and_damping": speeds, "damping": speeds[:3]}
        return {
            name: [float(values.min()), float(values.max())]
            for name, values in ranges.items()
        }

    @cached_property
    def warnings(self) -> list[str]:
        """Warnings about large errors in the target metric, for all plants."""
        metric = self.target[1]
        return [
            f"{plant}, {metric_label(metric)}: {text}"
            for plant, uncertainties in self.plants.items()
            if metric in uncertainties
            for text in uncertainties[metric].warnings()
        ]

    @property
    def _target(self) -> MetricUncertainty:
        plant, metric = self.target
        return self.plants[plant][metric]

    @cached_property
    def _chaos(self) -> PolynomialChaos:
        return PolynomialChaos.fit(
            self.study.fractions, _fill_missing(self._target.samples)[:, None]
        )

    def document(self) -> UncertaintyDocument:
        """Return the result as JSON-compatible data."""
        names = self.study.names
        plants = {
            plant: {
                metric: uncertainty.document(names)
                for metric, uncertainty in uncertainties.items()
            }
            for plant, uncertainties in self.plants.items()
        }
        plant, metric = self.target
        return {
            "scenario": self.study.scenario.name,
            "robot": self.study.scenario.robot.name,
            "changes": list(self.study.scenario.changes),
            "contact": twin_contact(self.study.scenario),
            "plants": plants,
            "measure_next": list(map(asdict, self.measure_next())),
            "swings": [
                {
                    "parameter": swing.parameter,
                    "low": swing.low,
                    "high": swing.high,
                    "error": swing.error,
                }
                for swing in self.swings()
            ],
            "segments": self.segments,
            "warnings": self.warnings,
            "target": {"plant": plant, "metric": metric},
            "fidelity": {"evaluations": self.study.runs, "failed": self.failed},
            "priors": self.study.priors.document(),
            "forms": {
                name: list(values)
                for name, values in self.study.discrete_choices.items()
            },
        }

    def write(self, folder: Path) -> None:
        """Write the JSON document, the table of samples and the plot to a folder.

        Raises:
            InputError: a file cannot be written.
        """
        # A top-level import of Matplotlib would delay results without plots.
        from srs_twin.studies.uncertainty.plots import draw_intervals
        from srs_twin.viewing.plots.style import save

        parameters = self.study.priors.quantile(
            self.study.fractions[:, : len(self.study.priors.parameters)]
        )
        columns = dict(zip(self.study.priors.paths, parameters.T, strict=True))
        for plant, uncertainties in self.plants.items():
            columns |= {
                f"{plant}.{name}": entry.samples
                for name, entry in uncertainties.items()
            }
        document = self.document()
        figure = draw_intervals(self.study.scenario.title, document)
        with replace_files(folder, FILES) as fresh:
            write_columns(fresh / SAMPLES, columns)
            save(figure, fresh / PICTURE)
            (fresh / RESULT).write_text(json.dumps(document, indent=2) + "\n", "utf-8")

    def keep(self) -> Path:
        """Store the intervals and a digest of the scenario for use in expectations.

        Raises:
            InputError: the scenario is modified, or the file cannot be written.
        """
        check_can_be_kept(self.study.scenario)
        path = INTERVALS / f"{self.study.scenario.name}.json"
        document = {
            "digest": judged_provenance(self.study.scenario.document).key,
            **self.document(),
        }
        write_text(path, json.dumps(_rounded(document), indent=1) + "\n")
        return path

    @property
    def failed(self) -> dict[str, int]:
        """Number of samples without a value for any metric, keyed by fidelity."""
        failed = dict.fromkeys(self.study.runs, 0)
        for part in failed:
            if columns := list(self.rows[part].values()):
                missing = np.isnan(np.array(columns)).all(axis=0)
                failed[part] = int(missing[:-REFERENCE_ROWS].sum())
        return failed


def _rounded(data: object) -> object:
    if isinstance(data, dict):
        return {key: _rounded(value) for key, value in data.items()}
    if isinstance(data, list):
        return [_rounded(value) for value in data]
    if isinstance(data, float):
        return float(f"{data:.6g}")
    return data


def _known_fraction(samples: np.ndarray) -> float:
    return float(np.isfinite(samples).mean())


def _varies(samples: np.ndarray) -> bool:
    known = samples[np.isfinite(samples)]
    return _known_fraction(samples) >= _MIN_KNOWN and bool(
        np.std(known) > 1e-9 * abs(known.mean())
    )


def _fill_missing(samples: np.ndarray) -> np.ndarray:
    return np.where(np.isfinite(samples), samples, np.nanmedian(samples))


def propagate(
    study: UncertaintyStudy,
    folder: Path,
    engine: Engine,
    progress: Progress = quiet,
    *,
    changed: bool = False,
) -> Propagation:
    """Compute the rows that are missing in a folder, and return the result."""
    rows = {}
    for part in study.parts:
        sweep = study.sweep(part)
        with open_sweep(sweep, folder / part, changed=changed) as opened:
            missing = opened.missing()
            if missing:
                progress(part, len(missing), None)
                opened.run(engine, missing, partial(progress, part, len(missing)))
            # Earlier result files would not match the new rows.
            if missing or changed:
                remove_completion_mark(folder / RESULT)
            opened.finish()
            rows[part] = _columns(sweep, opened.rows())
    return Propagation(study, rows)


@checked
def uncertainty(
    scenario: StrPath | Scenario,
    *,
    out: StrPath | None = None,
    set: Overrides = (),
    plants: Sequence[str] | None = None,
    samples: int = 2048,
    twin: int = 64,
    exclude: Sequence[str] = (),
    choices: Mapping[str, tuple[Value, ...]] = MappingProxyType({}),
    engine: str | Engine = "local",
    workers: int | None = None,
    changed: bool = False,
    progress: Progress = quiet,
) -> Propagation:
    """Compute prediction intervals for the metrics of a scenario.

    An interrupted study resumes if the function is called again with the same output
    folder.

    Args:
        scenario: name or path of a scenario, or a loaded scenario.
        out: output folder, or None to write no files.
        set: new values for scenario fields, as described in `load_scenario`.
        plants: plants to simulate, or None for the plants of the scenario.
        samples: number of robots with randomly drawn parameters.
        twin: number of twin runs if the model `compliant` simulates all samples.
        exclude: robot parameters to keep at their values in the robot file.
        choices: equally likely values of scenario fields, keyed by field name. If the
            damping time is uncertain and the robot file does not set `bending.lead`,
            both values of this field are added.
        engine: name of the execution engine ("local", "ray" or "warp"), or an engine
            object.
        workers: number of parallel runs, or None for one per processor.
        changed: whether the folder may contain rows of a different version of the
            study.
        progress: callback for progress reports (see `execution.Progress`).

    Raises:
        InputError: the scenario is not valid, the engine is not available, or the
            folder cannot be used.
    """
    loaded = load_scenario(scenario, set=set)
    robot = RobotFile.model_validate(loaded.document["robot"])
    priors = Priors.from_robot(robot, exclude=exclude)
    if DAMPING in priors.paths and robot.bending.lead is None:
        choices = {LEAD: (True, False), **choices}
    study = UncertaintyStudy(
        loaded,
        priors,
        loaded.plants_to_run(plants),
        samples=samples,
        twin_samples=min(twin, samples),
        seed=loaded.seed,
        discrete_choices=choices,
    )
    with folder_or_temporary(out) as folder:
        result = propagate(
            study, folder, make_engine(engine, workers), progress, changed=changed
        )
        if out is not None:
            result.write(folder)
    return result


def _columns(sweep: Sweep, rows: Iterable[Row]) -> dict[str, np.ndarray]:
    by_key = {row.key: row.values for row in rows}
    names = dict.fromkeys(name for values in by_key.values() for name in values)
    points = [by_key.get(point.key, {}) for point in sweep.points]
    return {
        name.partition(".")[2]: np.array(
            [values.get(name) for values in points], dtype=float
        )
        for name in names
    }
