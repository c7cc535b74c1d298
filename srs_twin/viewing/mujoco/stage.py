"""MuJoCo scene that shows the samples of a finished run."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from srs_twin.errors import InputError
from srs_twin.plants.twin.snake import TwinSnake
from srs_twin.scenario.scenario import Scenario
from srs_twin.trajectory import Trajectory
from srs_twin.viewing.additions import RunPictures, added_to
from srs_twin.viewing.mujoco.canvas import Canvas, Label
from srs_twin.viewing.plots.signals import body_line, pressure_difference
from srs_twin.viewing.plots.style import (
    CONTACT_COLOR,
    MINUS_COLOR,
    PLUS_COLOR,
    STYLES,
    pressure_colors,
    style_of,
    unit_rgba,
)

Ghost = tuple[str, Trajectory]
"""Name and trajectory of a plant that is drawn translucent in the twin's scene."""

_MAX_TRAIL_POINTS = 400
_MAX_MARKS = 2000
"""Approximate maximum number of contact marks on the floor."""
_MARK_RATIO = 0.005
"""Radius of a contact mark, in body lengths."""
_OBSTACLE_ALPHA = 0.35
_TEXT_COLOR = "#30333a"
_GHOST_ALPHA = 0.13
"""Opacity of each ghost capsule, which is low because four or five capsules overlap.
"""

_GHOST_CHORDS = 6
"""Number of capsules per ghost segment."""

_SCALE_BAR_M = 0.1
_LINE_M = 0.001
"""Thickness of floor lines and half of their width, m."""


class Stage:
    """Scene of a run, with the robot and the world at recorded positions.

    Segments are coloured by pressure difference. The scene also contains the path of
    the centre of mass and the floor lines added by extensions.

    Attributes:
        bench: whether the head is clamped.
        legend: colours of the floor lines, keyed by label.
    """

    def __init__(
        self,
        scenario: Scenario,
        run: Trajectory,
        ghost: Ghost | None = None,
    ) -> None:
        """Build the scene for a trajectory with ``qpos`` columns."""
        if not run.has("qpos") or not len(run):
            raise InputError(
                "the run contains no positions of the twin (columns qpos_1…) to draw;"
                " run the scenario with the twin"
            )
        self.run = run
        self.bench = scenario.file.bench
        pictures = added_to(run) or RunPictures()
        self.legend = pictures.legend
        self._floor_lines = _floor_lines(run, pictures)
        self._ghost = ghost
        self._labels = _labels(run, self.legend, ghost, bench=self.bench)
        if ghost is not None:
            geometry = scenario.robot.geometry
            _, ghost_run = ghost
            self._ghost_line = body_line(ghost_run, geometry, _GHOST_CHORDS)
        plant = scenario.build_plant("twin", pneumatics="lag", sensor="ideal")
        assert isinstance(plant, TwinSnake), "`build_plant` returns a TwinSnake"
        self.model = plant.physics.model
        self.data = mujoco.MjData(self.model)
        self._qpos = run.stack("qpos")
        if self._qpos.shape[1] != self.model.nq:
            raise InputError(
                f"the trajectory has {self._qpos.shape[1]} columns qpos_1…, but the"
                f" twin of the scenario has {self.model.nq} positions; run the scenario"
                " again"
            )
        self._skins = Skins(self.model, scenario.robot.segments)
        make_obstacles_translucent(self.model)
        self._colors = pressure_colors(pressure_difference(run))
        step = math.ceil(len(run) / _MAX_TRAIL_POINTS)
        self._trail_rows = np.arange(0, len(run), step)
        self._marks = contact_marks(run)
        self._mark_radius = _MARK_RATIO * scenario.robot.geometry.body_length

    def row_at(self, time: float) -> int:
        """Return the index of the sample nearest to a time (s)."""
        return int(np.abs(self.run.time - time).argmin())

    def show(self, row: int) -> None:
        """Set the positions and the segment colours to those of a sample."""
        self.data.qpos[:] = self._qpos[row]
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)
        self._skins.paint(self._colors[row])

    def render(self, canvas: Canvas, camera: mujoco.MjvCamera, row: int) -> np.ndarray:
        """Render a sample as an image, shape (height, width, 3), uint8."""
        self.show(row)

        def add(scene: mujoco.MjvScene) -> None:
            self.add_lines(scene, row)
            self._add_marks(scene, row)
            self._add_scale_bar(scene, camera)
            self._add_ghost(scene, row)

        time = Label(f"t = {self.run.time[row]:.2f} s", _TEXT_COLOR)
        return canvas.draw(self.data, camera, add, [time, *self._labels])

    def add_lines(
        self, scene: mujoco.MjvScene, row: int, half_width: float = _LINE_M
    ) -> None:
        """Add the floor lines, and the centre-of-mass path up to a sample.

        The line width is twice `half_width` (m).
        """
        if not self.bench:
            rows = np.append(self._trail_rows[self._trail_rows < row], row)
            add_line(
                scene, self.run.com[rows], STYLES["twin"].color, half_width, level=2
            )
        for points, color in self._floor_lines:
            add_line(scene, points, color, half_width)

    def _add_marks(self, scene: mujoco.MjvScene, row: int) -> None:
        rows, points = self._marks
        disc = mujoco.mjtGeom.mjGEOM_CYLINDER
        rgba = unit_rgba(CONTACT_COLOR)
        size = [self._mark_radius, self._mark_radius, _LINE_M / 2]
        for x, y in points[rows <= row]:
            _add_geom(scene, disc, rgba, size, [x, y, 0.0])

    def _add_scale_bar(self, scene: mujoco.MjvScene, camera: mujoco.MjvCamera) -> None:
        azimuth = math.radians(camera.azimuth)
        forward = np.array([math.cos(azimuth), math.sin(azimuth)])
        right = np.array([math.sin(azimuth), -math.cos(azimuth)])
        centre = np.array(camera.lookat[:2]) - 0.25 * camera.distance * forward
        first = scene.ngeom
        ends = centre + _SCALE_BAR_M * np.array([[-0.5], [0.5]]) * right
        add_line(scene, ends, _TEXT_COLOR, 0.003 * camera.distance)
        if scene.ngeom > first:
            scene.geoms[first].label = f"{_SCALE_BAR_M:g} m"

    def _add_ghost(self, scene: mujoco.MjvScene, row: int) -> None:
        if self._ghost is None:
            return
        plant, run = self._ghost
        line = self._ghost_line[int(np.abs(run.time - self.run.time[row]).argmin())]
        rgba = unit_rgba(style_of(plant).color, _GHOST_ALPHA)
        skin = self._skins.geoms[0][0]
        height = self.data.geom_xpos[skin, 2]
        points = np.pad(line, ((0, 0), (0, 1)), constant_values=height)
        # Coincident surfaces would flicker, so the ghost is thinner than the twin.
        radius = 0.92 * self.model.geom_size[skin, 0]
        capsule = mujoco.mjtGeom.mjGEOM_CAPSULE
        for begin, end in itertools.pairwise(points):
            geom = _add_geom(scene, capsule, rgba)
            if geom is not None:
                mujoco.mjv_connector(geom, capsule, radius, begin, end)


def contact_marks(run: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Return sample indices and points (m) at which a spatial snake touches the floor.

    Runs with more contacts are subsampled to about `_MAX_MARKS` contacts.
    """
    if not run.has("load"):
        return np.empty(0, dtype=int), np.empty((0, 2))
    touches = run.stack("load") > 0.0
    step = max(1, math.ceil(touches.sum() / _MAX_MARKS))
    rows, connectors = np.nonzero(touches[::step])
    rows = rows * step
    return rows, run.position[rows, connectors]


def add_line(
    scene: mujoco.MjvScene,
    points: np.ndarray,
    color: str,
    half_width: float,
    level: int = 1,
) -> None:
    """Add a line on the floor to a scene.

    If the scene has no free geoms, the rest of the line is omitted. The line consists
    of flat boxes, because capsules would take longer to draw than the rest of the
    scene. Each box is slightly higher than the previous box, because MuJoCo lights
    coincident faces twice.

    Args:
        scene: scene to which the line is added.
        points: points of the line, shape (n, 2), m.
        color: line colour, #rrggbb.
        half_width: half the line width, m.
        level: layer of the line, which covers the lines in lower layers.
    """
    box = mujoco.mjtGeom.mjGEOM_BOX
    rgba = unit_rgba(color)
    heights = _LINE_M * np.linspace(level, level + 1, len(points))
    for begin, end, height in zip(points, points[1:], heights, strict=False):
        length = math.hypot(*(end - begin))
        c, s = (end - begin) / length if length else (1.0, 0.0)
        size = [length / 2 + half_width, half_width, _LINE_M / 2]
        place = [*(begin + end) / 2, height]
        axes = [c, -s, 0, s, c, 0, 0, 0, 1]
        _add_geom(scene, box, rgba, size, place, axes)


def _add_geom(
    scene: mujoco.MjvScene,
    kind: mujoco.mjtGeom,
    rgba: Sequence[float],
    size: Sequence[float] = (0.0, 0.0, 0.0),
    place: Sequence[float] = (0.0, 0.0, 0.0),
    axes: Sequence[float] = (1, 0, 0, 0, 1, 0, 0, 0, 1),
) -> mujoco.MjvGeom | None:
    """Add a geom to a scene and return it, or None if the scene has no free geoms."""
    if scene.ngeom == scene.maxgeom:
        return None
    geom = scene.geoms[scene.ngeom]
    color = np.array(rgba, dtype=np.float32)
    mujoco.mjv_initGeom(geom, kind, size, place, axes, color)
    scene.ngeom += 1
    return geom


def _labels(
    run: Trajectory, legend: Mapping[str, str], ghost: Ghost | None, *, bench: bool
) -> list[Label]:
    labels: dict[str, str] = {}
    if run.has("pressure_plus"):
        labels |= {"p+ > p-": PLUS_COLOR, "p+ < p-": MINUS_COLOR}
    if not bench:
        labels["twin, CoM"] = STYLES["twin"].color
    if run.has("load"):
        labels["contacts"] = CONTACT_COLOR
    labels |= legend
    if ghost is not None:
        plant, _ = ghost
        labels[plant] = style_of(plant).color
    return [Label(text, color) for text, color in labels.items()]


def make_obstacles_translucent(model: mujoco.MjModel) -> None:
    """Make obstacles translucent, so that they do not hide the snake."""
    for geom in range(model.ngeom):
        if re.match(r"(obstacle|polygon)_\d", model.geom(geom).name):
            model.geom_rgba[geom, 3] = _OBSTACLE_ALPHA


class Skins:
    """Visible geoms of the segments, coloured by pressure."""

    def __init__(self, model: mujoco.MjModel, segments: int) -> None:
        """Find the segment geoms, and dim the lights to avoid overexposed colours."""
        model.vis.headlight.ambient = [0.45] * 3
        model.vis.headlight.diffuse = [0.2] * 3
        model.light_diffuse[:] = 0.45
        model.light_specular[:] = 0.0
        model.mat_reflectance[:] = 0.0
        self._model = model
        self.geoms: list[list[int]] = [[] for _ in range(segments)]
        for geom in range(model.ngeom):
            if match := re.fullmatch(r"skin_(\d+)_\d+", model.geom(geom).name):
                self.geoms[int(match[1]) - 1].append(geom)

    def paint(self, colors: np.ndarray) -> None:
        """Set the segment colours, RGBA bytes, shape (segments, 4)."""
        for geoms, color in zip(self.geoms, colors / np.float32(255), strict=True):
            self._model.geom_rgba[geoms] = color

    def show(self, pressure: np.ndarray, full_scale: float) -> None:
        """Colour the segments by the pressure difference between their chambers.

        Args:
            pressure: pressures of the + and − chambers, shape (segments, 2).
            full_scale: pressure difference with the most saturated colour, in the unit
                of `pressure`.
        """
        self.paint(pressure_colors(pressure[:, 0] - pressure[:, 1], full_scale))


def _floor_lines(
    run: Trajectory, pictures: RunPictures
) -> list[tuple[np.ndarray, str]]:
    listed = pictures.legend.values()
    return [
        (strip, line.color)
        for line in pictures.floor_lines(run)
        if line.color in listed
        for strip in line.strips
    ]
