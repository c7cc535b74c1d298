"""Picture files."""

from __future__ import annotations

from pathlib import Path

from matplotlib import rc_context
from matplotlib.figure import Figure

from srs_twin.errors import InputError
from srs_twin.io.files import atomic_write

FORMATS = (".png", ".svg")


def save(figure: Figure, path: str | Path) -> None:
    """Write a picture as PNG or SVG, by the suffix, whole or not at all; equal ones give equal bytes.

    Raises:
        InputError: another suffix, or the place cannot be written.
    """
    target = Path(path)
    if target.suffix not in FORMATS:
        raise InputError(f"{target.name}: pictures are written as {' or '.join(FORMATS)}")
    about = {"Software": None} if target.suffix == ".png" else {"Date": None}
    with atomic_write(target) as part, rc_context({"svg.hashsalt": "srs-twin", "svg.fonttype": "none"}):
        figure.savefig(part, format=target.suffix[1:], dpi=130, metadata=about)
