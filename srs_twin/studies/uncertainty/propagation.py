"""Uncertain numbers of a robot, propagated to every metric of a scenario on each plant.

Each plant runs at quasi-random samples of the robot's uncertain numbers, through the sweep engine, whose
rows survive. The twin is costly: where the analytical model `compliant` can run the scenario it is the
twin's cheap partner, which runs at all samples; the twin runs at the first of them, and `predicted` predicts
it at the others. `spreads` has intervals and their errors, `remarks` the limits of a result in words.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from srs_twin.errors import InputError, UnknownNameError
from srs_twin.experiment import INTERVALS, twin_contact
from srs_twin.io.file_sets import replaced, unmark
from srs_twin.io.files import write_text
from srs_twin.scenario.plants import PLANTS
from srs_twin.scenario.provenance import judged_digest
from srs_twin.studies.sweep.execution import open_sweep
from srs_twin.studies.sweep.store import write
from srs_twin.studies.uncertainty.remarks import Remarks, remedy
from srs_twin.studies.uncertainty.spreads import RANGES, Spread, predicted, sampling_errors
from srs_twin.studies.uncertainty.study import COMPLIANT, Study
from srs_twin.studies.uncertainty.surrogates import Chaos
from srs_twin.viewing.plots.labels import metric_label

if TYPE_CHECKING:
    from srs_twin.studies.sweep.execution import Engine
    from srs_twin.studies.sweep.points import Sweep
    from srs_twin.studies.sweep.task import Row

Progress = Callable[[str, int], AbstractContextManager["Callable[[Row], Any]"]]
RESULT, SAMPLES, PICTURE = "intervals.json", "samples.parquet", "intervals.png"
OWN_ROWS = 3
"""Runs after the samples: medians of the numbers, the numbers of the robot file, half of the step."""
_ENOUGH = 0.9  # of the samples have a number
_CENTRES = (0.1, 0.3, 0.5, 0.7, 0.9)  # of a prior, where a measurement of it might land
_MEASURED_TO = 0.1  # of the number, 95 %
_FORETOLD = 4096


@dataclass(frozen=True)
class Propagation:
    """What the uncertain numbers do to a scenario's metrics.

    Attributes:
        study: what ran.
        rows: part → metric → number at each sample, then at the `OWN_ROWS`.
    """

    study: Study
    rows: Mapping[str, Mapping[str, np.ndarray]] = field(repr=False)

    @cached_property
    def plants(self) -> dict[str, dict[str, Spread]]:
        """Plant → metric → what is known of it."""
        return {plant: self._spreads(plant) for plant in self.study.plants}

    def _spreads(self, plant: str) -> dict[str, Spread]:
        rows, found = self.rows[plant], {}
        partner = self.rows.get(COMPLIANT) if plant == "twin" else None
        for metric, column in rows.items():
            drawn = column[:-OWN_ROWS]
            cheap = partner.get(metric) if partner is not None else None
            if not np.isfinite(column[-2]) or np.isfinite(drawn).mean() < _ENOUGH:
                continue
            if partner is not None and (cheap is None or np.isfinite(cheap[:-OWN_ROWS]).mean() < _ENOUGH):
                continue
            if cheap is None:
                samples, surrogate = drawn, np.zeros(2 * len(RANGES))
            else:
                samples, surrogate = predicted(self.study.shares, cheap[:-OWN_ROWS], drawn)
            found[metric] = column, samples, surrogate
        indices = self._indices({name: samples for name, (_, samples, _) in found.items()})
        said = {(e.subject, e.metric): e for e in self.study.scenario.expect if e.stated is not None}
        spreads = {}
        for name, (column, samples, surrogate) in found.items():
            at_medians, value, halved = (float(each) for each in column[-OWN_ROWS:])
            stated = said.get((plant, name))
            spreads[name] = Spread(
                value, halved, at_medians, samples, int(np.isfinite(column[:-OWN_ROWS]).sum()),
                sampling_errors(samples), surrogate,
                published=None if stated is None else stated.stated, **indices.get(name, {}),
            )  # fmt: skip
        return spreads

    def _indices(self, samples: Mapping[str, np.ndarray]) -> dict[str, dict[str, np.ndarray]]:
        """Return Sobol's first-order and total indices of metrics, and their errors."""
        names = [name for name, column in samples.items() if _varies(column)]
        if not names or not self.study.priors.independent:
            return {}
        chaos = Chaos.fit(self.study.shares, np.stack([_filled(samples[name]) for name in names], axis=1))
        return {
            name: {
                "first": chaos.indices[0, :, k], "total": chaos.indices[1, :, k], "doubt": chaos.error[..., k]
            }
            for k, name in enumerate(names)
        }  # fmt: skip

    @property
    def target(self) -> tuple[str, str]:
        """Plant and metric that people ask about first: the first with a published value, or the speed."""
        for plant in reversed([p for p in PLANTS if p in self.plants]):
            spreads = self.plants[plant]
            for metric, spread in spreads.items():
                if spread.published:
                    return plant, metric
        plant = [p for p in PLANTS if p in self.plants][-1]
        names = self.plants[plant]
        if not names:
            raise InputError(f"{self.study.scenario.name}: no metric of the {plant} plant has enough numbers")
        return plant, "com_speed_m_s" if "com_speed_m_s" in names else next(iter(names))

    def measure_next(self, plant: str | None = None, metric: str | None = None) -> list[dict[str, Any]]:
        """Return what measuring each number to ±10 % would leave of a metric's interval, the best first.

        Args:
            plant: whose metric, and
            metric: which; None: `target`.

        Raises:
            UnknownNameError: there is no such metric.
        """
        if plant is None or metric is None:
            plant, metric = self.target
        if metric not in self.plants[plant]:
            raise UnknownNameError("metric", metric, self.plants[plant])
        priors, spread = self.study.priors, self.plants[plant][metric]
        now = np.ptp(spread.interval("interval_95"))
        if not now > 0 or spread.first is None:
            return []
        chaos = self._chaos(plant, metric)
        fresh = self.study.draw(_FORETOLD, self.study.seed + 1)
        rest = np.random.default_rng(self.study.seed).choice(chaos.rest[:, 0], _FORETOLD)
        found = []
        for i, prior in enumerate(priors.each):
            lows, highs = [], []
            for centre in prior.at(np.array(_CENTRES)):
                after = prior.measured(float(centre), _MEASURED_TO / 1.96 * abs(float(centre)))
                moved = fresh.copy()
                moved[:, i] = prior.shares_of(after.at(fresh[:, i]))
                low, high = np.quantile(chaos.at(moved)[:, 0] + rest, RANGES["interval_95"])
                lows.append(low)
                highs.append(high)
            width, middle = float(np.mean(np.subtract(highs, lows))), len(lows) // 2
            if width < now:
                ends = [float(lows[middle]), float(highs[middle])]
                found.append(
                    {"parameter": prior.path, "interval_95": ends, "width": width, "width_now": float(now)}
                )
        return sorted(found, key=lambda each: each["width"])

    def swings(self) -> list[dict[str, Any]]:
        """Return the effect of each number alone on the target, in the order of the total indices.

        A row has the `parameter`, the metric with it at the `low` and the `high` end of its 95 % and
        the rest at their medians, and the `error` of both: two standard deviations of left-out samples.
        """
        plant, metric = self.target
        spread, chaos, names = self.plants[plant][metric], self._chaos(plant, metric), self.study.names
        if spread.total is None:
            return []
        count = len(names)
        shares = np.full((2 * count, count), 0.5 - 1e-9)
        shares[np.arange(2 * count), np.repeat(np.arange(count), 2)] = np.tile(RANGES["interval_95"], count)
        ends = chaos.at(self.study.settled(shares))[:, 0].reshape(count, 2).tolist()
        error = 2 * float(np.sqrt((chaos.rest[:, 0] ** 2).mean()))
        return [
            {"parameter": names[i], "low": ends[i][0], "high": ends[i][1], "error": error}
            for i in np.argsort(-spread.total, kind="stable")
        ]

    @cached_property
    def remarks(self) -> dict[str, Remarks]:
        """Plant → limits of its result for the target's metric."""
        study, metric = self.study, self.target[1]
        return {
            plant: Remarks(
                plant, metric_label(metric), spreads[metric], study.priors, study.names, study.samples,
                plant == "twin" and study.partner is not None,
            )
            for plant, spreads in self.plants.items() if metric in spreads
        }  # fmt: skip

    @cached_property
    def limits(self) -> dict[str, Any]:
        """Errors that are too large, the options that would do, and what else to know, in words."""
        found = [each for remarks in self.remarks.values() for each in remarks.shortfalls()]
        words = [text for remarks in self.remarks.values() for text in (remarks.order(), remarks.outside())]
        return {
            "warnings": [each.words for each in found],
            "remedy": dict(remedy(found, self.study.samples, self.study.costly)),
            "remarks": [text for text in words if text],
        }

    @cached_property
    def _expansions(self) -> dict[tuple[str, str], Chaos]:
        return {}

    def _chaos(self, plant: str, metric: str) -> Chaos:
        """Return the expansion of one metric, made once."""
        if (found := self._expansions.get((plant, metric))) is not None:
            return found
        samples = _filled(self.plants[plant][metric].samples)
        return self._expansions.setdefault((plant, metric), Chaos.fit(self.study.shares, samples[:, None]))

    def document(self) -> dict[str, Any]:
        """Return plain data of all of it, as `--json` prints it."""
        names = self.study.names
        plants = {
            plant: {metric: spread.document(names) for metric, spread in spreads.items()}
            for plant, spreads in self.plants.items()
        }
        plant, metric = self.target
        return {
            "scenario": self.study.scenario.name,
            "robot": self.study.scenario.robot.name,
            "changes": list(self.study.scenario.changes),
            "contact": twin_contact(self.study.scenario),
            "plants": plants,
            "measure_next": self.measure_next(),
            "swings": self.swings(),
            **self.limits,
            "target": {"plant": plant, "metric": metric},
            "fidelity": {"evaluations": self.study.parts, "failed": self.failed},
            "priors": self.study.priors.document(),
            "forms": {name: list(values) for name, values in self.study.forms.items()},
        }

    def write(self, folder: Path) -> tuple[str, ...]:
        """Write document, samples and picture into a folder; return their names.

        Raises:
            InputError: a file cannot be written.
        """
        import pyarrow as pa

        # matplotlib takes longer to import than a result without pictures has to wait.
        from srs_twin.studies.uncertainty.plots import draw_intervals
        from srs_twin.viewing.plots.picture_file import save

        drawn = self.study.priors.at(self.study.shares[:, : len(self.study.priors.each)])
        columns = dict(zip(self.study.priors.paths, drawn.T, strict=True))
        columns |= {
            f"{plant}.{name}": s.samples for plant, each in self.plants.items() for name, s in each.items()
        }
        samples = pa.table({name: pa.array(each, from_pandas=True) for name, each in columns.items()})
        document = self.document()
        picture = draw_intervals(self.study.scenario.title, document)
        with replaced(folder, (RESULT, SAMPLES, PICTURE)) as fresh:
            write(fresh / SAMPLES, samples)
            save(picture, fresh / PICTURE)
            (fresh / RESULT).write_text(json.dumps(document, indent=2) + "\n", "utf-8")
        return RESULT, SAMPLES, PICTURE

    def keep(self) -> Path:
        """Keep the result where expectations with `within` look for it, with a digest of what made it.

        Raises:
            InputError: the file cannot be written.
        """
        path = INTERVALS / f"{self.study.scenario.name}.json"
        document = {"digest": judged_digest(self.study.scenario.document), **self.document()}
        write_text(path, json.dumps(_rounded(document), indent=1) + "\n")
        return path

    @property
    def failed(self) -> dict[str, int]:
        """Part → how many of its samples gave nothing at all."""
        return {
            part: int(np.isnan([column[:-OWN_ROWS] for column in rows.values()]).all(axis=0).sum())
            if rows
            else 0
            for part, rows in self.rows.items()
        }


def _rounded(data: Any) -> Any:
    """Return plain data with six digits a number, as many as anybody reads."""
    if isinstance(data, dict):
        return {key: _rounded(each) for key, each in data.items()}
    if isinstance(data, list):
        return [_rounded(each) for each in data]
    return float(f"{data:.6g}") if isinstance(data, float) else data


def _varies(samples: np.ndarray) -> bool:
    """Return whether nearly all samples have a number, and these are not all the same."""
    known = np.isfinite(samples)
    return bool(known.mean() >= _ENOUGH and np.std(samples[known]) > 1e-9 * abs(samples[known].mean()))


def _filled(samples: np.ndarray) -> np.ndarray:
    """Return samples with the median where there is none: few enough not to matter."""
    return np.where(np.isfinite(samples), samples, np.nanmedian(samples))


def propagate(
    study: Study, folder: Path, engine: Engine, progress: Progress | None = None, *, changed: bool = False
) -> Propagation:
    """Run the missing rows of a folder and return the result.

    Args:
        study: the runs.
        folder: of the rows; one subfolder per part.
        engine: executor of the runs.
        progress: given a part and the number of runs to come, a context that takes each row.
        changed: resume in a folder of another version, as `open_sweep` takes it.

    Raises:
        InputError: nothing could be run, or a folder cannot be written.
    """
    rows = {}
    for part in study.parts:
        sweep = study.sweep(part)
        with open_sweep(sweep, folder / part, changed=changed) as opened:
            missing = opened.missing()
            with progress(part, len(missing)) if progress and missing else nullcontext() as finished:
                opened.run(engine, missing, finished)
            if missing or changed:  # an earlier result does not belong to these rows
                unmark(folder / RESULT)
            opened.finish()
        rows[part] = _columns(folder / part / "results.parquet", sweep)
    return Propagation(study, rows)


def _columns(path: Path, sweep: Sweep) -> dict[str, np.ndarray]:
    """Return metric → number of each point of a sweep, NaN where there is none."""
    import pyarrow.parquet as pq

    table = pq.read_table(path)
    place = {key: i for i, key in enumerate(table.column("key").to_pylist())}
    rows = [place.get(point.key) for point in sweep.points]
    prefix = f"{sweep.experiment.plants[0]}."
    found = {}
    for name in table.column_names:
        if name.startswith(prefix):
            values = table.column(name).to_numpy(zero_copy_only=False).astype(float)
            found[name.removeprefix(prefix)] = np.array([np.nan if i is None else values[i] for i in rows])
    return found
