"""Fits of generation 4 to Table 8: their studies, files, and the width of the body."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from box_edges import WIDTH, BoxEdges, fit_width

from srs_twin import load_robot
from srs_twin.identification.fit_file import FitFile, fit_file, load_fit
from srs_twin.identification.footprint import Drive
from srs_twin.io.files import data_root
from srs_twin.scenario.provenance import versions

FREQUENCY_HZ, SUPPLY_PA, TARGET_RAD = 1.5, 131e3, 0.7
FITTED = (0.0, 0.3, -0.3)
LENGTH = "geometry.segment_length_m"
UNKNOWN = {LENGTH: 0.1164, "friction.mu_t": 0.0901, "modules.sensor_bias_rad": 0.0151}
"""What is looked for, and where the search begins: from there every plant stands, and goes ahead."""
ASKED = (
    "friction.mu_n", "geometry.rigid_gap_m", "mass.connectors_kg", "bending.stiffness_nm_per_rad",
    "bending.damping_time_s", "modules.bias_rad_1",
)  # fmt: skip
"""What is held at the robot's value, and asked after where that does not take too long."""


@dataclass(frozen=True)
class Study:
    """One fit to the rows.

    Attributes:
        plant: that stands for the robot.
        steering: what the offset acts on, see `ILC`.
        held: what is not looked for but held, and asked after: a value, or None for that of the analytical
            plant's fit.
        asked: what is held at the robot's value, and asked after.
    """

    plant: str
    steering: str = "targets"
    held: Mapping[str, float | None] = field(default_factory=dict)
    asked: tuple[str, ...] = ()


STUDIES = {
    "analytical": Study("analytical", asked=ASKED),
    "twin": Study("twin", held={LENGTH: None}),
    # A search for all three ended at 0.1555 m, 0.116 and 0.016 rad and gave length and mu_t no number.
    "analytical_wave": Study("analytical", steering="targets_and_wave", held={LENGTH: 0.1555}),
}


def place(study: str) -> Path:
    """Return where the fit of a study is kept."""
    return data_root() / "calibration" / "fits" / f"gen4_table8_{study}.yaml"


def shipped() -> dict[str, FitFile]:
    """Return the fits that there are, by study."""
    return {study: load_fit(place(study)) for study in STUDIES if place(study).is_file()}


def drive_of(study: str) -> Drive:
    """Return generation 4 under Section 5.3's iterative learning."""
    plant, steering = STUDIES[study].plant, STUDIES[study].steering
    return Drive(load_robot("gen4"), FREQUENCY_HZ, SUPPLY_PA, "ilc", TARGET_RAD, plant, steering)


def held_values(study: str) -> dict[str, float]:
    """Return what a study holds, and at which values."""
    held = STUDIES[study].held
    known = load_fit(place("analytical")).estimate().values if None in held.values() else {}
    return {name: known[name] if value is None else value for name, value in held.items()}


def values_of(fit: FitFile, kind: str) -> dict[float, tuple[float, float]]:
    """Return offset → speed (m/s) and radius (m, no sign), kind "measured" or "predicted"."""
    found = {}
    for each in sorted(fit.data, key=lambda each: float(each.name.removeprefix("offset "))):
        held = getattr(each, kind)
        offset = float(each.name.removeprefix("offset "))
        found[offset] = (held["speed_m_s"], 1 / abs(held["curvature_per_m"]))
    return found


PLANT = "analytical"


def edges(fitted: FitFile, role: str) -> list[BoxEdges]:
    """Return the runs of a role, as a fit to speeds and radii holds them."""
    found = []
    for each in fitted.data:
        if each.role == role:
            assert each.measured is not None and each.predicted is not None, "the fit holds what it predicts"
            measured, drawn = ((-told["left_m"], told["right_m"]) for told in (each.measured, each.predicted))
            found.append(BoxEdges(float(each.name.removeprefix("offset ")), measured, drawn))
    return found


def fit_body_width() -> FitFile:
    """Fit the width to three rows and predict all."""
    moves, spec = load_fit(place(PLANT)), load_robot("gen4")
    fitted, kept = edges(moves, "fit"), edges(moves, "validation")
    found = fit_width(fitted, spec, validation=kept)
    change = found.values[WIDTH] - spec.geometry.width
    return fit_file(
        found, name="gen4_table8_width", title="Generation 4's width from Table 8's boxes at 0 and ±0.3",
        robot="gen4", method="edges", command="uv run python benchmarks/table8_width.py", versions=versions(),
        data=[each.data_set("fit") for each in fitted] + [each.data_set("validation") for each in kept],
        averages={
            f"offset {each.offset:g}": (_named(*each.measured), _named(*each.of_width(change)))
            for each in [*fitted, *kept]
        },
    )  # fmt: skip


def _named(left: float, right: float) -> dict[str, float]:
    return {"left_m": -left, "right_m": right}
