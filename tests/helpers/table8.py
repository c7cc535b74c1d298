"""Fits of generation 4 to Table 8: their studies, files, and the width of the body."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from box_edges import WIDTH, BoxEdges, fit_width

from srs_twin import load_robot
from srs_twin.errors import InputError
from srs_twin.identification.fit_file import FitFile, fit_file, load_fit
from srs_twin.identification.footprint import GaitSetup
from srs_twin.io.files import data_root
from srs_twin.scenario.provenance import versions

FREQUENCY_HZ = 1.5
SUPPLY_PA = 131e3
TARGET_RAD = 0.7
FITTED = (0.0, 0.3, -0.3)
LENGTH = "geometry.segment_length_m"
UNKNOWN = {LENGTH: 0.1164, "friction.mu_t": 0.0901, "modules.sensor_bias_rad": 0.0151}
"""Unknown parameters and their initial values, from which every plant moves forward without diverging."""
ASKED = (
    "friction.mu_n",
    "geometry.rigid_gap_m",
    "mass.connectors_kg",
    "bending.stiffness_nm_per_rad",
    "bending.damping_time_s",
    "modules.bias_rad_1",
)
"""Fixed parameters whose identifiability is tested in the fast studies."""


@dataclass(frozen=True)
class Study:
    """Fit to the rows.

    Attributes:
        plant: plant that models the robot.
        steering: target of the offset, see `ILC`.
        held: fixed and tested parameters: a value, or None for the value in the fit of
            the analytical plant.
        asked: parameters that are fixed at the value of the robot and tested.
    """

    plant: str
    steering: str = "targets"
    held: Mapping[str, float | None] = field(default_factory=dict)
    asked: tuple[str, ...] = ()


STUDIES = {
    "analytical": Study("analytical", asked=ASKED),
    "twin": Study("twin", held={LENGTH: None}),
    # A search for all three ended at 0.1555 m, 0.116 and 0.016 rad; length and mu_t
    # were not identifiable.
    "analytical_wave": Study(
        "analytical", steering="targets_and_wave", held={LENGTH: 0.1555}
    ),
}


def place(study: str) -> Path:
    """Return the path of the fit file of a study."""
    return data_root() / "calibration" / "fits" / f"gen4_table8_{study}.yaml"


def shipped() -> dict[str, FitFile]:
    """Return the existing fits by study."""
    return {
        study: load_fit(place(study)) for study in STUDIES if place(study).is_file()
    }


def drive_of(study: str) -> GaitSetup:
    """Return generation 4 with the iterative learning control of Section 5.3."""
    plant = STUDIES[study].plant
    steering = STUDIES[study].steering
    return GaitSetup(
        load_robot("gen4"), FREQUENCY_HZ, SUPPLY_PA, "ilc", TARGET_RAD, plant, steering
    )


def held_values(study: str) -> dict[str, float]:
    """Return the fixed parameters of a study and their values."""
    held = STUDIES[study].held
    known = (
        load_fit(place("analytical")).estimate().values if None in held.values() else {}
    )
    return {
        name: known[name] if value is None else value for name, value in held.items()
    }


def values_of(fit: FitFile, kind: str) -> dict[float, tuple[float, float]]:
    """Return speed (m/s) and unsigned radius (m) by offset; kind is "measured" or "predicted"."""
    result = {}
    for item in sorted(
        fit.data, key=lambda item: float(item.name.removeprefix("offset "))
    ):
        held = getattr(item, kind)
        offset = float(item.name.removeprefix("offset "))
        result[offset] = (held["speed_m_s"], 1 / abs(held["curvature_per_m"]))
    return result


PLANT = "analytical"


def edges(fitted: FitFile, role: str) -> list[BoxEdges]:
    """Return the runs of a role from a fit to speeds and radii."""
    result = []
    for item in fitted.data:
        if item.role == role:
            assert item.measured is not None and item.predicted is not None, (
                "the fit holds what it predicts"
            )
            measured, drawn = (
                (-prediction["left_m"], prediction["right_m"])
                for prediction in (item.measured, item.predicted)
            )
            result.append(
                BoxEdges(float(item.name.removeprefix("offset ")), measured, drawn)
            )
    return result


def with_averages(
    fit: FitFile, averages: Mapping[str, tuple[dict[str, float], dict[str, float]]]
) -> FitFile:
    """Return a fit with averages as measured and as predicted with the fitted values, by name of the data."""
    if missing := fit.unidentified():
        raise InputError(
            f"{fit.name}: {', '.join(missing)} has no value, so nothing can be"
            " predicted; fix one"
        )
    data = []
    for entry in fit.data:
        measured, predicted = (
            {name: float(f"{value:.6g}") for name, value in average.items()}
            for average in averages[entry.name]
        )
        data.append(
            entry.model_copy(update={"measured": measured, "predicted": predicted})
        )
    return fit.model_copy(update={"data": data})


def fit_body_width() -> FitFile:
    """Fit the width to three rows and predict all rows."""
    moves = load_fit(place(PLANT))
    spec = load_robot("gen4")
    fitted = edges(moves, "fit")
    kept = edges(moves, "validation")
    result = fit_width(fitted, spec, validation=kept)
    change = result.values[WIDTH] - spec.geometry.width
    fit = fit_file(
        result,
        name="gen4_table8_width",
        title="Generation 4's width from Table 8's boxes at 0 and ±0.3",
        robot="gen4",
        method="edges",
        command="uv run python benchmarks/table8_fit.py --width",
        versions=versions(),
        data=[item.data_set("fit") for item in fitted]
        + [item.data_set("validation") for item in kept],
    )
    averages = {
        f"offset {item.offset:g}": (
            _named(*item.measured),
            _named(*item.of_width(change)),
        )
        for item in [*fitted, *kept]
    }
    return with_averages(fit, averages)


def _named(left: float, right: float) -> dict[str, float]:
    return {"left_m": -left, "right_m": right}
