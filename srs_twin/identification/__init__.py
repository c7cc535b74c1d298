"""Identification of a robot from runs, measurements and recordings.

`read_motion` reads motion capture, `read_valves` logs of valves or pressures, and `join` puts both on one
clock. `footprint.footprint_study` measures footprints.
"""

from __future__ import annotations

from srs_twin.recordings.body.trajectories import LogSummary
from srs_twin.recordings.recording import Recording, read_motion
from srs_twin.recordings.signals.clock import join
from srs_twin.recordings.signals.logs import read_valves
from srs_twin.recordings.signals.valve_log import ValveLog

__all__ = ["LogSummary", "Recording", "ValveLog", "join", "read_motion", "read_valves"]
