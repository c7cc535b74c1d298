"""Recordings of robots as trajectories: file formats, body shape from markers, logs, and clocks."""

from srs_twin.extensions import lazy

__getattr__ = lazy(
    {
        "join": "srs_twin.recordings.signals.clock:join",
        "read_motion": "srs_twin.recordings.recording:read_motion",
        "read_valves": "srs_twin.recordings.signals.logs:read_valves",
    }
)
