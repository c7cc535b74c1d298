"""`srs-twin view`: look at a finished run in Rerun."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from srs_twin.errors import InputError


def view(
    run: Annotated[str, typer.Argument(metavar="RUN", help="A run folder, a recording, or a name in runs/.")],
) -> None:
    """Open the recording of a run."""
    recording = find_recording(run)
    from srs_twin.viewing.viewer import open_recording

    open_recording(recording)


def find_recording(run: str) -> Path:
    """Return the recording that a run left.

    Args:
        run: the run's folder, the recording itself, or a scenario that ran into ``./runs``.

    Raises:
        InputError: there is none.
    """
    looked = [Path(run), Path(run) / "recording.rrd", Path("runs") / run / "recording.rrd"]
    for path in looked:
        if path.is_file():
            if path.suffix != ".rrd":
                raise InputError(f"{path}: not a recording; give a run folder or a file that ends in .rrd")
            return path
    tried = ", ".join(str(path) for path in looked[1:])
    raise InputError(f"{run}: no recording there (looked for {tried}); `srs-twin run SCENARIO` makes one")
