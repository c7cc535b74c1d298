r"""Generation 4 from Table 8: fitted on offsets 0 and ±0.3 alone, predicting ±0.1 and ±0.2.

    uv run python benchmarks/table8_fit.py --plant twin --threads 2
    uv run python benchmarks/table8_fit.py --plant analytical --wave
    uv run python benchmarks/table8_fit.py --show --page docs/dissertation-data.md \
        --picture docs/images/table8_fit.png

The first fits a plant and writes calibration/fits/gen4_table8_twin.yaml: ten minutes on a busy machine of two
cores. The second reads the text otherwise: the offset acts on the valves' wave besides the targets. In both,
length and mu_t together get no number from these rows, so that the length is held; the twin's where the
analytical plant's fit has it: fit that one first. The last puts what these files hold into the page.
"""

from __future__ import annotations

import argparse
import math
import re
import sys
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from grid import table

from srs_twin.errors import InputError
from srs_twin.identification.fit_file import FitFile, fit_file, write_fit
from srs_twin.identification.fitted_robot import fitted
from srs_twin.identification.footprint import PLANTS, Drive
from srs_twin.identification.unknowns import with_values
from srs_twin.io.files import atomic_write
from srs_twin.scenario.provenance import versions

sys.path.append(str(Path(__file__).parents[1] / "tests/helpers"))
from offset_runs import fit_offsets, offset_runs, predicted
from published_tables import PublishedRun, published_runs
from table8 import FITTED, STUDIES, UNKNOWN, drive_of, held_values, place, shipped, values_of


def main() -> None:
    """Fit, or show what was fitted."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--plant", choices=PLANTS, default="analytical")
    parser.add_argument("--wave", action="store_true", help="the offset acts on the valves' wave as well")
    parser.add_argument("--threads", type=int)
    parser.add_argument("--show", action="store_true")
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--page", type=Path, help="a page whose tables are to be those of the files")
    given = parser.parse_args()
    study = given.plant + ("_wave" if given.wave else "")
    if study not in STUDIES:
        parser.error("--wave goes with the analytical plant")
    if not given.show:
        print(write_fit(fit(study, given.threads), place(study)))
    fits = shipped()
    for name, each in fits.items():
        print(f"\n{name}\n{each.estimate().text()}")
    tables = [each(fits) for each in (values_table, rows_table, pairs_table)]
    print("\n" + "\n\n".join(tables))
    if given.page:
        text = with_tables(given.page.read_text("utf-8"), tables)
        with atomic_write(given.page) as part:
            part.write_text(text, "utf-8")
    if given.picture:
        picture(fits).savefig(given.picture, dpi=130)


def with_tables(text: str, tables: Sequence[str]) -> str:
    """Return a page in which each table stands in place of the one with the same first three headings."""
    for each in tables:
        head = "|".join(each.split("|")[:4])
        text, count = re.subn(rf"(?m)^{re.escape(head)}\|.*(\n\|.*)*", lambda _, new=each: new, text)
        if count != 1:
            raise InputError(f"{count} tables begin with {head}|, where one is wanted")
    return text


def fit(study: str, threads: int | None = None) -> FitFile:
    """Fit a plant to three rows of Table 8 and predict all."""
    drive, rows, held = drive_of(study), published_runs(), held_values(study)
    fitted_rows = offset_runs([row for row in rows if row.offset in FITTED])
    kept = offset_runs([row for row in rows if row.offset not in FITTED])
    start = {name: value for name, value in UNKNOWN.items() if name not in held}
    found = fit_offsets(
        fitted_rows, replace(drive, spec=with_values(drive.spec, held)), start,
        besides=(*held, *STUDIES[study].asked), validation=kept, starting=start, threads=threads,
    )  # fmt: skip
    data = [run.data_set("fit") for run in fitted_rows] + [run.data_set("validation") for run in kept]
    make = partial(
        fit_file, found, name=f"gen4_table8_{study}", title=title(study, held), robot="gen4",
        method="offsets", command=command(study), versions=versions(), data=data,
    )  # fmt: skip
    bare = make()
    if bare.withheld():
        raise InputError(f"{found.text()}\n{', '.join(bare.withheld())} without a number: hold one of them")
    # Predicted with the numbers that stand in the file, and with no others.
    return make(averages=averages(rows, replace(drive, spec=fitted(bare, drive.spec)), threads))


def title(study: str, held: Iterable[str]) -> str:
    """Return one line that says what was fitted, and what was held and why."""
    line = f"Generation 4 from Table 8's offsets 0 and ±0.3, {STUDIES[study].plant}"
    if STUDIES[study].steering != "targets":
        line += ", the offset also on the valves' wave"
    for name in held:
        where = "at the analytical plant's fit" if STUDIES[study].held[name] is None else "at a search's end"
        line += f", {name} held {where}"
    return line


def command(study: str) -> str:
    """Return what makes a study's fit."""
    wave = " --wave" if STUDIES[study].steering != "targets" else ""
    return f"uv run python benchmarks/table8_fit.py --plant {STUDIES[study].plant}{wave}"


def averages(rows: Sequence[PublishedRun], drive: Drive, threads: int | None):
    """Return what was measured and what the fitted robot does, by name of the data."""
    paths = predicted(drive, [row.offset for row in rows], threads=threads)
    found = {}
    for row, path in zip(rows, paths, strict=True):
        # The side of offset 0 is not printed: that to which the robot goes.
        curvature = math.copysign(1 / row.radius_m, row.offset or path.curvature)
        found[f"offset {row.offset:g}"] = (
            _named(row.speed_m_s, curvature, row.left_m, row.right_m),
            _named(path.speed, path.curvature, -path.left, path.right),
        )
    return found


def _named(speed: float, curvature: float, left: float, right: float) -> dict[str, float]:
    return {"speed_m_s": speed, "curvature_per_m": curvature, "left_m": left, "right_m": right}


def off(one: float, other: float) -> str:
    return f"{one:.4g} ({100 * (one / other - 1):+.0f} %)"


def values_table(fits: dict[str, FitFile]) -> str:
    """Return what was found by each plant, with 95 % intervals."""
    rows = [[name, *(value_text(fit, name) for fit in fits.values())] for name in UNKNOWN]
    return table(["parameter", *fits], rows)


def value_text(fit: FitFile, name: str) -> str:
    """Return what a fit says of a number: found, or held."""
    each = next((each for each in fit.parameters if each.name == name), None)
    if each and each.value is not None:
        return f"{each.value:.3g} ({each.low:.2g} to {each.high:.2g}), {each.verdict}"
    return f"{fit.held[name]:.3g}, fixed" + (f": {each.verdict}" if each else "")


def rows_table(fits: dict[str, FitFile]) -> str:
    """Return each row of the table beside each plant."""
    rows = []
    seen = values_of(next(iter(fits.values())), "measured")
    for offset, (speed, radius) in seen.items():
        told = [values_of(each, "predicted")[offset] for each in fits.values()]
        rows.append([
            f"{offset:g}", "fit" if offset in FITTED else "predicted", f"{speed:g}",
            *(off(each[0], speed) for each in told), f"{radius:.5g}",
            *(off(each[1], radius) for each in told),
        ])  # fmt: skip
    heads = ["offset", "row", "speed: Table 8 (m/s)", *fits, "radius: Table 8 (m)", *fits]
    return table(heads, rows)


def pairs_table(fits: dict[str, FitFile]) -> str:
    """Return means over ±offset."""
    rows = []
    seen = values_of(next(iter(fits.values())), "measured")

    def mean(of: dict[float, tuple[float, float]], offset: float, which: int) -> float:
        return (of[offset][which] + of[-offset][which]) / 2

    for offset in sorted(each for each in seen if each > 0):
        cells = []
        for which in (0, 1):
            held = mean(seen, offset, which)
            spread = abs(seen[offset][which] - seen[-offset][which]) / 2 / held
            cells += [f"{held:.4g} ± {100 * spread:.0f} %"]
            cells += [off(mean(values_of(each, "predicted"), offset, which), held) for each in fits.values()]
        rows.append([f"±{offset:g}", "fit" if offset in FITTED else "predicted", *cells])
    heads = ["offsets", "rows", "mean speed: Table 8 (m/s)", *fits, "mean radius: Table 8 (m)", *fits]
    return table(heads, rows)


def width(of: dict[str, float]) -> float:
    return of["right_m"] - of["left_m"]


def picture(fits: dict[str, FitFile]):
    """Return speed and curvature against offset: fitted rows filled, predicted ones open."""
    from matplotlib.figure import Figure

    from srs_twin.viewing.plots.style import style_of

    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    panels = figure.subplots(1, 2)
    seen = values_of(next(iter(fits.values())), "measured")
    for which, (axes, label) in enumerate(zip(panels, ("speed (m/s)", "radius (m)"), strict=True)):
        for index, (plant, each) in enumerate(fits.items()):
            told, style = values_of(each, "predicted"), style_of(plant, index)
            offsets = np.array([offset for offset in told if which == 0 or offset != 0])
            for side in (offsets < 0, offsets > 0) if which else (offsets < 9,):
                axes.plot(
                    offsets[side], [told[offset][which] for offset in offsets[side]], style.dash,
                    color=style.color, label=plant if side[0] else None, marker=".",
                )  # fmt: skip
        for offset, values in seen.items():
            face = "black" if offset in FITTED else "white"
            axes.plot(offset, values[which], "o", color="black", markerfacecolor=face, zorder=3)
        for face, text in (("black", "Table 8, fitted"), ("white", "Table 8, predicted")):
            axes.plot([], [], "o", color="black", markerfacecolor=face, label=text)
        axes.set_xlabel("offset (positive to the left)")
        axes.set_ylabel(label)
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
    panels[0].legend(fontsize=8, frameon=False, loc="lower left")
    return figure


if __name__ == "__main__":
    main()
