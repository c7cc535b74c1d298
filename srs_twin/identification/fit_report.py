"""Report of a fit: its table, its residuals as plots, and the data it was made from, in one page."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np

from srs_twin.viewing.html.page import Picture, Table, notebook_output, picture, render
from srs_twin.viewing.plots.style import finish, panels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from srs_twin.identification.estimate import Estimate, Parameter, Residual
    from srs_twin.identification.fit_file import FitFile, ParameterEntry


_MOST_PANELS = 10
_FEW = 3  # samples: fewer are bars, not lines
_COLORS = {"fit": "#0072B2", "validation": "#D55E00"}


def fit_report(fit: FitFile, estimate: Estimate) -> str:
    """Return the page of a fit; it needs nothing from outside itself.

    Args:
        fit: what was written.
        estimate: with the residuals of all its data.
    """
    quality = fit.quality
    validated = "" if quality.validation_rms is None else f", of the validation {quality.validation_rms:.3g}"
    found = (
        f"Weighted residuals of the fit {quality.rms or 0.0:.3g} RMS{validated} (1: as large as the noise "
        f"that is expected); {quality.samples} samples worth {quality.independent_samples:.4g}. "
        f"{'; '.join(quality.misfit or ())}"
    )
    data = [[each.role, each.name, str(each.samples), each.sha256[:16] + "…"] for each in fit.data]
    return render(
        "identification/fit.html",
        title=fit.title,
        subtitle=f"fit {fit.name}, {fit.method}, of robot {fit.robot}",
        parameters=parameter_table(fit.parameters),
        quality=found,
        residuals=list(_pictures(estimate.residuals)),
        command=fit.command,
        data=Table(["used for", "data", "samples", "SHA-256"], data, numbers=[2]),
        details=_details(fit),
    )


def fit_page(fit: Estimate | FitFile) -> str:
    """Return a fit as HTML for a notebook."""
    return notebook_output(getattr(fit, "title", "Fit"), parameter_table(fit.parameters))


def residual_plot(residuals: Sequence[Residual]) -> Figure:
    """Return a panel a signal: measured less predicted, over the samples, with the noise as a band.

    Args:
        residuals: of one or more signals, ten at most are shown.
    """
    shown = residuals[:_MOST_PANELS]
    figure, rows = panels(0.95 + 0.95 * len(shown), len(shown))
    for axes, each in zip(rows, shown, strict=True):
        _panel(axes, each)
    first = shown[0]
    some = "" if len(residuals) <= len(shown) else f", {len(shown)} of {len(residuals)} signals"
    rows[0].set_title(f"{first.role}: {_data_of(first)}{some}", fontsize=10, loc="left")
    rows[-1].set_xlabel("sample")
    return figure


def _panel(axes: Axes, residual: Residual) -> None:
    values, color = residual.values, _COLORS[residual.role]
    axes.axhspan(-2 * residual.scale, 2 * residual.scale, color="0.9", linewidth=0)
    if len(values) <= _FEW:
        axes.bar(np.arange(len(values)), values, width=0.4, color=color)
    else:
        axes.plot(values, color=color, linewidth=0.8)
    axes.axhline(0.0, color="0.4", linewidth=0.6)
    unit = "" if residual.unit == "1" else f"\n({residual.unit})"
    finish(axes, f"{residual.name.rpartition(' ')[2]}{unit}")


def _pictures(residuals: Sequence[Residual]) -> Iterator[Picture]:
    """Yield a plot for each set of data, those of the fit first."""
    ordered = sorted((each for each in residuals if len(each.values)), key=lambda each: each.role)
    for (role, name), group in groupby(ordered, key=lambda each: (each.role, _data_of(each))):
        kept = " (the fit has not seen them)" if role == "validation" else ""
        yield picture(residual_plot(list(group)), f"Residuals of {name}{kept}.")


def _data_of(residual: Residual) -> str:
    """Return the name of the data of a signal."""
    return residual.name.rpartition(" ")[0] or residual.name


def parameter_table(parameters: Sequence[Parameter | ParameterEntry]) -> Table:
    """Return what was found of each parameter, and why, in the last column, where it was not found well."""
    rows = []
    for each in parameters:
        numbers = ["–", ""]
        if each.value is not None:
            numbers = [f"{each.value:.5g}", f"{each.low:.5g} to {each.high:.5g}"]
        rows.append([each.name, *numbers, each.unit, each.verdict, each.why])
    headings = ["parameter", "value", "95 % interval", "unit", "verdict", "why"]
    return Table(headings, rows, numbers=[1, 2])


def _details(fit: FitFile) -> dict[str, Table]:
    """Return title → what stands folded below; tables without rows are not shown."""
    known = [each.name for each in fit.parameters if each.value is not None]
    pairs = zip(known, fit.correlation, strict=True) if len(known) > 1 else ()
    correlations = [[name, *(f"{value:+.2f}" for value in row)] for name, row in pairs]
    cancels = [[", ".join(f"{share:+.2f} {name}" for name, share in row.items())] for row in fit.cancels]
    held = [[name, f"{value:.6g}"] for name, value in fit.held.items()]
    return {
        "Correlations": Table(["", *known], correlations, range(1, len(known) + 1)),
        "Directions in which nothing changes": Table(["share and parameter"], cancels),
        "Taken as known": Table(["what", "value"], held, numbers=[1]),
        "Versions": Table(["package", "version"], list(fit.versions.items())),
    }
