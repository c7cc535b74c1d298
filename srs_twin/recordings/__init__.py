"""Conversion of recorded robot motion to trajectories."""

from typing import TYPE_CHECKING

from srs_twin.extensions import lazy

if TYPE_CHECKING:
    from srs_twin.recordings.recording import read_motion as read_motion
    from srs_twin.recordings.signals.clock import join as join
    from srs_twin.recordings.signals.logs import read_valves as read_valves

lazy(__name__)
