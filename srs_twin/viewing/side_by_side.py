"""Several recordings in one, beneath their names, with a blueprint that shows them side by side."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import rerun as rr

from srs_twin.errors import InputError
from srs_twin.files import atomic_write
from srs_twin.viewing.blueprint import Layout, side_by_side_blueprint
from srs_twin.viewing.rerun_log import APPLICATION, send_blueprint
from srs_twin.viewing.viewer import verify_recording

if TYPE_CHECKING:
    from rerun.chunk import Chunk


@dataclass(frozen=True)
class _Part:
    """One of the recordings.

    Attributes:
        name: what it is called.
        chunks: all that it holds.
    """

    name: str
    chunks: tuple[Chunk, ...]

    @property
    def root(self) -> str:
        """The entity that everything of it lies beneath."""
        return rr.escape_entity_path_part(self.name)

    @property
    def snakes(self) -> list[str]:
        """Names under world/ of what has a centre of mass."""
        paths = (chunk.entity_path.split("/") for chunk in self.chunks)
        return list(dict.fromkeys(path[2] for path in paths if path[1::2] == ["world", "com"]))

    def first(self, entity: str, component: str) -> np.ndarray:
        """Return the first row of a component with points, shape (n, 3)."""
        for chunk in self.chunks:
            if chunk.entity_path == entity and not chunk.is_static:
                batch = chunk.to_record_batch()
                if component in batch.schema.names:
                    points = batch.column(component)[0].values.flatten()
                    return np.asarray(points.to_numpy(zero_copy_only=False)).reshape(-1, 3)
        raise InputError(f"{self.name}: not a recording of srs-twin (it has no {component} at {entity})")

    def layout(self) -> Layout:
        """Return where the eye is to be."""
        snakes = self.snakes
        if not snakes:
            raise InputError(f"{self.name}: not a recording of srs-twin (no snake is in it)")
        followed = "twin" if "twin" in snakes else snakes[0]
        connectors = self.first(f"/world/{followed}/connectors", "Boxes3D:centers")[:, :2]
        along = connectors[0] - connectors[-1]
        return Layout(
            plants=snakes,
            segments=len(connectors) - 1,
            start=self.first(f"/world/{followed}/com", "Points3D:positions")[0, :2],
            heading=float(np.arctan2(along[1], along[0])),
            body_length=float(np.hypot(*along)),
            period=None,
            compared=False,
            root=self.root,
        )


def write_side_by_side(path: str | Path, recordings: Mapping[str, Path]) -> None:
    """Write one recording of several: each on a floor of its own, above its speed and heading.

    Args:
        path: file to write.
        recordings: name → file of `write_recording`; names differ.

    Raises:
        InputError: one of them is none, or the file cannot be written.
    """
    from rerun.chunk import RrdReader

    parts = []
    for name, recording in recordings.items():
        verify_recording(recording)
        reader = RrdReader(recording)
        (stored, *_) = reader.recordings()
        # Properties tell of the recording as a whole.
        chunks = (c for c in reader.stream(store=stored).to_chunks() if not c.entity_path.startswith("/__"))
        parts.append(_Part(name, tuple(chunks)))
    log = rr.RecordingStream(APPLICATION)
    memory = log.memory_recording()
    send_blueprint(log, side_by_side_blueprint({part.name: part.layout() for part in parts}))
    log.send_recording_name(" | ".join(recordings))
    for part in parts:
        log.send_chunks([chunk.with_entity_path(f"/{part.root}{chunk.entity_path}") for chunk in part.chunks])
    content: bytes = memory.drain_as_bytes()
    log.disconnect()
    with atomic_write(path) as beside:
        beside.write_bytes(content)
    rr.bindings.flush_and_cleanup_orphaned_recordings()
