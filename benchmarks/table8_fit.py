r"""Fits of generation 4 to Table 8: fitted to offsets 0 and ±0.3, validated at ±0.1 and ±0.2.

    uv run python benchmarks/table8_fit.py --plant twin --threads 2
    uv run python benchmarks/table8_fit.py --plant analytical --wave
    uv run python benchmarks/table8_fit.py --show --page docs/reproduction.md \
        --picture docs/images/table8_fit.png

The first command fits a plant and writes calibration/fits/gen4_table8_twin.yaml, in ten
minutes on a busy machine with two cores. The second uses another reading of the
dissertation, in which the offset acts on the valve pattern as well as on the targets.
In both, length and mu_t cannot be identified together from these rows, so the length is
fixed. The fit of the twin uses the length from the fit of the analytical plant, which
must exist. The last command writes the tables of the fits into the page.

`--width` fits the width of generation 4 to the edges in Table 8, with the same rows for
fit and validation. The lateral reach of the plant is taken from the fit to speeds and
radii. The result is written to calibration/fits/gen4_table8_width.yaml. The width is a
property of the body, so only the analytical plant is used.
"""

from __future__ import annotations

import argparse
import math
import re
import sys
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from common.grid import table

from srs_twin.errors import InputError
from srs_twin.identification.fit_file import FitFile, fit_file, load_fit, write_fit
from srs_twin.identification.fitted_robot import apply_fit
from srs_twin.identification.footprint import PLANTS, GaitSetup
from srs_twin.identification.parameters import with_values
from srs_twin.io.files import atomic_write
from srs_twin.scenario.provenance import versions

sys.path.append(str(Path(__file__).parents[1] / "tests/helpers"))
from offset_runs import fit_offsets, offset_runs, predicted
from published_tables import PublishedRun, published_runs
from table8 import (
    FITTED,
    STUDIES,
    UNKNOWN,
    drive_of,
    fit_body_width,
    held_values,
    place,
    shipped,
    values_of,
    with_averages,
)


def main() -> None:
    """Fit a plant, or show the existing fits."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--plant", choices=PLANTS, default="analytical")
    parser.add_argument(
        "--wave", action="store_true", help="the offset also acts on the valve pattern"
    )
    parser.add_argument("--threads", type=int)
    parser.add_argument("--show", action="store_true")
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--page", type=Path, help="page whose tables are replaced")
    parser.add_argument(
        "--width", action="store_true", help="fit the width to the edges instead"
    )
    options = parser.parse_args()
    if options.width:
        show_width(fitted=options.show)
        return
    study = options.plant + ("_wave" if options.wave else "")
    if study not in STUDIES:
        parser.error("--wave needs --plant analytical")
    if not options.show:
        print(write_fit(fit(study, options.threads), place(study)))
    fits = shipped()
    for name, item in fits.items():
        print(f"\n{name}\n{item.estimate().text()}")
    # The data contradict the alternative interpretation, so only its parameters are shown.
    main_fits = {name: item for name, item in fits.items() if name in PLANTS}
    tables = [values_table(fits), rows_table(main_fits), pairs_table(main_fits)]
    print("\n" + "\n\n".join(tables))
    if options.page:
        text = with_tables(options.page.read_text("utf-8"), tables)
        with atomic_write(options.page) as part:
            part.write_text(text, "utf-8")
    if options.picture:
        picture(fits).savefig(options.picture, dpi=130)


def show_width(*, fitted: bool) -> None:
    """Fit the width to the edges and write it, unless it is already fitted, and print it."""
    if fitted:
        file = load_fit(place("width"))
    else:
        file = fit_body_width()
        print(write_fit(file, place("width")))
    print(file.estimate().text())
    print("\n" + edges_table(file))


def edges_table(file: FitFile) -> str:
    """Return the measured and predicted edges of each row."""
    rows = []
    for item in sorted(
        file.data, key=lambda item: float(item.name.removeprefix("offset "))
    ):
        cells = []
        for side in ("left_m", "right_m"):
            prediction = item.predicted[side]
            seen = item.measured[side]
            cells += [
                f"{seen:g}",
                f"{prediction:.3f} ({100 * (prediction / seen - 1):+.0f} %)",
            ]
        rows.append(
            [
                item.name.removeprefix("offset "),
                "fit" if item.role == "fit" else "predicted",
                *cells,
            ]
        )
    sides = [
        f"{side} edge: {whose}"
        for side in ("left", "right")
        for whose in ("Table 8 (m)", "fit")
    ]
    return table(["offset", "row", *sides], rows)


def with_tables(text: str, tables: Sequence[str]) -> str:
    """Return a page in which each table replaces the one with the same first three headings."""
    for item in tables:
        head = "|".join(item.split("|")[:4])
        text, count = re.subn(
            rf"(?m)^{re.escape(head)}\|.*(\n\|.*)*", lambda _, new=item: new, text
        )
        if count != 1:
            raise InputError(
                f"{count} tables begin with {head}|; exactly one is needed"
            )
    return text


def fit(study: str, threads: int | None = None) -> FitFile:
    """Fit a plant to three rows of Table 8 and predict all rows."""
    drive = drive_of(study)
    rows = published_runs()
    held = held_values(study)
    fitted_rows = offset_runs([row for row in rows if row.offset in FITTED])
    kept = offset_runs([row for row in rows if row.offset not in FITTED])
    start = {name: value for name, value in UNKNOWN.items() if name not in held}
    result = fit_offsets(
        fitted_rows,
        replace(drive, spec=with_values(drive.spec, held)),
        start,
        besides=(*held, *STUDIES[study].asked),
        validation=kept,
        starting=start,
        threads=threads,
    )
    data = [run.data_set("fit") for run in fitted_rows] + [
        run.data_set("validation") for run in kept
    ]
    bare = fit_file(
        result,
        name=f"gen4_table8_{study}",
        title=title(study, held),
        robot="gen4",
        method="offsets",
        command=command(study),
        versions=versions(),
        data=data,
    )
    if bare.unidentified():
        raise InputError(
            f"{result.text()}\n{', '.join(bare.unidentified())} cannot be identified:"
            " fix one of them"
        )
    # Predict with the rounded values in the file.
    return with_averages(
        bare, averages(rows, replace(drive, spec=apply_fit(bare, drive.spec)), threads)
    )


def title(study: str, held: Iterable[str]) -> str:
    """Return a one-line title with the fixed parameters and the source of their values."""
    line = f"Generation 4 from Table 8's offsets 0 and ±0.3, {STUDIES[study].plant}"
    if STUDIES[study].steering != "targets":
        line += ", the offset also on the valves' wave"
    for name in held:
        if STUDIES[study].held[name] is None:
            where = "at the analytical plant's fit"
        else:
            where = "at a search's end"
        line += f", {name} held {where}"
    return line


def command(study: str) -> str:
    """Return the command that makes the fit of a study."""
    wave = " --wave" if STUDIES[study].steering != "targets" else ""
    return (
        f"uv run python benchmarks/table8_fit.py --plant {STUDIES[study].plant}{wave}"
    )


def averages(rows: Sequence[PublishedRun], drive: GaitSetup, threads: int | None):
    """Return the measured and predicted values by name of the data."""
    paths = predicted(drive, [row.offset for row in rows], threads=threads)
    result = {}
    for row, path in zip(rows, paths, strict=True):
        # The table has no side for offset 0: use the side of the prediction.
        curvature = math.copysign(1 / row.radius_m, row.offset or path.curvature)
        result[f"offset {row.offset:g}"] = (
            _named(row.speed_m_s, curvature, row.left_m, row.right_m),
            _named(path.speed, path.curvature, -path.left, path.right),
        )
    return result


def _named(
    speed: float, curvature: float, left: float, right: float
) -> dict[str, float]:
    return {
        "speed_m_s": speed,
        "curvature_per_m": curvature,
        "left_m": left,
        "right_m": right,
    }


def with_deviation(one: float, other: float) -> str:
    return f"{one:.4g} ({100 * (one / other - 1):+.0f} %)"


def values_table(fits: dict[str, FitFile]) -> str:
    """Return the fitted values of each plant with 95 % intervals."""
    rows = [
        [name, *(value_text(fit, name) for fit in fits.values())] for name in UNKNOWN
    ]
    return table(["parameter", *fits], rows)


def value_text(fit: FitFile, name: str) -> str:
    """Return a parameter's value, fitted or fixed, as text."""
    item = next((item for item in fit.parameters if item.name == name), None)
    if item and item.value is not None:
        return f"{item.value:.3g} ({item.low:.2g} to {item.high:.2g}), {item.verdict}"
    return f"{fit.held[name]:.3g}, fixed" + (f": {item.verdict}" if item else "")


def rows_table(fits: dict[str, FitFile]) -> str:
    """Return each row of Table 8 with the predictions of all plants."""
    rows = []
    seen = values_of(next(iter(fits.values())), "measured")
    for offset, (speed, radius) in seen.items():
        predictions = [values_of(item, "predicted")[offset] for item in fits.values()]
        rows.append(
            [
                f"{offset:g}",
                "fit" if offset in FITTED else "predicted",
                f"{speed:g}",
                *(with_deviation(item[0], speed) for item in predictions),
                f"{radius:.5g}",
                *(with_deviation(item[1], radius) for item in predictions),
            ]
        )
    heads = [
        "offset",
        "row",
        "speed: Table 8 (m/s)",
        *fits,
        "radius: Table 8 (m)",
        *fits,
    ]
    return table(heads, rows)


def pairs_table(fits: dict[str, FitFile]) -> str:
    """Return the means over ±offset."""
    rows = []
    seen = values_of(next(iter(fits.values())), "measured")

    def mean(
        pairs: dict[float, tuple[float, float]], offset: float, which: int
    ) -> float:
        return (pairs[offset][which] + pairs[-offset][which]) / 2

    for offset in sorted(item for item in seen if item > 0):
        cells = []
        for which in (0, 1):
            held = mean(seen, offset, which)
            spread = abs(seen[offset][which] - seen[-offset][which]) / 2 / held
            cells += [f"{held:.4g} ± {100 * spread:.0f} %"]
            cells += [
                with_deviation(mean(values_of(item, "predicted"), offset, which), held)
                for item in fits.values()
            ]
        rows.append(
            [f"±{offset:g}", "fit" if offset in FITTED else "predicted", *cells]
        )
    heads = [
        "offsets",
        "rows",
        "mean speed: Table 8 (m/s)",
        *fits,
        "mean radius: Table 8 (m)",
        *fits,
    ]
    return table(heads, rows)


def width(pairs: dict[str, float]) -> float:
    return pairs["right_m"] - pairs["left_m"]


def picture(fits: dict[str, FitFile]):
    """Plot speed and radius against offset, with filled markers for fitted rows."""
    from matplotlib.figure import Figure

    from srs_twin.viewing.plots.style import style_of

    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    panels = figure.subplots(1, 2)
    seen = values_of(next(iter(fits.values())), "measured")
    for which, (axes, label) in enumerate(
        zip(panels, ("speed (m/s)", "radius (m)"), strict=True)
    ):
        for index, (plant, item) in enumerate(fits.items()):
            predictions = values_of(item, "predicted")
            style = style_of(plant, index)
            offsets = np.array(
                [offset for offset in predictions if which == 0 or offset != 0]
            )
            for side in (offsets < 0, offsets > 0) if which else (offsets < 9,):
                axes.plot(
                    offsets[side],
                    [predictions[offset][which] for offset in offsets[side]],
                    style.dash,
                    color=style.color,
                    label=plant if side[0] else None,
                    marker=".",
                )
        for offset, values in seen.items():
            face = "black" if offset in FITTED else "white"
            axes.plot(
                offset,
                values[which],
                "o",
                color="black",
                markerfacecolor=face,
                zorder=3,
            )
        for face, text in (
            ("black", "Table 8, fitted"),
            ("white", "Table 8, predicted"),
        ):
            axes.plot([], [], "o", color="black", markerfacecolor=face, label=text)
        axes.set_xlabel("offset (positive to the left)")
        axes.set_ylabel(label)
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
    panels[0].legend(fontsize=8, frameon=False, loc="lower left")
    return figure


if __name__ == "__main__":
    main()
