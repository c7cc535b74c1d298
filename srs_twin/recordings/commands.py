"""Commands `srs-twin inspect` and `srs-twin export`, and options for recordings."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from srs_twin.cli.console import say
from srs_twin.cli.options import (
    JsonOption,
    OverwriteOption,
    QuietOption,
    argument,
    option,
    print_json,
)
from srs_twin.errors import InputError, UnknownNameError

if TYPE_CHECKING:
    from srs_twin.recordings.inspection import Scene
    from srs_twin.recordings.takes import RecordingReader
    from srs_twin.robot.spec import Geometry
    from srs_twin.trajectory import Trajectory


ValvesOption = Annotated[
    list[str] | None,
    option(
        "--valves LOG",
        "Log of valve states or pressures. Repeat the option for each FILE, and then"
        " for each --validate file. [default: NAME.valves.csv in the folder of the"
        " recording]",
    ),
]


OffsetOption = Annotated[
    float | None,
    option(
        "--offset S",
        "Clock offset in seconds that is added to the times of the logs. [default:"
        " estimated]",
    ),
]


FrequencyOption = Annotated[
    float | None,
    option(
        "--frequency HZ",
        "Gait frequency in Hz. [default: computed from the valve pattern]",
    ),
]


@dataclass(frozen=True)
class TableOptions:
    """Options for information that a file lacks or that cannot be detected.

    Options:
        map: YAML file (recording map) that states what the markers and columns of the
            recording mean (see docs/recordings.md).
        units: Unit of length if the file does not state one: m, cm, mm, in or ft.
        rate_hz: Frame rate in Hz if the file contains no times.
        columns: Column names of a text file without a header, for example time,x_1,y_1.
        separator: Cell separator of a text file: a comma, a semicolon, a vertical bar
            (|), or the word tab or space. [default: detected]
        decimal: Decimal mark of a text file: a point or a comma. [default: detected]
    """

    map: Annotated[str | None, option("--map FILE.yaml")] = None
    units: Annotated[str | None, option("--units UNIT")] = None
    rate_hz: Annotated[float | None, option("--rate HZ")] = None
    columns: Annotated[str | None, option("--columns NAMES")] = None
    separator: Annotated[str | None, option("--separator CHARACTER")] = None
    decimal: Annotated[str | None, option("--decimal CHARACTER")] = None

    def map_data(self, markers: Sequence[str] = ()) -> dict[str, object]:
        """Return the map as plain data, including the values of the other options."""
        from srs_twin.recordings.recording_map import given_map, read_map

        options = {field.name: getattr(self, field.name) for field in _TABLE_FIELDS}
        data = given_map(options.pop("map"), options, markers)
        for key, value in options.items():
            if value is not None:
                read_map({key: data[key]}, f"--{key.removesuffix('_hz')}")
        return data


_TABLE_FIELDS = fields(TableOptions)


@dataclass(frozen=True)
class ReadingOptions(TableOptions):
    """Options that set the attributes of `RecordingReader`.

    Options:
        up: Axis of the file that points up: x, y, z, -x, -y or -z, or auto to detect
            the axis.
        layout: Arrangement of the markers on the body: single, head, pair, middles or
            head_middles (see docs/recordings.md), or auto to detect the arrangement.
        head: Name of the marker at the head. [default: the marker at the end that leads
            the motion]
        longest_gap_s: Maximum duration in seconds of a marker gap that is interpolated,
            from the last detection before the gap to the first one after it. [default:
            0.2]
        marker: Position of a marker on the body, for example "tip=connector 3" or
            "m1=middle 1". Repeat the option for each marker.
    """

    up: Annotated[str, option("--up AXIS")] = "auto"
    layout: Annotated[str, option("--layout NAME")] = "auto"
    head: Annotated[str | None, option("--head MARKER")] = None
    longest_gap_s: Annotated[float | None, option("--longest-gap S")] = None
    marker: Annotated[list[str] | None, option("--marker NAME=PLACE")] = None

    def given(self) -> dict[str, Any]:
        """Return the given options, keyed by attribute of `RecordingReader`."""
        names = ("up", "layout", "head", "longest_gap_s")
        values = {name: getattr(self, name) for name in names}
        values["map"] = self.map_data(self.marker or ()) or None
        return {name: value for name, value in values.items() if value is not None}

    def reader(self, **more: Any) -> RecordingReader:
        """Return a reader of recordings with these options."""
        from srs_twin.recordings.recording_map import read_map
        from srs_twin.recordings.takes import RecordingReader

        given = self.given()
        return RecordingReader(
            **given | {"map": read_map(given.get("map", {}))}, **more
        )


_DEFAULT_TABLE = TableOptions()


def inspect(
    files: Annotated[
        list[str], argument("FILE", "Files to describe: recordings or logs.")
    ],
    robot: Annotated[str | None, option("--robot -r ROBOT")] = None,
    table: TableOptions = _DEFAULT_TABLE,
    picture: Annotated[str | None, option("--picture FILE.png")] = None,
    write_map: Annotated[str | None, option("--write-map FILE.yaml")] = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Describe recordings and propose a recording map.

    The command needs neither a robot nor a log. With --robot, the output also states
    whether the files can be read as recordings or logs of this robot.

    Options:
        robot: Name of a shipped robot or path of a robot file. The recordings are
            checked against this robot.
        picture: Draw the markers from above and write the picture to this file. With
            several recordings, the name of each picture begins with the name of the
            recording.
        write_map: Write the proposed recording map to this file.
    """
    from srs_twin.io.files import escape_unprintable, write_text
    from srs_twin.recordings.facts import in_words, proposed_map
    from srs_twin.recordings.inspection import inspect_file
    from srs_twin.recordings.recording_map import read_map
    from srs_twin.robot.file import load_robot

    common_map = read_map(table.map_data())
    spec = None if robot is None else load_robot(robot)
    _check_outputs(picture, write_map, overwrite=overwrite)
    found = []
    failed = []
    for path in files:
        beside = Path(path).with_suffix(MAP_SUFFIX)
        is_mcap = Path(path).suffix.lower() == ".mcap"
        try:
            recording_map = common_map
            if table.map is None and is_mcap and beside.is_file():
                say(f"using the recording map {beside}")
                own = replace(table, map=str(beside))
                recording_map = read_map(own.map_data())
            facts, scene = inspect_file(path, recording_map, spec)
        except InputError as error:
            named = Path(path).name in str(error)
            failed.append(str(error) if named else f"{path}: {error}")
            continue
        found.append(facts)
        if not as_json:
            print(escape_unprintable(in_words(facts), keep="\n"))
        if picture is not None and scene is not None:
            place = Path(picture)
            if len(files) != 1:
                place = place.with_name(f"{Path(path).stem}_{place.name}")
            _save_picture(scene, place)
    if as_json:
        print_json([facts.document() for facts in found])
    if write_map is not None and found:
        write_text(Path(write_map), proposed_map(found))
        say(f"proposed map in {write_map}")
    if failed:
        raise InputError("\n".join(failed))


def _check_outputs(
    picture: str | None, write_map: str | None, *, overwrite: bool
) -> None:
    from srs_twin.io.files import check_output_folder

    for name, target in (("--picture", picture), ("--write-map", write_map)):
        if target is not None:
            check_output_folder(Path(target).parent, (Path(target).name,), option=name)
    if write_map is not None:
        _check_new(Path(write_map), overwrite=overwrite)


def _check_new(path: Path, *, overwrite: bool) -> None:
    from srs_twin.io.files import display_path

    if os.path.lexists(path) and not overwrite:
        raise InputError(
            f"{display_path(path)} already exists; replace it with --overwrite, or give"
            " another name"
        )


def _save_picture(scene: Scene, path: Path) -> None:
    from srs_twin.recordings.inspection import markers_view
    from srs_twin.viewing.plots.style import own_settings, save

    with own_settings():
        save(markers_view(scene), path)
    say(f"picture in {path}")


_FORMATS = ("mcap", "csv", "npz")

MAP_SUFFIX = ".map.yaml"
"""Suffix of the recording map that `export` writes next to an MCAP file."""

_LAYOUT_SUFFIX = ".foxglove.json"


@dataclass(frozen=True)
class FormatOptions:
    """Format of an exported file.

    Options:
        mcap: Write ROS 2 messages for Foxglove, PlotJuggler and ros2 bag.
        csv: Write the columns of the trajectory in SI units as a CSV table.
        npz: Write the columns of the trajectory in SI units as a NumPy archive.
    """

    mcap: Annotated[bool, option("--mcap")] = False
    csv: Annotated[bool, option("--csv")] = False
    npz: Annotated[bool, option("--npz")] = False

    def chosen(self, out: str | None) -> str:
        """Return the chosen format, or the format that the suffix of `out` implies."""
        names = [name for name, chosen in vars(self).items() if chosen]
        if not names and out:
            suffix = Path(out).suffix
            if suffix[1:] not in _FORMATS:
                raise InputError(
                    f"{out}: the suffix '{suffix}' is unknown; the name must end in"
                    f" .{', .'.join(_FORMATS)}"
                )
            names = [suffix[1:]]
        if len(names) != 1:
            raise InputError(
                f"give exactly one of the output formats --{', --'.join(_FORMATS)}"
            )
        return names[0]


_BY_SUFFIX = FormatOptions()


def export(
    run: Annotated[str, argument("RUN")],
    file: Annotated[str | None, argument("FILE")] = None,
    form: FormatOptions = _BY_SUFFIX,
    plant: Annotated[str | None, option("--plant NAME")] = None,
    out: Annotated[str | None, option("--out FILE")] = None,
    overwrite: OverwriteOption = False,
    quiet: QuietOption = False,
) -> None:
    """Export a run as MCAP (ROS 2), CSV or NumPy archive.

    An MCAP file contains the trajectories of all models in the run. Next to an MCAP
    file, the command also writes a Foxglove layout and a recording map for `inspect`
    and `replay`.

    Options:
        run: Folder of a run, or name of a folder in runs/.
        file: Output file, as an alternative to --out. The suffix of the file selects
            the format.
        plant: Trajectory to export: analytical, twin or measured. [default: all
            trajectories in an MCAP file, only the twin in other files]
        out: Output file. [default: a file in the folder of the run, such as
            RUN/twin.csv or RUN/run.mcap]
    """
    from srs_twin.experiment import load_run
    from srs_twin.io.files import check_output_folder, display_path

    if file and Path(run).suffix[1:] in _FORMATS:
        run, file = file, run
    if file and out:
        raise InputError(
            f"FILE {file} and --out {out} both name the output; remove one of them"
        )
    out = out or file
    kind = form.chosen(out)
    finished = load_run(run)
    runs = dict(finished.trajectories)
    if plant is not None:
        if plant not in runs:
            raise UnknownNameError("plant", plant, runs)
        runs = {plant: runs[plant]}
    first = "twin" if "twin" in runs else next(iter(runs))
    default = "run" if kind == "mcap" else first
    path = Path(out) if out else finished.folder / f"{default}.{kind}"
    if path.suffix != f".{kind}":
        raise InputError(
            f"{path.name}: the name of a file for --{kind} must end in .{kind}"
        )
    targets = [path]
    if kind == "mcap":
        targets += [path.with_suffix(MAP_SUFFIX), path.with_suffix(_LAYOUT_SUFFIX)]
    for target in targets:
        _check_new(target, overwrite=overwrite)
    check_output_folder(path.parent, tuple(target.name for target in targets))
    from srs_twin.recordings import export as exporting

    if kind == "mcap":
        _write_mcap(path, runs, first, finished.scenario.robot.geometry)
    elif kind == "csv":
        exporting.write_csv(path, runs[first])
    else:
        exporting.write_npz(path, runs[first])
    say(f"wrote {', '.join(map(display_path, targets))}", quiet=quiet)


def _write_mcap(
    path: Path, runs: Mapping[str, Trajectory], first: str, geometry: Geometry
) -> None:
    from srs_twin.io.documents import dump_yaml
    from srs_twin.io.files import write_text
    from srs_twin.recordings import export as exporting

    exporting.write_mcap(path, runs, geometry)
    recording_map = exporting.recording_map(first, runs[first])
    write_text(path.with_suffix(MAP_SUFFIX), dump_yaml(recording_map))
    layout = json.dumps(exporting.foxglove_layout(runs), indent=2)
    write_text(path.with_suffix(_LAYOUT_SUFFIX), layout + "\n")
