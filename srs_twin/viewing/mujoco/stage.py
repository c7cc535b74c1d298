"""Stage: a finished run of the twin, set up again in MuJoCo and looked at sample by sample."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np

from srs_twin.errors import InputError
from srs_twin.scenario.scenario import Scenario
from srs_twin.trajectory import Trajectory
from srs_twin.viewing.additions import added_to
from srs_twin.viewing.mujoco.canvas import Canvas, Label
from srs_twin.viewing.plots.signals import body_line, pressure_difference
from srs_twin.viewing.plots.style import (
    MINUS_COLOR,
    PLUS_COLOR,
    STYLES,
    pressure_colors,
    style_of,
    unit_rgba,
)

Ghost = tuple[str, Trajectory]
"""Name of a plant and what it did."""

_MOST_PIECES = 400
_OBSTACLE_ALPHA = 0.35
_INK, _GHOST_ALPHA, _PIECES = "#30333a", 0.13, 6  # four or five capsules lie on each other
_SCALE_M = 0.1
_LINE = 0.001  # thickness of lines on the floor and half of their width, m


class Stage:
    """The scene of a run: robot and world as they were built, at the positions that the run recorded.

    Segments have the colour of their pressure difference; the centre of mass leaves a trail, and what the
    snake was to follow lies on the floor. Another plant may be there as a ghost.

    Attributes:
        run: the twin's trajectory.
        model: of MuJoCo, the stage's own.
        data: where everything is now.
        bench: whether the head is clamped, in the air.
        ghost: another plant; None: there is none.
    """

    def __init__(self, scenario: Scenario, run: Trajectory, ghost: Ghost | None = None) -> None:
        """Build the scene.

        Args:
            scenario: what was run.
            run: what the twin did, with its ``qpos`` columns.
            ghost: name of another plant and what it did.

        Raises:
            InputError: no samples, no ``qpos`` columns, or not of this robot.
        """
        if not run.has("qpos") or not len(run):
            raise InputError("no positions of the twin were recorded (columns qpos_1…): nothing to draw")
        self.run, self.bench = run, scenario.file.bench
        self.ghost = ghost
        self._labels = _legend(run, ghost, bench=self.bench)
        if ghost is not None:
            self._ghost_line = body_line(ghost[1], scenario.robot.geometry, _PIECES)
        plant: Any = scenario.build_plant("twin")
        self.model = plant.physics.model.ptr
        self.data = mujoco.MjData(self.model)
        self._qpos = run.stack("qpos")
        if self._qpos.shape[1] != self.model.nq:
            raise InputError(
                f"the trajectory has {self._qpos.shape[1]} columns qpos_1…, the scenario's twin "
                f"{self.model.nq}: they do not belong together; run the scenario again"
            )
        self._skins = Skins(self.model, scenario.robot.segments)
        _see_through(self.model)
        self._colors = pressure_colors(pressure_difference(run)) / np.float32(255)
        every = max(1, -(-len(run) // _MOST_PIECES))
        self._marks = np.arange(0, len(run), every)
        self._fixed = _on_the_floor(run)

    @property
    def duration(self) -> float:
        """Length of the run, s."""
        return float(self.run.time[-1] - self.run.time[0])

    @property
    def legend(self) -> Mapping[str, str]:
        """Line on the floor → colour."""
        pictures = added_to(self.run)
        return pictures.legend if pictures else {}

    def row_at(self, time: float) -> int:
        """Return the sample that is nearest to a time, s."""
        return int(np.abs(self.run.time - time).argmin())

    def show(self, row: int) -> None:
        """Put everything where it was at a sample."""
        self.data.qpos[:] = self._qpos[row]
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)
        self._skins.paint(self._colors[row])

    def picture(self, canvas: Canvas, camera: mujoco.MjvCamera, row: int) -> np.ndarray:
        """Return a picture of a sample, shape (height, width, 3), bytes."""
        self.show(row)

        def add(scene: mujoco.MjvScene) -> None:
            self.add_lines(scene, row)
            self._add_scale(scene, camera)
            self._add_ghost(scene, row)

        time = Label(f"t = {self.run.time[row]:.2f} s", _INK)
        return canvas.draw(self.data, camera, add, [time, *self._labels])

    def add_lines(self, scene: mujoco.MjvScene, row: int, half: float = _LINE) -> None:
        """Draw the trail up to a sample, and what the snake was to follow, in lines of half a width in m."""
        if not self.bench:
            seen = np.append(self._marks[self._marks < row], row)
            add_line(scene, self.run.com[seen], STYLES["twin"].color, half, level=2)
        for points, color in self._fixed:
            add_line(scene, points, color, half)

    def _add_scale(self, scene: mujoco.MjvScene, camera: mujoco.MjvCamera) -> None:
        """Draw a bar of 0.1 m across the view, nearer than what the camera looks at, with its length."""
        azimuth = math.radians(camera.azimuth)
        ahead, right = (np.array([math.cos(a), math.sin(a)]) for a in (azimuth, azimuth - math.pi / 2))
        middle = np.array(camera.lookat[:2]) - 0.25 * camera.distance * ahead
        first = scene.ngeom
        ends = middle + _SCALE_M * np.array([[-0.5], [0.5]]) * right
        add_line(scene, ends, _INK, 0.003 * camera.distance)
        if scene.ngeom > first:
            scene.geoms[first].label = f"{_SCALE_M:g} m"

    def _add_ghost(self, scene: mujoco.MjvScene, row: int) -> None:
        """Draw the body of the ghost at the time of a sample; it stays where its run ended."""
        if self.ghost is None:
            return
        plant, run = self.ghost
        line = self._ghost_line[int(np.abs(run.time - self.run.time[row]).argmin())]
        color = np.array(unit_rgba(style_of(plant).color, _GHOST_ALPHA), dtype=np.float32)
        skin = self._skins.geoms[0][0]
        points = np.pad(line, ((0, 0), (0, 1)), constant_values=self.data.geom_xpos[skin, 2])
        # A little thinner than the twin, so that two at the same place do not flicker.
        radius = 0.92 * self.model.geom_size[skin, 0]
        for begin, end in zip(points, points[1:], strict=False):
            if scene.ngeom == scene.maxgeom:
                return
            geom, piece = scene.geoms[scene.ngeom], mujoco.mjtGeom.mjGEOM_CAPSULE
            mujoco.mjv_initGeom(geom, piece, np.zeros(3), np.zeros(3), np.zeros(9), color)
            mujoco.mjv_connector(geom, piece, radius, begin, end)
            scene.ngeom += 1


def add_line(scene: mujoco.MjvScene, points: np.ndarray, color: str, half: float, level: int = 1) -> None:
    """Add a line on the floor to a scene, as far as there is room.

    It is made of flat boxes: capsules would take longer to draw than everything else. Each lies a little
    higher than the one before: MuJoCo lights faces at the same depth twice.

    Args:
        scene: of a picture that is being made.
        points: (n, 2), m.
        color: as #rrggbb.
        half: of its width, m.
        level: lines of a higher one lie on those of a lower one.
    """
    box, rgba = mujoco.mjtGeom.mjGEOM_BOX, np.array(unit_rgba(color), dtype=np.float32)
    heights = _LINE * np.linspace(level, level + 1, len(points))
    for begin, end, height in zip(points, points[1:], heights, strict=False):
        if scene.ngeom == scene.maxgeom:
            return
        (x, y), length = end - begin, math.hypot(*(end - begin))
        c, s = (x / length, y / length) if length else (1.0, 0.0)
        size, place = [length / 2 + half, half, _LINE / 2], [*(begin + end) / 2, height]
        mujoco.mjv_initGeom(scene.geoms[scene.ngeom], box, size, place, [c, -s, 0, s, c, 0, 0, 0, 1], rgba)
        scene.ngeom += 1


def _legend(run: Trajectory, ghost: Ghost | None, *, bench: bool) -> list[Label]:
    """Return what the colours mean."""
    labels = [Label("p+ > p-", PLUS_COLOR), Label("p+ < p-", MINUS_COLOR)]
    labels += [] if bench else [Label("twin, CoM", STYLES["twin"].color)]
    if pictures := added_to(run):
        labels += [Label(name, color) for name, color in pictures.legend.items()]
    return labels + ([] if ghost is None else [Label(ghost[0], style_of(ghost[0]).color)])


def _see_through(model: mujoco.MjModel) -> None:
    """Let the camera see a snake behind an obstacle."""
    for geom in range(model.ngeom):
        if re.match(r"(obstacle|polygon)_\d", model.geom(geom).name):
            model.geom_rgba[geom, 3] = _OBSTACLE_ALPHA


class Skins:
    """What is drawn of the segments of a model, lit so that a colour stands for a pressure.

    Attributes:
        geoms: of each segment.
    """

    def __init__(self, model: mujoco.MjModel, segments: int) -> None:
        """Find them, and let no more light fall on anything than white reflects."""
        model.vis.headlight.ambient, model.vis.headlight.diffuse = [0.45] * 3, [0.2] * 3
        model.light_diffuse[:], model.light_specular[:] = 0.45, 0.0
        model.mat_reflectance[:] = 0.0
        self._model = model
        self.geoms: list[list[int]] = [[] for _ in range(segments)]
        for geom in range(model.ngeom):
            if match := re.fullmatch(r"skin_(\d+)_\d+", model.geom(geom).name):
                self.geoms[int(match[1]) - 1].append(geom)

    def paint(self, colors: np.ndarray) -> None:
        """Give each segment a colour, shape (segments, 4), 0 to 1."""
        for geoms, color in zip(self.geoms, colors, strict=True):
            self._model.geom_rgba[geoms] = color

    def show(self, pressure: np.ndarray, most: float) -> None:
        """Show pressures (segments, 2) of the + and − chambers; `most` is what has the full colour."""
        self.paint(pressure_colors(pressure[:, 0] - pressure[:, 1], most) / np.float32(255))


def _on_the_floor(run: Trajectory) -> list[tuple[np.ndarray, str]]:
    """Return the lines on the floor that extensions add, with their colours; only those of the legend."""
    pictures = added_to(run)
    lines = [] if pictures is None else pictures.floor_lines(run)
    shown = [line for line in lines if pictures and line.color in pictures.legend.values()]
    return [(strip, line.color) for line in shown for strip in line.strips]
