"""Write what README.md and docs/reproduction.md say of the reproduction from the committed baseline.

uv run srs-twin reproduce --write-baseline   # runs everything, writes calibration/published/baseline.json
uv run python docs/reproduction.py           # writes both pages from it
"""

from __future__ import annotations

from pathlib import Path

from srs_twin.io.files import atomic_write
from srs_twin.reproduction import Judged, load_baseline, load_claims
from srs_twin.reproduction.report import between, markdown, remembered, summary_line

ROOT = Path(__file__).parents[1]
NAME = "reproduction"


def pages(rows: tuple[Judged, ...]) -> dict[Path, str]:
    """Return both pages as they are to be."""
    texts = {ROOT / "README.md": summary_line(rows), ROOT / "docs/reproduction.md": markdown(rows)}
    return {path: between(path.read_text("utf-8"), NAME, text) for path, text in texts.items()}


def main() -> None:
    """Write both."""
    rows = remembered(load_claims(), load_baseline())
    for path, text in pages(rows).items():
        with atomic_write(path) as part:
            part.write_text(text, "utf-8")


if __name__ == "__main__":
    main()
