"""HTML report of a fit, with parameters, residual plots, data and package versions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np

from srs_twin.viewing.html import Picture, Table, notebook_output, picture, render
from srs_twin.viewing.plots.style import drawing, finish, panels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from srs_twin.identification.estimate import FitEstimate, Parameter, Residual
    from srs_twin.identification.fit_file import FitFile, ParameterEntry


_MAX_PANELS = 10

_MAX_BARS = 3
"""Maximum number of samples in a bar plot."""

_COLORS = {"fit": "#0072B2", "validation": "#D55E00"}


def fit_report(fit: FitFile, estimate: FitEstimate) -> str:
    """Return a self-contained HTML report of a fit.

    The residuals in `estimate` must include those of the validation data.
    """
    quality = fit.quality
    validated = ""
    if quality.validation_rms is not None:
        validated = f", of the validation data {quality.validation_rms:.3g}"
    summary = (
        f"RMS of the weighted residuals of the fit {quality.rms or 0.0:.3g}{validated}"
        " (1 if they are as large as the expected noise);"
        f" {quality.samples} samples, equivalent to"
        f" {quality.independent_samples:.4g} independent samples."
        f" {'; '.join(quality.misfit or ())}"
    )
    data = [
        [entry.role, entry.name, str(entry.samples), entry.sha256[:16] + "…"]
        for entry in fit.data
    ]
    return render(
        "identification/fit.html",
        title=fit.title,
        subtitle=f"fit {fit.name}, {fit.method}, of robot {fit.robot}",
        parameters=parameter_table((*fit.parameters, *(fit.derived or ()))),
        quality=summary,
        residuals=list(_pictures(estimate.residuals)),
        command=fit.command,
        data=Table(["used for", "data", "samples", "SHA-256"], data, numbers=[2]),
        details=_details(fit),
    )


def fit_page(fit: FitEstimate | FitFile) -> str:
    """Return the HTML with which a notebook shows a fit."""
    return notebook_output(
        getattr(fit, "title", "Fit"),
        parameter_table((*fit.parameters, *(fit.derived or ()))),
    )


@drawing
def residual_plot(residuals: Sequence[Residual]) -> Figure:
    """Plot the residuals of at most ten signals, with the expected noise as a band."""
    shown = residuals[:_MAX_PANELS]
    figure, rows = panels(0.95 + 0.95 * len(shown), len(shown))
    for axes, residual in zip(rows, shown, strict=True):
        _panel(axes, residual)
    first = shown[0]
    total = ""
    if len(residuals) > len(shown):
        total = f", {len(shown)} of {len(residuals)} signals"
    rows[0].set_title(
        f"{first.role}: {_data_name(first)}{total}", fontsize=10, loc="left"
    )
    rows[-1].set_xlabel("sample")
    return figure


def _panel(axes: Axes, residual: Residual) -> None:
    values = residual.values
    color = _COLORS[residual.role]
    axes.axhspan(-2 * residual.scale, 2 * residual.scale, color="0.9", linewidth=0)
    if len(values) <= _MAX_BARS:
        axes.bar(np.arange(len(values)), values, width=0.4, color=color)
    else:
        axes.plot(values, color=color, linewidth=0.8)
    axes.axhline(0.0, color="0.4", linewidth=0.6)
    unit = "" if residual.unit == "1" else f"\n({residual.unit})"
    finish(axes, f"{residual.name.rpartition(' ')[2]}{unit}")


def _pictures(residuals: Sequence[Residual]) -> Iterator[Picture]:
    ordered = sorted(
        (residual for residual in residuals if len(residual.values)),
        key=lambda residual: residual.role,
    )
    groups = groupby(ordered, lambda residual: (residual.role, _data_name(residual)))
    for (role, name), group in groups:
        note = " (not used by the fit)" if role == "validation" else ""
        yield picture(residual_plot(list(group)), f"Residuals of {name}{note}.")


def _data_name(residual: Residual) -> str:
    return residual.name.rpartition(" ")[0] or residual.name


def parameter_table(parameters: Sequence[Parameter | ParameterEntry]) -> Table:
    """Return a table of parameters with the reasons for their verdicts."""
    rows = []
    for parameter in parameters:
        numbers = ["–", ""]
        if parameter.value is not None:
            numbers = [
                f"{parameter.value:.5g}",
                f"{parameter.low:.5g} to {parameter.high:.5g}",
            ]
        rows.append(
            [parameter.name, *numbers, parameter.unit, parameter.verdict, parameter.why]
        )
    headings = ["parameter", "value", "95 % interval", "unit", "verdict", "why"]
    return Table(headings, rows, numbers=[1, 2])


def direction_text(direction: Mapping[str, float]) -> str:
    """Return the components of an unidentifiable direction as text."""
    return ", ".join(
        f"{component:+.2f} {name}" for name, component in direction.items()
    )


def _details(fit: FitFile) -> dict[str, Table]:
    known = [
        parameter.name for parameter in fit.parameters if parameter.value is not None
    ]
    pairs = zip(known, fit.correlation, strict=True) if len(known) > 1 else ()
    correlations = [[name, *(f"{value:+.2f}" for value in row)] for name, row in pairs]
    directions = [[direction_text(direction)] for direction in fit.cancels]
    held = [[name, f"{value:.6g}"] for name, value in fit.held.items()]
    return {
        "Correlations": Table(["", *known], correlations, range(1, len(known) + 1)),
        "Unidentifiable directions": Table(["component and parameter"], directions),
        "Fixed values": Table(["parameter", "value"], held, numbers=[1]),
        "Versions": Table(["package", "version"], list(fit.versions.items())),
    }
