"""Recordings and their logs, for parameter fits and replay scenarios.

By default, the log of ``walk.csv`` is ``walk.valves.csv`` in the same folder.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

from srs_twin.control.base import Controller
from srs_twin.control.replay import Replay, layouts_for
from srs_twin.errors import InputError, UnknownNameError
from srs_twin.io.documents import Document
from srs_twin.pneumatics import Pneumatics
from srs_twin.recordings.body.floor import Up
from srs_twin.recordings.body.layout import Layout
from srs_twin.recordings.formats import BAG_SUFFIXES
from srs_twin.recordings.recorded_pressures import RecordedPressures
from srs_twin.recordings.recording import LONGEST_GAP, Recording, ValveLog, read_motion
from srs_twin.recordings.recording_map import NO_MAP, RecordingMap
from srs_twin.recordings.signals.clock import join
from srs_twin.recordings.signals.logs import (
    is_bend_log,
    on_bench,
    read_bends,
    read_valves,
)
from srs_twin.robot.spec import RobotSpec
from srs_twin.scenario.controllers import ControllerContext, ControllerSection
from srs_twin.scenario.fields import (
    Contradiction,
    ExtensionSection,
    FilePath,
    FileSections,
    Line,
    Loading,
    SectionEntry,
    constructor_default,
    quantity,
)
from srs_twin.trajectory import Trajectory

_LOG = ".valves.csv"
NO_MARKERS = "bends alone do not determine where a robot crawls; record markers"
_ROUNDING_S = 1e-6
Result = TypeVar("Result")


@dataclass(frozen=True)
class RecordingReader:
    """Reader that applies common settings to recordings and logs.

    Attributes that are not listed here are arguments of `read_motion`.

    Attributes:
        offset_s: clock offset added to the times of the log, s, or None to estimate it.
        gait_frequency_hz: gait frequency, Hz, or None to compute it from the valve
            states.
    """

    up: str = "auto"
    layout: str = "auto"
    head: str | None = None
    map: RecordingMap = NO_MAP
    longest_gap_s: float = LONGEST_GAP
    offset_s: float | None = None
    gait_frequency_hz: float | None = None

    def motion(
        self, path: str, spec: RobotSpec, frequency: float | None = None
    ) -> Recording:
        """Read a motion capture file with `read_motion`.

        `frequency` is the gait frequency (Hz) that is used if `gait_frequency_hz` is
        None.
        """
        settings = {**vars(self), "gait_frequency_hz": self._frequency_or(frequency)}
        del settings["offset_s"]
        return read_motion(path, spec, **settings)

    def body(
        self, path: str, spec: RobotSpec, frequency: float | None = None
    ) -> Recording:
        """Read a motion from a motion capture file or a bend log."""
        if not is_bend_log(path, self.map):
            return self.motion(path, spec, frequency)
        return read_bends(
            path,
            spec,
            map=self.map,
            longest_gap_s=self.longest_gap_s,
            gait_frequency_hz=self._frequency_or(frequency),
        )

    def _frequency_or(self, other: float | None) -> float | None:
        if self.gait_frequency_hz is None:
            return other
        return self.gait_frequency_hz

    def joined(
        self, body: Recording, log: ValveLog, spec: RobotSpec, *, one_file: bool
    ) -> Recording:
        """Synchronise a motion with a log.

        If the motion and the log are in one file, the clock offset is 0 by default.
        """
        offset = 0.0 if one_file and self.offset_s is None else self.offset_s
        return join(body, log, spec, offset=offset)

    def take(self, path: str, valves: str, spec: RobotSpec) -> Recording:
        """Read a recording and its log, and synchronise their clocks."""
        try:
            log = read_valves(valves, spec, self.map)
        except InputError:
            # Errors in the motion are reported first, because the path of the motion
            # determines the default path of the log.
            self.body(path, spec)
            raise
        return self.joined(
            self.body(path, spec, log.gait_frequency()),
            log,
            spec,
            one_file=path == valves,
        )


def logs_of(takes: Sequence[str], given: Sequence[str]) -> list[str]:
    """Return the log path of each recording.

    `given` contains the log paths in the order of the recordings, or is empty to select
    the default paths.
    """
    if not given:
        return [default_log(take) for take in takes]
    if len(given) != len(takes):
        wanted = f"give one for each recording, in the same order ({', '.join(takes)})"
        otherwise = f"or none if each log is beside its recording and named NAME{_LOG}"
        raise InputError(
            f"{len(given)} valve logs are given for {len(takes)} recordings; {wanted},"
            f" {otherwise}"
        )
    return list(given)


def default_log(motion: str) -> str:
    """Return the default log path of a recording."""
    take = Path(motion)
    if not take.name:
        return str(take)  # an empty path would mean the current folder
    beside = take.with_name(take.stem + _LOG)
    own = take.suffix.lower() in BAG_SUFFIXES or take.is_dir()
    return str(take if own and not os.path.lexists(beside) else beside)


class ReplayFile(ControllerSection):
    """Controller that replays the valve states or pressures of a recording."""

    kind: Literal["replay"]
    """Kind of controller."""

    def contradictions_with(self, file: FileSections) -> Iterator[Contradiction]:
        """See `ControllerSection.contradictions_with`."""
        if file.section("recording") is None:
            yield Contradiction(
                ("controller",),
                "`kind: replay` needs a recording; add the section `recording`",
            )

    def is_ready(self, products: Mapping[str, object]) -> bool:
        """See `ControllerSection.is_ready`."""
        return products.get("recording") is not None

    def layouts(self, products: Mapping[str, object]) -> tuple[str, ...]:
        """See `ControllerSection.layouts`."""
        recording = products.get("recording")
        if not isinstance(recording, Recording):
            return ()
        return layouts_for(recording.commands(self.kind).states)

    def controller(self, context: ControllerContext) -> Controller:
        """See `ControllerSection.controller`."""
        recording: Recording = context.products["recording"]
        return Replay(
            recording.commands(context.name),
            recording.trajectory.metadata.get("gait_frequency_hz"),
        )


class RecordingFile(ExtensionSection):
    """Recorded robot motion and the log that belongs to it (docs/recordings.md)."""

    constructors = (RecordingReader,)
    measures = True

    motion: FilePath
    """Motion capture file (docs/recordings.md#file-formats), or CSV file with the
    columns time,bend_1,… for a robot on a bench."""
    valves: FilePath | None = None
    """Log of valve states or pressures in a plain CSV file or a bag (default:
    NAME.valves.csv in the folder of the recording)."""
    offset_s: float | None = quantity(-1e9, 1e9)
    """Clock offset that is added to the times of the log (default: estimated)."""
    gait_frequency_hz: float | None = quantity(0.01, 50.0)
    """Gait frequency (default: computed from the valve states)."""
    up: Literal["auto", Up] = constructor_default()
    """Axis of the file that points up."""
    layout: Literal["auto", Layout] = constructor_default()
    """Layout of the markers on the body."""
    map: RecordingMap = constructor_default()
    """Recording map with the meaning of markers, rigid bodies and columns
    (docs/recordings.md#recording-map)."""
    head: Line | None = constructor_default()
    """Column name of the marker at the head (default: the marker at the end that leads
    the motion)."""
    longest_gap_s: float = quantity(0.0, 10.0)
    """Maximum duration of a gap in the data that is interpolated."""

    def contradictions_with(self, file: FileSections) -> Iterator[Contradiction]:
        """See `ExtensionSection.contradictions_with`."""
        if not isinstance(file.controller, ReplayFile):
            yield Contradiction(
                ("recording",),
                "the recording is not used; replay it with `controller.kind: replay`",
                at_key=True,
            )

    def read(self, loading: Loading) -> Recording | None:
        """See `ExtensionSection.read`."""
        recording = self._recording(loading)
        if recording is not None:
            loading.warnings += self._check(loading.document, loading.file, recording)
        return recording

    def resolve(
        self, document: dict[str, Any], file: FileSections, product: Recording | None
    ) -> None:
        """See `ExtensionSection.resolve`."""
        if product is None:
            return
        if product.pressures() is not None:
            del document["pneumatics"]
        if not file.bench and "start" not in file.model_fields_set:
            x, y, heading = product.start_pose()
            document["start"] = {
                "x_m": x,
                "y_m": y,
                "heading_rad": math.remainder(heading, 2 * math.pi),
            }

    def chambers(
        self, product: Recording, robot: RobotSpec, supply_pa: float, layout: str
    ) -> Pneumatics | None:
        """See `ExtensionSection.chambers`."""
        recorded = product.pressures()
        return recorded and RecordedPressures(
            robot, *recorded, supply_pa=supply_pa, layout=layout
        )

    def measured(self, product: Recording) -> Trajectory:
        """See `ExtensionSection.measured`."""
        return product.trajectory

    def _recording(self, loading: Loading) -> Recording | None:
        document = loading.document
        file = loading.file
        reader = self.build()
        spec = loading.robot.spec(file.seed)
        path = self.valves or default_log(self.motion)
        log = _read(document, "valves", lambda: read_valves(path, spec, self.map))
        frequency = log.gait_frequency() if log else None
        body = _read(
            document, "motion", lambda: reader.body(self.motion, spec, frequency)
        )
        if body is None or log is None:
            return None
        if not file.bench and body.only_bends:
            document.report(
                ("recording", "motion"), f"{NO_MARKERS}, or set `bench: true`"
            )
            return None
        joined = _read(
            document,
            "offset_s",
            lambda: reader.joined(body, log, spec, one_file=path == self.motion),
        )
        if joined is None or not file.bench:
            return joined
        return _read(document, "motion", lambda: on_bench(joined, spec))

    def _check(
        self, document: Document, file: FileSections, recording: Recording
    ) -> list[str]:
        time = recording.trajectory.time
        span = float(time[-1] - time[0])
        if file.duration_s > span + _ROUNDING_S:
            document.report(
                ("duration_s",),
                f"{file.duration_s:g} s is longer than the recording, which lasts"
                f" {span:.4g} s",
            )
        if recording.pressures() is not None and "pneumatics" in file.model_fields_set:
            text = "the recorded pressures replace this section; remove it"
            document.report(("pneumatics",), text, at_key=True)
        if recording.starts_at_rest():
            return []
        return [
            "recording: some chambers hold air at the start, but the plants begin"
            " straight and at rest"
        ]


def _read(document: Document, key: str, read: Callable[[], Result]) -> Result | None:
    try:
        return read()
    except UnknownNameError as error:
        # An unknown name refers to a marker or column, not to a missing file.
        document.report(
            ("recording", "head" if document.get("recording", "head") else "map"),
            str(error),
        )
    except InputError as error:
        document.report(("recording", key), str(error))
    return None


def _input_files(section: Mapping[str, object]) -> Iterator[str]:
    motion = str(section.get("motion"))
    yield motion
    yield str(section.get("valves") or default_log(motion))


RECORDING = SectionEntry(
    RecordingFile | None,
    "Measurements of the robot that are replayed and compared with the plants"
    " (controller.kind: replay).",
    _input_files,
    {"motion": "", "valves": ""},
)
