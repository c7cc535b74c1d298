"""Uncertainty study, which consists of one sweep per fidelity."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np

from srs_twin.errors import InputError, UnknownNameError
from srs_twin.identification.priors import Priors
from srs_twin.plants.twin.mjcf.numerics import stable_step
from srs_twin.scenario.loading import parse_scenario
from srs_twin.scenario.plants import TwinFile
from srs_twin.scenario.scenario import Scenario
from srs_twin.studies.sweep.points import Experiment, Sweep, Value, sobol_points
from srs_twin.studies.uncertainty.metric_uncertainty import RANGES

COMPLIANT = "compliant"
DAMPING = "bending.damping_time_s"
STIFFNESS = "bending.stiffness_nm_per_rad"
SEGMENTS = "segments"
"""Name of the study part that varies only the twin's bending stiffness and damping time
over their 95 % intervals.
"""
LEAD = "robot.bending.lead"
"""Field that selects one of two equally likely interpretations of the bend delay."""


@dataclass(frozen=True)
class UncertaintyStudy:
    """Scenario with uncertain robot parameters and discrete choices.

    Attributes:
        discrete_choices: equally likely values of scenario fields, keyed by field name.
        samples: number of samples per plant.
        twin_samples: number of samples that the twin simulates if a low-fidelity model
            simulates all samples.
    """

    scenario: Scenario
    priors: Priors
    plants: tuple[str, ...]
    samples: int = 2048
    twin_samples: int = 64
    seed: int = 0
    discrete_choices: Mapping[str, tuple[Value, ...]] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        """Paths of the uncertain parameters, followed by the discrete fields."""
        return (*self.priors.paths, *self.discrete_choices)

    def draw(self, count: int, seed: int) -> np.ndarray:
        """Return snapped Sobol points in the unit cube, shape (count, d)."""
        return self.snapped(sobol_points(len(self.names), count, seed))

    def snapped(self, fractions: np.ndarray) -> np.ndarray:
        """Return points with each discrete choice at the centre of its interval."""
        snapped = fractions.copy()
        for i, values in enumerate(
            self.discrete_choices.values(), start=len(self.priors.parameters)
        ):
            snapped[:, i] = (np.floor(fractions[:, i] * len(values)) + 0.5) / len(
                values
            )
        return snapped

    @cached_property
    def surrogate_scenario(self) -> Mapping[str, Any] | None:
        """Scenario for the low-fidelity model, or None if it cannot be simulated."""
        return compliant_scenario(self.scenario)

    @property
    def runs(self) -> dict[str, int]:
        """Number of simulated samples, keyed by fidelity."""
        runs = {}
        if "analytical" in self.plants:
            runs["analytical"] = self.samples
        if "twin" in self.plants and self.surrogate_scenario is None:
            runs["twin"] = self.samples
        elif "twin" in self.plants:
            runs |= {COMPLIANT: self.samples, "twin": self.twin_samples}
        return runs

    @property
    def parts(self) -> tuple[str, ...]:
        """Names of the study parts: the fidelities and, if possible, `SEGMENTS`."""
        if {"analytical", "twin"} <= {*self.plants} and {STIFFNESS, DAMPING} <= {
            *self.priors.paths
        }:
            return (*self.runs, SEGMENTS)
        return tuple(self.runs)

    @cached_property
    def fractions(self) -> np.ndarray:
        """Sobol points u of all samples, shape (samples, d)."""
        return self.draw(self.samples, self.seed)

    def sweep(self, part: str) -> Sweep:
        """Return the sweep for a study part, including the reference runs."""
        plant = "twin" if part in ("twin", SEGMENTS) else "analytical"
        document = self.surrogate_scenario
        if part != COMPLIANT:
            alone = on_plant(self.scenario.document, plant)
            document = parse_scenario(alone, name=self.scenario.name).document
        assert document is not None, "a fidelity in `runs` has a scenario"
        step = float(document["plants"][plant]["timestep_s"])
        choices = [
            values[0] if name == LEAD else _field_value(document, name)
            for name, values in self.discrete_choices.items()
        ]
        nominal = [*(prior.value for prior in self.priors.parameters), *choices]
        if part == SEGMENTS:
            rows = list(self._over_segments(nominal, step))
        else:
            middle = np.full(len(self.priors.parameters), 0.5)
            medians = [*self.priors.quantile(middle).tolist(), *choices]
            rows = [
                *self._sampled(self.fractions[: self.runs[part]], plant, step),
                [*medians, step],
                [*nominal, step],
                [*nominal, step / 2],
            ]
        return Sweep(
            name=f"{self.scenario.name}, {part}",
            title=f"{self.scenario.title}: {part}",
            experiment=Experiment(document, (plant,)),
            fields=(
                *(f"robot.{path}" for path in self.priors.paths),
                *self.discrete_choices,
                f"plants.{plant}.timestep_s",
            ),
            values=tuple(map(tuple, rows)),
            metrics=None,
            plots=(),
            document={"scenario": self.scenario.name, "priors": self.priors.document()},
        )

    def _sampled(
        self, fractions: np.ndarray, plant: str, step: float
    ) -> Iterator[list[Value]]:
        """Yield the row of values for each point u, with a stable time step."""
        parameters, choices = np.split(fractions, [len(self.priors.parameters)], axis=1)
        for values, chosen in zip(
            self.priors.quantile(parameters).tolist(), choices, strict=True
        ):
            options = zip(self.discrete_choices.values(), chosen, strict=True)
            own_step = step
            if plant == "twin" and DAMPING in self.priors.paths:
                damping_time = values[self.priors.paths.index(DAMPING)]
                own_step = stable_step(step, damping_time)
            yield [*values, *(o[int(f * len(o))] for o, f in options), own_step]

    def _over_segments(
        self, nominal: Sequence[Value], step: float
    ) -> Iterator[list[Value]]:
        """Yield all combinations of nominal and extreme stiffness and damping times."""
        places = [self.priors.paths.index(path) for path in (STIFFNESS, DAMPING)]
        levels = []
        for prior in (self.priors.parameters[place] for place in places):
            ends = prior.quantile(np.array(RANGES["interval_95"]))
            levels.append([prior.value, *ends.tolist()])
        for pair in product(*levels):
            values = list(nominal)
            for place, value in zip(places, pair, strict=True):
                values[place] = value
            yield [*values, stable_step(step, float(values[places[1]]))]


def on_plant(
    document: Mapping[str, Any],
    plant: str,
    settings: Mapping[str, object] | None = None,
) -> dict[str, object]:
    """Return a scenario with a single plant and no expectations, as plain data.

    By default, the plant has the settings from the scenario.
    """
    if settings is None:
        settings = document["plants"].get(plant, {})
    return {**document, "plants": {plant: settings}, "expect": []}


def compliant_scenario(scenario: Scenario) -> Mapping[str, object] | None:
    """Return the scenario for the model `compliant`, or None if it is not supported."""
    twin = scenario.plants.get("twin") or TwinFile()
    assert isinstance(twin, TwinFile), "the scenario's model ensures this type"
    settings = {"model": COMPLIANT, "friction": twin.friction_law, "gaps": twin.gaps}
    try:
        compliant = parse_scenario(
            on_plant(scenario.document, "analytical", settings), name=scenario.name
        )
        compliant.build_plant("analytical")
    except InputError:
        return None
    return compliant.document


def _field_value(document: object, name: str) -> Any:
    for key in name.split("."):
        if not isinstance(document, Mapping) or key not in document:
            raise UnknownNameError(
                "field", name, document if isinstance(document, Mapping) else ()
            )
        document = document[key]
    return document
