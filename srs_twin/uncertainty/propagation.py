r"""What is uncertain of a robot, propagated to every metric of a scenario on each plant.

Each plant runs at quasi-random samples of the robot's uncertain numbers, through the sweep engine, whose
rows survive. The twin is costly: where the analytical model `compliant` can run the scenario it is the
twin's cheap partner, which runs at all samples; the twin runs at the first of them, and `corrected` predicts
it at the others. Ends of intervals are quantiles of these values. Their own errors are those of the
delete-a-group jackknife, groups of samples left out of the whole procedure in turn,

$$ \mathrm{se}^2 = \frac{G-1}{G} \sum_g (\hat q_{-g} - \bar q)^2 . $$
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
from srs_twin.experiment import INTERVALS
from srs_twin.io.files import write_text
from srs_twin.mjcf.numerics import LAW_OF
from srs_twin.provenance import judged_digest, versions
from srs_twin.scenario import Scenario, parse_scenario
from srs_twin.scenario.plants import PLANTS, TwinFile
from srs_twin.sweep import Experiment, Sweep, open_sweep
from srs_twin.sweep.points import Value
from srs_twin.sweep.store import write
from srs_twin.uncertainty.priors import Priors
from srs_twin.uncertainty.surrogates import Chaos, corrected

if TYPE_CHECKING:
    from srs_twin.sweep.execution import Engine
    from srs_twin.sweep.task import Row

Progress = Callable[[str, int], AbstractContextManager["Callable[[Row], Any]"]]

COMPLIANT = "compliant"
RESULT, SAMPLES, PICTURE = "intervals.json", "samples.parquet", "intervals.png"
_RANGES = {"interval_50": (0.25, 0.75), "interval_95": (0.025, 0.975)}
_GROUPS = 8
_ENOUGH = 0.9  # of the samples have a number
_CENTRES = (0.1, 0.3, 0.5, 0.7, 0.9)  # of a prior, where a measurement of it might land
_MEASURED_TO = 0.1  # of the number, 95 %
_FORETOLD = 4096


@dataclass(frozen=True)
class Study:
    """A scenario and what is uncertain of its robot.

    Attributes:
        scenario: what runs.
        priors: of the robot's numbers.
        forms: fields of the scenario → values that are equally likely, such as two models of the chambers.
        plants: which run.
        samples: of the cheap plants.
        costly: samples of the twin where it has a cheap partner.
        seed: of the samples.
    """

    scenario: Scenario
    priors: Priors
    plants: tuple[str, ...]
    samples: int = 2048
    costly: int = 64
    seed: int = 0
    forms: Mapping[str, tuple[Value, ...]] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        """What is uncertain: paths of the robot's numbers, then the forms' fields."""
        return (*self.priors.paths, *self.forms)

    def draw(self, count: int, seed: int) -> np.ndarray:
        """Return independent shares u that fill the unit cube evenly, shape (count, d)."""
        from scipy.stats import qmc

        drawn = qmc.Sobol(len(self.names), rng=seed).random_base2(max(count - 1, 1).bit_length())
        return self.settled(drawn[:count])

    def settled(self, shares: np.ndarray) -> np.ndarray:
        """Return shares with those of the forms in the middles of their values' parts."""
        settled = shares.copy()
        for i, values in enumerate(self.forms.values(), start=len(self.priors.each)):
            settled[:, i] = (np.floor(shares[:, i] * len(values)) + 0.5) / len(values)
        return settled

    @cached_property
    def partner(self) -> Mapping[str, Any] | None:
        """The scenario with `compliant` as its analytical plant; None where that cannot run it."""
        return compliant_partner(self.scenario)

    @property
    def parts(self) -> dict[str, int]:
        """What runs → at how many samples."""
        found = {"analytical": self.samples} if "analytical" in self.plants else {}
        if "twin" in self.plants:
            found |= (
                {"twin": self.samples}
                if self.partner is None
                else {COMPLIANT: self.samples, "twin": self.costly}
            )
        return found

    @cached_property
    def shares(self) -> np.ndarray:
        """Independent shares u of all samples, shape (samples, d)."""
        return self.draw(self.samples, self.seed)

    def sweep(self, part: str) -> Sweep:
        """Return the runs of a part: samples, then the robot as it stands with its step and half of it."""
        plant = "twin" if part == "twin" else "analytical"
        document = self.partner if part == COMPLIANT else self._alone(plant)
        assert document is not None, "a part that runs"
        step = f"plants.{plant}.timestep_s"
        fields = (*(f"robot.{path}" for path in self.priors.paths), *self.forms, step)
        h = float(document["plants"][plant]["timestep_s"])
        shares, count = self.shares[: self.parts[part]], len(self.priors.each)
        columns: list[list[Value]] = self.priors.at(shares[:, :count]).T.tolist()
        for share, values in zip(shares[:, count:].T, self.forms.values(), strict=True):
            columns.append([values[int(each * len(values))] for each in share])
        own = [_at(document, name) for name in self.forms]
        nominal = [*(prior.value for prior in self.priors.each), *own]
        rows = [*([*row, h] for row in zip(*columns, strict=True)), [*nominal, h], [*nominal, h / 2]]
        return Sweep(
            name=f"{self.scenario.name}, {part}",
            title=f"{self.scenario.title}: {part}",
            experiment=Experiment(document, (plant,)),
            fields=fields,
            values=tuple(map(tuple, rows)),
            metrics=None,
            plots=(),
            versions=versions(),
            document={"scenario": self.scenario.name, "priors": self.priors.document()},
        )

    def _alone(self, plant: str) -> dict[str, Any]:
        settings = self.scenario.document["plants"].get(plant, {})
        document = {**self.scenario.document, "plants": {plant: settings}, "expect": []}
        return dict(parse_scenario(document, name=self.scenario.name).document)

    def run(
        self, folder: Path, engine: Engine, progress: Progress | None = None, *, changed: bool = False
    ) -> Propagation:
        """Run what is missing in a folder and return what came of it.

        Args:
            folder: of the rows; a folder a part.
            engine: who runs them.
            progress: given a part and how many runs are to come, a context that takes each row.
            changed: go on in a folder of another version, as `open_sweep` takes it.

        Raises:
            InputError: nothing could be run, or a folder cannot be written.
        """
        found = {}
        for part in self.parts:
            sweep = self.sweep(part)
            with open_sweep(sweep, folder / part, changed=changed) as opened:
                missing = opened.missing()
                with progress(part, len(missing)) if progress and missing else nullcontext() as finished:
                    opened.run(engine, missing, finished)
                opened.finish()
            found[part] = _columns(folder / part / "results.parquet", sweep)
        return Propagation(self, found)


def compliant_partner(scenario: Scenario) -> Mapping[str, Any] | None:
    """Return plain data of a scenario with `compliant` as its only plant; None where that cannot run it."""
    twin = scenario.plants.get("twin") or TwinFile()
    assert isinstance(twin, TwinFile), "so the scenario's model has it"
    settings = {"model": COMPLIANT, "friction": twin.friction or LAW_OF[twin.wheels], "gaps": twin.gaps}
    document = {**scenario.document, "plants": {"analytical": settings}, "expect": []}
    try:
        found = parse_scenario(document, name=scenario.name)
        found.build_plant("analytical")
    except InputError:
        return None
    return found.document


def _at(document: Any, name: str) -> Any:
    """Return the value of a dotted field of plain data.

    Raises:
        UnknownNameError: there is none.
    """
    for key in name.split("."):
        if not isinstance(document, Mapping) or key not in document:
            raise UnknownNameError("field", name, document if isinstance(document, Mapping) else ())
        document = document[key]
    return document


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


@dataclass(frozen=True)
class Spread:
    """One metric of one plant.

    Attributes:
        value: with the robot as it stands.
        halved: the same with half of the time step.
        samples: predicted at each sample of the priors, shape (samples,); NaN where there is no number.
        errors: standard errors of the ends of 50 and 95 %, shape (4,).
        first: Sobol's indices of the first order, shape (d,); None where the numbers go together.
        total: his total ones.
        doubt: half of the 95 % interval of both, shape (2, d).
        published: what was published, if anything.
    """

    value: float
    halved: float
    samples: np.ndarray
    errors: np.ndarray
    first: np.ndarray | None
    total: np.ndarray | None
    doubt: np.ndarray | None
    published: float | None = None

    def interval(self, name: str) -> tuple[float, float]:
        """Return the ends of `interval_50` or `interval_95`."""
        low, high = np.nanquantile(self.samples, _RANGES[name])
        return float(low), float(high)

    @property
    def numerical(self) -> float:
        """u_num: what a step refined without end would change, by Richardson for the first order."""
        return 2 * abs(self.value - self.halved)


@dataclass(frozen=True)
class Propagation:
    """What the uncertain numbers do to a scenario's metrics.

    Attributes:
        study: what ran.
        rows: part → metric → number of each sample, of the robot as it stands, and with half of the step.
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
            drawn = column[:-2]
            cheap = partner.get(metric) if partner is not None else None
            if not np.isfinite(column[-2]) or np.isfinite(drawn).mean() < _ENOUGH:
                continue
            if partner is not None and (cheap is None or np.isfinite(cheap[:-2]).mean() < _ENOUGH):
                continue
            samples, ends = self._predicted(drawn, None if cheap is None else cheap[:-2])
            found[metric] = (column, samples, ends)
        names = [name for name, (_, samples, _) in found.items() if _varies(samples)]
        indices: dict[str, Any] = {}
        if names and self.study.priors.independent:
            chaos = Chaos.fit(
                self.study.shares, np.stack([_filled(found[name][1]) for name in names], axis=1)
            )
            indices = {name: (*chaos.indices[..., k], chaos.error[..., k]) for k, name in enumerate(names)}
        said = {(e.subject, e.metric): e for e in self.study.scenario.expect if e.stated is not None}
        spreads = {}
        for name, (column, samples, ends) in found.items():
            stated = said.get((plant, name))
            value, halved = float(column[-2]), float(column[-1])
            first, total, doubt = indices.get(name, (None, None, None))
            published = None if stated is None else stated.stated
            spreads[name] = Spread(value, halved, samples, ends, first, total, doubt, published)
        return spreads

    def _predicted(self, drawn: np.ndarray, cheap: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """Return a metric at all samples, and the standard errors of the ends of its intervals."""
        shares, wanted = self.study.shares, [end for ends in _RANGES.values() for end in ends]
        if cheap is None:
            samples = drawn
            groups = [drawn[np.arange(len(drawn)) % _GROUPS != g] for g in range(_GROUPS)]
        else:
            both = np.isfinite(cheap[: len(drawn)]) & np.isfinite(drawn)
            kept = np.isfinite(cheap)
            kept[: len(drawn)] = both
            x, y, few = shares[kept], cheap[kept], drawn[both]
            samples = np.full(len(cheap), np.nan)
            samples[kept], chosen = corrected(x, y, few)
            groups = []
            for g in range(_GROUPS):
                stays, first = np.arange(len(y)) % _GROUPS != g, np.arange(len(few)) % _GROUPS != g
                groups.append(corrected(x[stays], y[stays], few[first], chosen)[0])
        ends = np.array([np.nanquantile(group, wanted) for group in groups])
        return samples, np.sqrt((_GROUPS - 1) * ends.var(axis=0))

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
                low, high = np.quantile(chaos.at(moved)[:, 0] + rest, _RANGES["interval_95"])
                lows.append(low)
                highs.append(high)
            width, middle = float(np.mean(np.subtract(highs, lows))), len(lows) // 2
            if width < now:
                ends = [float(lows[middle]), float(highs[middle])]
                found.append(
                    {"parameter": prior.path, "interval_95": ends, "width": width, "width_now": float(now)}
                )
        return sorted(found, key=lambda each: each["width"])

    def swings(self) -> list[tuple[str, float, float, float]]:
        """Return the target's tornado, the widest bar first.

        A row is a number's path, the metric where it is at the lower and the upper end of its 95 % and all
        others are at their medians, and its total index.
        """
        plant, metric = self.target
        spread, chaos, names = self.plants[plant][metric], self._chaos(plant, metric), self.study.names
        if spread.total is None:
            return []
        count = len(names)
        shares = np.full((2 * count, count), 0.5 - 1e-9)
        shares[np.arange(2 * count), np.repeat(np.arange(count), 2)] = np.tile(_RANGES["interval_95"], count)
        ends = chaos.at(self.study.settled(shares))[:, 0].reshape(count, 2)
        rows = zip(names, *ends.T.tolist(), spread.total.tolist(), strict=True)
        return sorted(rows, key=lambda row: -abs(row[2] - row[1]))

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
        paths = self.study.names
        plants: dict[str, Any] = {}
        for plant, spreads in self.plants.items():
            plants[plant] = {}
            for metric, spread in spreads.items():
                row: dict[str, Any] = {"value": spread.value}
                row |= {name: list(spread.interval(name)) for name in _RANGES}
                row["interval_95_error"] = spread.errors[2:].tolist()
                row["samples"] = int(np.isfinite(spread.samples).sum())
                row["u_input"] = float(np.nanstd(spread.samples))
                row["u_num"] = spread.numerical if np.isfinite(spread.halved) else None
                row["sensitivity"] = None
                if spread.first is not None and spread.total is not None and spread.doubt is not None:
                    columns = zip(paths, spread.first, spread.total, *spread.doubt, strict=True)
                    row["sensitivity"] = {
                        path: {
                            "first": float(f),
                            "total": float(t),
                            "first_error": float(a),
                            "total_error": float(b),
                        }
                        for path, f, t, a, b in columns
                    }
                row["published"] = spread.published
                plants[plant][metric] = row
        plant, metric = self.target
        return {
            "scenario": self.study.scenario.name,
            "robot": self.study.scenario.robot.name,
            "plants": plants,
            "measure_next": self.measure_next(),
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
        from srs_twin.viewing.plots.intervals import draw_intervals
        from srs_twin.viewing.plots.sweeps import save

        drawn = self.study.priors.at(self.study.shares[:, : len(self.study.priors.each)])
        columns = dict(zip(self.study.priors.paths, drawn.T, strict=True))
        columns |= {
            f"{plant}.{name}": s.samples for plant, each in self.plants.items() for name, s in each.items()
        }
        write(
            folder / SAMPLES,
            pa.table({name: pa.array(each, from_pandas=True) for name, each in columns.items()}),
        )
        document = self.document()
        save(draw_intervals(self.study.scenario.title, document, self.swings()), folder / PICTURE)
        write_text(folder / RESULT, json.dumps(document, indent=2) + "\n")
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
            part: int(np.isnan([column[:-2] for column in rows.values()]).all(axis=0).sum()) if rows else 0
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
