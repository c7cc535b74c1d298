"""Sections of a scenario that replay a recording."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar

from srs_twin.control.base import Controller
from srs_twin.control.replay import Replay, layouts_for
from srs_twin.errors import InputError, UnknownNameError
from srs_twin.io.documents import Document
from srs_twin.pneumatics import Pneumatics
from srs_twin.pneumatics.recorded import RecordedPressures
from srs_twin.recordings.recording import Recording
from srs_twin.recordings.recording_map import RecordingMap
from srs_twin.recordings.signals.logs import on_bench, read_valves
from srs_twin.recordings.takes import (
    NO_MARKERS,
    RecordingReader,
    commands,
    logs_of,
    only_bends,
    pressures,
    repeats,
    start_pose,
    starts_at_rest,
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

_ROUNDING_S = 1e-6
"""Largest excess of a run's duration over its recording, due to rounding, s."""
Result = TypeVar("Result")


class ReplayFile(ControllerSection):
    """Controller that replays recorded valve states or pressures; requires a recording."""

    kind: Literal["replay"]
    """Kind of controller."""

    def contradictions_with(self, file: FileSections) -> Iterator[Contradiction]:
        """See `ControllerSection.contradictions_with`."""
        if file.section("recording") is None:
            yield ("controller",), "kind: replay has nothing to replay; give recording as well", False

    def is_ready(self, products: Mapping[str, Any]) -> bool:
        """See `ControllerSection.is_ready`."""
        return products.get("recording") is not None

    def layouts(self, products: Mapping[str, Any]) -> tuple[str, ...]:
        """See `ControllerSection.layouts`."""
        recording = products.get("recording")
        return layouts_for(commands(recording, self.kind).states) if recording else ()

    def controller(self, context: ControllerContext) -> Controller:
        """See `ControllerSection.controller`."""
        recording: Recording = context.products["recording"]
        return Replay(
            commands(recording, context.name), recording.trajectory.metadata.get("gait_frequency_hz")
        )


class RecordingFile(ExtensionSection):
    """Recorded motion of a robot with its log (docs/logs.md); paths are relative to the current folder."""

    constructors = (RecordingReader,)
    measures = True

    motion: FilePath
    """Motion capture file (docs/logs.md#file-formats), or for a bench a CSV file with time,bend_1,…."""
    valves: FilePath | None = None
    """Log of valves or pressures, a plain CSV or MCAP file (default: NAME.valves.csv in the same folder)."""
    offset_s: float | None = quantity(-1e9, 1e9)
    """Clock offset added to the times of the log (default: estimated)."""
    gait_frequency_hz: float | None = quantity(0.01, 50.0)
    """Gait frequency (default: the frequency of the valve pattern)."""
    up: Literal["auto", "x", "y", "z", "-x", "-y", "-z"] = constructor_default()
    """Upward axis of the file."""
    layout: Literal["auto", "single", "head", "pair", "middles", "head_middles"] = constructor_default()
    """Marker layout."""
    map: RecordingMap = constructor_default()
    """Recording map: quantities of markers, rigid bodies and columns (docs/logs.md#recording-map)."""
    head: Line | None = constructor_default()
    """Column of the marker at the head (default: the end in the direction of motion)."""
    longest_gap_s: float = quantity(0.0, 10.0)
    """Longest gap that is interpolated."""

    def contradictions_with(self, file: FileSections) -> Iterator[Contradiction]:
        """See `ExtensionSection.contradictions_with`."""
        if not isinstance(file.controller, ReplayFile):
            yield ("recording",), "nobody replays it; set controller.kind: replay", True

    def read(self, loading: Loading) -> Recording | None:
        """See `ExtensionSection.read`."""
        recording = self._recording(loading)
        if recording is not None:
            loading.warnings += self._check(loading.document, loading.file, recording)
        return recording

    def resolve(self, document: dict[str, Any], file: FileSections, product: Recording | None) -> None:
        """See `ExtensionSection.resolve`."""
        if product is None:
            return
        # Store absolute paths, so that the run can be read from any folder.
        for key in document["recording"].keys() & {"motion", "valves"}:
            document["recording"][key] = str(Path(document["recording"][key]).resolve())
        if pressures(product) is not None:
            del document["pneumatics"]
        if not file.bench and "start" not in file.model_fields_set:
            x, y, heading = start_pose(product)
            document["start"] = {"x_m": x, "y_m": y, "heading_rad": math.remainder(heading, 2 * math.pi)}

    def chambers(
        self, product: Recording, robot: RobotSpec, supply_pa: float, layout: str
    ) -> Pneumatics | None:
        """See `ExtensionSection.chambers`."""
        recorded = pressures(product)
        return recorded and RecordedPressures(robot, *recorded, supply_pa=supply_pa, layout=layout)

    def measured(self, product: Recording) -> Trajectory:
        """See `ExtensionSection.measured`."""
        return product.trajectory

    def _recording(self, loading: Loading) -> Recording | None:
        """Return the recording joined with its log; report errors at the key of the file."""
        document, file = loading.document, loading.file
        reader, spec = self.build(), loading.robot.spec(file.seed)
        (path,) = logs_of([self.motion], [self.valves] if self.valves else [])
        log = _read(document, "valves", lambda: read_valves(path, spec, self.map))
        frequency = repeats(log) if log else None
        body = _read(document, "motion", lambda: reader.body(self.motion, spec, frequency))
        if body is None or log is None:
            return None
        if not file.bench and only_bends(body.trajectory):
            document.report(("recording", "motion"), f"{NO_MARKERS}, or bench: true")
            return None
        one_file = path == self.motion
        joined = _read(document, "offset_s", lambda: reader.joined(body, log, spec, one_file=one_file))
        if joined is None or not file.bench:
            return joined
        return _read(document, "motion", lambda: on_bench(joined, spec))

    def _check(self, document: Document, file: FileSections, recording: Recording) -> list[str]:
        """Report settings of a scenario that contradict the recording; return warnings."""
        time = recording.trajectory.time
        span = float(time[-1] - time[0])
        if file.duration_s > span + _ROUNDING_S:
            text = f"{file.duration_s:g} s is longer than the recording's {span:.4g} s"
            document.report(("duration_s",), text)
        if pressures(recording) is not None and "pneumatics" in file.model_fields_set:
            text = "the recording holds pressures, which chambers then have; take it out"
            document.report(("pneumatics",), text, at_key=True)
        if starts_at_rest(recording):
            return []
        return ["recording: it begins while chambers hold air; the plants begin straight and at rest"]


def _read(document: Document, key: str, read: Callable[[], Result]) -> Result | None:
    """Call a function that reads the file of a key; report its errors at this key."""
    try:
        return read()
    except UnknownNameError as error:
        # The file exists, so report the missing marker or column instead.
        document.report(("recording", "head" if document.get("recording", "head") else "map"), str(error))
    except InputError as error:
        document.report(("recording", key), str(error))
    return None


def _input_files(section: Mapping[str, Any]) -> Iterator[str]:
    motion, valves = str(section.get("motion")), section.get("valves")
    yield from (motion, *logs_of([motion], [valves] if valves else []))


RECORDING = SectionEntry(
    RecordingFile | None,
    "What was measured of the robot, to replay and to hold the plants against (controller.kind: replay).",
    _input_files,
)
