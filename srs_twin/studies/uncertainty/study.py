"""Study of a scenario whose robot has uncertain numbers: which runs it needs, and the sweep of each part."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from srs_twin.errors import InputError, UnknownNameError
from srs_twin.robot.priors import Priors
from srs_twin.scenario.loading import parse_scenario
from srs_twin.scenario.plants import TwinFile
from srs_twin.scenario.provenance import versions
from srs_twin.scenario.scenario import Scenario
from srs_twin.studies.sweep.points import Experiment, Sweep, Value

COMPLIANT = "compliant"


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
        """Uncertain quantities: paths of the robot's numbers, then the forms' fields."""
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
        """Part → number of samples that it runs."""
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

    @property
    def medians(self) -> np.ndarray:
        """Medians of the robot's uncertain numbers."""
        return self.priors.at(np.full(len(self.priors.each), 0.5))

    def sweep(self, part: str) -> Sweep:
        """Return the runs of a part: the samples, then the `OWN_ROWS`."""
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
        medians = [*self.medians.tolist(), *own]
        rows = [
            *([*row, h] for row in zip(*columns, strict=True)),
            [*medians, h],
            [*nominal, h],
            [*nominal, h / 2],
        ]
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


def compliant_partner(scenario: Scenario) -> Mapping[str, Any] | None:
    """Return plain data of a scenario with `compliant` as its only plant; None where that cannot run it."""
    twin = scenario.plants.get("twin") or TwinFile()
    assert isinstance(twin, TwinFile), "so the scenario's model has it"
    settings = {"model": COMPLIANT, "friction": twin.law, "gaps": twin.gaps}
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
