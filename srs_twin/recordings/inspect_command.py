"""`srs-twin inspect`: description of recordings, without a robot or a log."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

from srs_twin.cli.console import say
from srs_twin.cli.options import JsonOption, OverwriteOption, argument, option, print_json
from srs_twin.errors import InputError


def inspect(
    files: Annotated[list[str], argument("FILE", "Recordings of markers, or logs.")],
    robot: Annotated[str | None, option("--robot -r ROBOT")] = None,
    map: Annotated[str | None, option("--map FILE.yaml")] = None,
    units: Annotated[str | None, option("--units UNIT")] = None,
    rate: Annotated[float | None, option("--rate HZ")] = None,
    columns: Annotated[str | None, option("--columns NAMES")] = None,
    separator: Annotated[str | None, option("--separator CHARACTER")] = None,
    decimal: Annotated[str | None, option("--decimal CHARACTER")] = None,
    picture: Annotated[str | None, option("--picture FILE.png")] = None,
    write_map: Annotated[str | None, option("--write-map FILE.yaml")] = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Describe recordings and propose a map.

    A robot or a log is not needed. With a robot, the output also states whether the files can be read as its
    recording.

    Options:
        robot: Shipped robot or robot file with which the recording is checked.
        map: Recording map with the known columns and markers (docs/logs.md).
        units: Unit of lengths if the file states none: m, cm, mm, in, ft.
        rate: Frames per second if the file has no time.
        columns: Column names of a plain file without a header, e.g. time,x_1,y_1.
        separator: Cell separator of a plain file: , ; | tab or space. [default: detected]
        decimal: Decimal mark of a plain file. [default: detected]
        picture: Output picture of the markers from above; with several files, the name of each is put in
            front.
        write_map: File for the proposed map.
    """
    from srs_twin.io.files import check_output_folder, escape_unprintable, write_text
    from srs_twin.recordings.facts import in_words, proposed_map
    from srs_twin.recordings.inspection import inspect_file
    from srs_twin.recordings.recording_map import given_map, read_map
    from srs_twin.robot.file import load_robot

    options = {"units": units, "rate_hz": rate}
    options |= {"columns": columns, "separator": separator, "decimal": decimal}
    known = read_map(given_map(map, options, ()) or {})
    spec = None if robot is None else load_robot(robot)
    for name, target in (("--picture", picture), ("--write-map", write_map)):
        if target is not None:
            check_output_folder(Path(target).parent, (Path(target).name,), option=name)
    if write_map is not None and os.path.lexists(write_map) and not overwrite:
        raise InputError(f"{write_map}: exists; give --overwrite, or another name")
    found, failed = [], []
    for path in files:
        try:
            facts, scene = inspect_file(path, known, spec)
        except InputError as error:
            said = str(error)
            failed.append(said if Path(path).name in said else f"{path}: {said}")
            continue
        found.append(facts)
        if not as_json:
            print(escape_unprintable(in_words(facts), keep="\n"))
        if picture is not None and scene is not None:
            from srs_twin.recordings.pictures import markers_view
            from srs_twin.viewing.plots.style import save

            place = Path(picture)
            place = place if len(files) == 1 else place.with_name(f"{Path(path).stem}_{place.name}")
            save(markers_view(scene), place)
            say(f"picture in {place}")
    if as_json:
        print_json([facts.document() for facts in found])
    if write_map is not None and found:
        write_text(Path(write_map), proposed_map(found))
        say(f"proposed map in {write_map}")
    if failed:
        raise InputError("\n".join(failed))
