"""`srs-twin export`: a run for other tools."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

from srs_twin.cli.console import say
from srs_twin.cli.options import OverwriteOption, QuietOption, argument, option
from srs_twin.errors import InputError, UnknownNameError

_FORMATS = ("mcap", "csv", "npz")


def export(
    run: Annotated[str, argument("RUN")],
    mcap: Annotated[bool, option("--mcap")] = False,
    csv: Annotated[bool, option("--csv")] = False,
    npz: Annotated[bool, option("--npz")] = False,
    plant: Annotated[str | None, option("--plant NAME")] = None,
    out: Annotated[str | None, option("--out FILE")] = None,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
) -> None:
    """Write a run as MCAP (ROS 2), CSV or NumPy archive.

    MCAP holds all plants. A recording map, with which `inspect` and `replay` read the file, and a Foxglove
    layout are written next to it.

    Options:
        run: Folder of a run, or its name in ./runs.
        mcap: ROS 2 messages, for Foxglove, PlotJuggler and ros2 bag.
        csv: Columns of the trajectory in SI units.
        npz: Columns of the trajectory as a NumPy archive.
        plant: analytical, twin or measured. [default: all in MCAP, else the twin]
        out: File to write. [default: RUN/twin.csv, RUN/run.mcap]
    """
    from srs_twin.experiment import load_run
    from srs_twin.io.files import check_output_folder, display_path, write_text

    chosen = [name for name, wanted in zip(_FORMATS, (mcap, csv, npz), strict=True) if wanted]
    if len(chosen) != 1:
        raise InputError(f"give one format: --{', --'.join(_FORMATS)}")
    (kind,) = chosen
    finished = load_run(run)
    runs = dict(finished.trajectories)
    if plant is not None:
        if plant not in runs:
            raise UnknownNameError("plant", plant, runs)
        runs = {plant: runs[plant]}
    first = "twin" if "twin" in runs else next(iter(runs))
    path = Path(out) if out else finished.folder / f"{'run' if kind == 'mcap' else first}.{kind}"
    if path.suffix != f".{kind}":
        raise InputError(f"{path.name}: a file of --{kind} ends in .{kind}")
    beside = [path.with_suffix(".map.yaml"), path.with_suffix(".foxglove.json")] if kind == "mcap" else []
    for target in (path, *beside):
        if target.exists() and not overwrite:
            raise InputError(f"{display_path(target)} exists; --overwrite replaces it")
    check_output_folder(path.parent, tuple(target.name for target in (path, *beside)))
    from srs_twin.recordings import export as exporting

    if kind == "csv":
        exporting.write_csv(path, runs[first])
    elif kind == "npz":
        exporting.write_npz(path, runs[first])
    else:
        from ruamel.yaml import YAML

        exporting.write_mcap(path, runs)
        with beside[0].open("w", encoding="utf-8") as file:
            YAML(typ="safe").dump(exporting.recording_map(first, runs[first]), file)
        write_text(beside[1], json.dumps(exporting.foxglove_layout(runs), indent=2) + "\n")
    say(f"wrote {', '.join(display_path(target) for target in (path, *beside))}", quiet=quiet)
