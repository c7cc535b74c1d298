"""A user's settings of matplotlib change no picture, and remain as they are."""

from __future__ import annotations

import ast
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest
from cycler import cycler
from matplotlib.figure import Figure
from snakes import robot

import srs_twin
from srs_twin import AnalyticalSnake, Gait, TwinSnake, compare, rollout
from srs_twin.studies.optimization.report import draw_convergence
from srs_twin.viewing.html import picture
from srs_twin.viewing.mujoco.render import write_png
from srs_twin.viewing.plots import runs as plots
from srs_twin.viewing.plots.from_above import plan_view
from srs_twin.viewing.plots.style import save

SPEC = robot()
# Each changes pictures, and TeX fails where LaTeX is not installed.
SETTINGS: dict[str, Any] = {
    "text.usetex": True,
    "font.family": "monospace",
    "font.size": 17,
    "mathtext.fontset": "stix",
    "axes.prop_cycle": cycler(color="r"),
    "figure.facecolor": "k",
    "savefig.facecolor": "y",
    "savefig.bbox": "tight",
    "savefig.pad_inches": 1,
    "savefig.dpi": 30,
    "figure.dpi": 30,
    "figure.constrained_layout.use": True,
    "image.origin": "lower",
    "axes.xmargin": 0.4,
    "axes.spines.top": False,
    "axes.formatter.limits": (0, 1),
    "xtick.direction": "in",
    "svg.fonttype": "path",
    "svg.hashsalt": "other",
    "path.simplify": False,
}


@pytest.fixture(scope="module")
def figures() -> dict[str, Callable[[], Figure]]:
    plants = (TwinSnake(SPEC), AnalyticalSnake(SPEC))
    pair = {plant.name: rollout(plant, Gait(2.0, 0.1), 0.6) for plant in plants}
    both = compare(pair["analytical"], pair["twin"])
    costs = np.array([3.0, 2.0, 4.0])
    is_valid = costs > 2
    return {
        "bends": lambda: plots.bend_plot(pair),
        "pressures": lambda: plots.pressure_plot(pair),
        "speeds": lambda: plots.speed_plot(pair),
        "difference": lambda: plots.error_plot(both, SPEC),
        "above": lambda: plan_view(pair, SPEC),
        "search": lambda: draw_convergence(
            costs, is_valid, "cost", 1.0, maximize=False
        )[0],
    }


def drawn(figures: dict[str, Callable[[], Figure]], folder: Path) -> Iterator[bytes]:
    for draw in figures.values():
        yield picture(draw(), "").source.encode()
    for suffix in (".png", ".svg"):
        save(figures["bends"](), folder / f"bends{suffix}")
        yield (folder / f"bends{suffix}").read_bytes()
    write_png(folder / "pixels.png", np.arange(48, dtype=np.uint8).reshape(4, 4, 3))
    yield (folder / "pixels.png").read_bytes()


def test_settings_of_the_user_change_no_byte_and_remain(figures, tmp_path):
    plain = list(drawn(figures, tmp_path))
    with matplotlib.rc_context(SETTINGS):
        before = dict(matplotlib.rcParams.copy())
        assert list(drawn(figures, tmp_path)) == plain
        assert dict(matplotlib.rcParams.copy()) == before


def test_every_public_function_that_returns_a_figure_draws_with_our_settings():
    # They only create empty panels, or are called within `own_settings`.
    exempt = {"panels", "side_by_side", "markers_view", "draw_figures", "figures"}
    missing = []
    for path in Path(srs_twin.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if (
                isinstance(node, ast.FunctionDef)
                and node.returns
                and "Figure" in ast.unparse(node.returns)
                and not node.name.startswith("_")
                and node.name not in exempt
                and path.parent.name != "reproduction"
                and "drawing" not in map(ast.unparse, node.decorator_list)
            ):
                missing.append(f"{path.name}: {node.name}")
    assert missing == []


BRIEF = """\
title: Brief
robot: gen2
duration_s: 0.4
controller: {kind: gait, frequency_hz: 2.0}
"""


def compared(
    command: Any, folder: Path, settings: bytes, **env: str
) -> subprocess.CompletedProcess[str]:
    folder.mkdir()
    (folder / "brief.yaml").write_text(BRIEF)
    (folder / "matplotlibrc").write_bytes(settings)
    return command(
        "compare", "brief.yaml", "--quiet", "--out", "run", cwd=folder, **env
    )


@pytest.mark.slow
def test_command_draws_the_same_with_any_readable_matplotlibrc(
    tmp_path, srs_twin_process
):
    files = {
        "none": b"",
        "hostile": (
            b"text.usetex: True\nbackend: TkAgg\nfont.family: none such\nsavefig.bbox:"
            b" tight\n"
        ),
        "broken": b"no colon\nfont.size: huge\nunknown.key: 1\n",
    }
    images = {}
    for name, settings in files.items():
        done = compared(srs_twin_process, tmp_path / name, settings, DISPLAY="")
        assert done.returncode == 0, done.stderr
        page = (tmp_path / name / "run" / "report.html").read_text("utf-8")
        images[name] = [
            part.split('"')[0] for part in page.split("data:image/svg+xml;base64,")[1:]
        ]
    assert images["none"] and images["hostile"] == images["broken"] == images["none"]


@pytest.mark.parametrize(
    ("settings", "backend"), [(b"font.family: \xff", "agg"), (b"", "nonsense")]
)
def test_settings_that_matplotlib_refuses_are_an_input_error(
    settings, backend, tmp_path, srs_twin_process
):
    done = compared(srs_twin_process, tmp_path / "folder", settings, MPLBACKEND=backend)
    assert done.returncode == 2 and "matplotlib cannot be imported" in done.stderr
    assert (
        "matplotlibrc and the environment variable MPLBACKEND"
        in done.stderr.replace("\n", " ")
    )
