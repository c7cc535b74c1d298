"""Diagram of the rooms of the package, generated from its imports.

    uv run python docs/rooms.py

A room is drawn above all rooms that it imports, including imports inside functions. An
edge is omitted if there is a longer path between its rooms.
"""

from __future__ import annotations

import ast
from pathlib import Path

import matplotlib

matplotlib.use("svg")
from matplotlib import pyplot as plt

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "srs_twin"
IMAGE = ROOT / "docs" / "images" / "rooms.svg"

CORE = {
    *(
        "errors",
        "extensions",
        "io",
        "compute",
        "robot",
        "trajectory",
        "pneumatics",
        "sensing",
        "plants",
    ),
    *(
        "control",
        "rollout",
        "comparison",
        "scenario",
        "viewing",
        "experiment",
        "attribution",
        "cli",
    ),
}
"""Rooms of the core; all other rooms are extensions."""

Rooms = dict[str, set[str]]


def rooms_of(package: Path) -> Rooms:
    """Return room → other rooms that it imports."""
    rooms: Rooms = {}
    for path in sorted(package.rglob("*.py")):
        room = path.relative_to(package).with_suffix("").parts[0]
        if room == "__init__":
            continue
        imported = rooms.setdefault(room, set())
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(
                f"{package.name}."
            ):
                imported.add(str(node.module).split(".")[1])
    return {
        room: (imported & rooms.keys()) - {room} for room, imported in rooms.items()
    }


def levels(rooms: Rooms) -> dict[str, int]:
    """Return room → layer, one above the highest layer that the room imports."""
    layers: dict[str, int] = {}

    def level(room: str) -> int:
        if room not in layers:
            layers[room] = 1 + max(map(level, rooms[room]), default=-1)
        return layers[room]

    for room in rooms:
        level(room)
    return layers


def reduced(rooms: Rooms) -> Rooms:
    """Return the transitive reduction of the imports."""

    def below(room: str) -> set[str]:
        return rooms[room].union(*map(below, rooms[room]))

    return {
        room: imported - set().union(*map(below, imported))
        for room, imported in rooms.items()
    }


def draw(rooms: Rooms, path: Path) -> None:
    """Write the diagram: one box per room, above all rooms that it imports; colours mark extensions."""
    level = levels(rooms)
    rows = [
        sorted(room for room in rooms if level[room] == k)
        for k in range(max(level.values()) + 1)
    ]
    position = {
        room: (i - (len(row) - 1) / 2, k)
        for k, row in enumerate(rows)
        for i, room in enumerate(row)
    }
    plt.rcParams |= {"svg.hashsalt": "rooms", "svg.fonttype": "none", "font.size": 9}
    figure, axes = plt.subplots(figsize=(9.0, 0.62 * len(rows) + 0.6))
    for room, imported in reduced(rooms).items():
        for other in sorted(imported):
            (x, y), (to_x, to_y) = position[room], position[other]
            axes.plot(
                (x, to_x), (y - 0.2, to_y + 0.2), color="0.75", linewidth=0.9, zorder=1
            )
    for room, (x, y) in position.items():
        face, edge = ("#eaf1f8", "#4a6d8c") if room in CORE else ("#fdf0e1", "#b5762a")
        box = {
            "boxstyle": "round,pad=0.35",
            "facecolor": face,
            "edgecolor": edge,
            "linewidth": 0.8,
        }
        axes.text(x, y, room, ha="center", va="center", bbox=box, zorder=2)
    top = max(level[room] for room in CORE) + 0.5
    axes.axhline(top, color="0.6", linewidth=0.8, linestyle="--", zorder=0)
    axes.text(-2.5, top - 0.18, "core", color="#4a6d8c", va="top")
    axes.text(-2.5, top + 0.18, "extensions", color="#b5762a", va="bottom")
    axes.set(xlim=(-2.6, 2.6), ylim=(-0.6, len(rows) - 0.4))
    axes.axis("off")
    figure.tight_layout(pad=0.2)
    figure.savefig(path, metadata={"Date": None})
    plt.close(figure)


def main() -> None:
    """Draw the rooms of srs_twin."""
    draw(rooms_of(PACKAGE), IMAGE)


if __name__ == "__main__":
    main()
