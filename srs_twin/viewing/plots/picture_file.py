"""Figures as image files."""

from __future__ import annotations

from pathlib import Path

from matplotlib import rc_context
from matplotlib.figure import Figure

from srs_twin.errors import InputError
from srs_twin.io.files import atomic_write

FORMATS = (".png", ".svg")


def save(figure: Figure, path: str | Path) -> None:
    """Write a figure as PNG or SVG atomically; equal figures give equal bytes.

    Args:
        figure: figure.
        path: output file; its suffix selects the format.

    Raises:
        InputError: the suffix is not supported, or the file cannot be written.
    """
    target = Path(path)
    if target.suffix not in FORMATS:
        raise InputError(f"{target.name}: the name of an image must end in {' or '.join(FORMATS)}")
    metadata = {"Software": None} if target.suffix == ".png" else {"Date": None}
    with atomic_write(target) as temporary, rc_context({"svg.hashsalt": "srs-twin", "svg.fonttype": "none"}):
        figure.savefig(temporary, format=target.suffix[1:], dpi=130, metadata=metadata)
