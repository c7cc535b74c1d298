"""What a lab recorded, as trajectories: readers, markers to body, logs, one clock."""

from srs_twin.extensions import lazy

__getattr__ = lazy(
    {
        "join": "srs_twin.recordings.signals.clock:join",
        "read_motion": "srs_twin.recordings.recording:read_motion",
        "read_valves": "srs_twin.recordings.signals.logs:read_valves",
    }
)
