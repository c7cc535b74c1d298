"""What is known of a robot from runs, measurements and its own recordings.

`read_motion` reads what cameras saw of it, `read_valves` what was done to its air, `join` puts both on one
clock. `footprint.measure_footprint` finds what it sweeps.
"""

from __future__ import annotations

from srs_twin.identification.joining import join
from srs_twin.identification.recording import Recording, read_motion
from srs_twin.identification.summary import LogSummary
from srs_twin.identification.valve_log import ValveLog, read_valves

__all__ = ["LogSummary", "Recording", "ValveLog", "join", "read_motion", "read_valves"]
