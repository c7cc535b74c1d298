"""Export of runs as MCAP files with ROS 2 messages, CSV files or NumPy archives.

An MCAP file contains the following topics for each plant, such as ``twin``:

- ``/twin/connector_1/pose`` (geometry_msgs/PoseStamped): pose of each connector.
- ``/twin/com/pose`` (geometry_msgs/PoseStamped): pose of the centre of mass.
- ``/tf``: transforms from ``world`` to each connector (``twin/connector_1``) and to
  ``twin/com``.
- ``/twin/body`` (visualization_msgs/MarkerArray): shapes of the connectors, centre line
  of the soft segments, and name of the plant, for display in Foxglove and RViz.
- ``/twin/bends`` (sensor_msgs/JointState): bends (rad, positive to the left) and their
  finite-difference rates (rad/s).
- ``/twin/pressure_plus_1`` (sensor_msgs/FluidPressure): absolute chamber pressure, Pa.
- ``/twin/valves`` (std_msgs/Int8MultiArray): valve states in the order ``plus_1``,
  ``minus_1``, ``plus_2`` and so on, in an array with the dimensions ``segments`` and
  ``chambers``.

Time stamps and log times are simulated times since the start of the run. All poses and
shapes are in the frame ``world``. The poses of planar robots have a height of 0.
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from srs_twin.comparison.centre_line import (
    connector_orientations,
    connector_places,
    connector_size,
    spatial_centre_lines,
)
from srs_twin.errors import InputError
from srs_twin.io.files import atomic_write
from srs_twin.pneumatics.chambers import AMBIENT_PA
from srs_twin.robot.spec import Geometry
from srs_twin.trajectory import Trajectory
from srs_twin.viewing.plots.style import style_of

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

WORLD = "world"

_NS = 1_000_000_000
_SIDES = ("plus", "minus")
_NUMBERED = ("bend", "pressure_plus", "pressure_minus", "valve_plus", "valve_minus")

_CHORDS = 6
_LEVEL = np.array([0.0, 0.0, 0.0, 1.0])
"""Quaternion (x, y, z, w) of a body without rotation."""


def write_csv(path: Path, run: Trajectory) -> None:
    """Write the columns of a trajectory as CSV in SI units."""
    columns = [column.tolist() for column in run.columns.values()]
    with atomic_write(path) as part, part.open("w", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(run.columns)
        writer.writerows(zip(*columns, strict=True))


def write_npz(path: Path, run: Trajectory) -> None:
    """Write the columns of a trajectory as a NumPy archive.

    The entries ``units`` and ``metadata`` are JSON strings.
    """
    with atomic_write(path) as part, part.open("wb") as file:
        np.savez_compressed(
            file,
            allow_pickle=False,
            **run.columns,
            units=json.dumps(dict(run.units)),
            metadata=json.dumps(dict(run.metadata)),
        )


def write_mcap(path: Path, runs: Mapping[str, Trajectory], geometry: Geometry) -> None:
    """Write the trajectories of plants as ROS 2 messages in an MCAP file.

    Args:
        path: output file.
        runs: trajectory of each plant, keyed by plant name.
        geometry: dimensions of the drawn bodies.
    """
    try:
        from mcap.writer import Writer
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise InputError(
            "MCAP files need optional packages; install them with: pip install"
            " 'srs-twin[recordings]'"
        ) from error
    store = get_typestore(Stores.ROS2_HUMBLE)
    channels: dict[str, int] = {}
    schemas: dict[str, int] = {}
    with atomic_write(path) as part, part.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2", library="srs-twin")
        for topic, kind, time, message in _messages(runs, geometry, store):
            if kind not in schemas:
                text, _ = store.generate_msgdef(kind, ros_version=2)
                schemas[kind] = writer.register_schema(kind, "ros2msg", text.encode())
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, "cdr", schemas[kind])
            writer.add_message(
                channels[topic], time, bytes(store.serialize_cdr(message, kind)), time
            )
        writer.finish()


def recording_map(plant: str, run: Trajectory) -> dict[str, object]:
    """Return the recording map that describes a plant in an exported MCAP file."""
    connectors = range(1, run.position.shape[1] + 1)
    log = {
        f"pressure_{side}_{j}": {
            "column": f"/{plant}/pressure_{side}_{j}.fluid_pressure",
            "unit": "Pa",
        }
        for j in connectors[:-1]
        for side in _SIDES
    }
    return {
        "bodies": {
            f"/{plant}/connector_{i}/pose": {"connector": i} for i in connectors
        },
        "log": {**log, "ambient_kpa": AMBIENT_PA / 1e3},
    }


def foxglove_layout(runs: Mapping[str, Trajectory]) -> dict[str, object]:
    """Return a Foxglove layout with a 3D view and plots of bends and pressures."""

    def series(path: str) -> list[dict[str, object]]:
        return [
            {
                "value": path.format(plant=plant, segment=segment),
                "enabled": True,
                "timestampMethod": "headerStamp",
            }
            for plant, run in runs.items()
            for segment in range(1, run.position.shape[1])
        ]

    bends = series('/{plant}/bends.position[:]{{name=="segment_{segment}"}}')
    pressures = series("/{plant}/pressure_plus_{segment}.fluid_pressure")
    return {
        "configById": {
            "3D!snakes": {
                "followTf": WORLD,
                "scene": {"transforms": {"axisScale": 0.05}},
                "topics": {f"/{plant}/body": {"visible": True} for plant in runs},
            },
            "Plot!bends": {"title": "Bends, rad", "paths": bends},
            "Plot!pressures": {
                "title": "Pressures of the + chambers, Pa",
                "paths": pressures,
            },
        },
        "globalVariables": {},
        "userNodes": {},
        "layout": {
            "direction": "row",
            "first": "3D!snakes",
            "second": {
                "direction": "column",
                "first": "Plot!bends",
                "second": "Plot!pressures",
            },
        },
    }


class _Motion:
    """Motion of one plant in the form that the messages need.

    Attributes:
        drawn: connector positions raised above the floor for drawing, shape (samples,
            N, 3), m.
        rotations: connector quaternions (x, y, z, w), shape (samples, N, 4).
        line: centre line of the body, shape (samples, points, 3), m.
        columns: values of numbered columns such as `bend_1`, keyed by base name, each
            of shape (samples, segments).
    """

    def __init__(self, plant: str, run: Trajectory, geometry: Geometry) -> None:
        self.plant = plant
        self.run = run
        self.geometry = geometry
        height = run.stack("z") if run.has("z") else np.zeros_like(run.stack("x"))
        self.positions = np.concatenate([run.position, height[..., None]], axis=-1)
        self.drawn = connector_places(run, geometry)
        self.rotations = connector_orientations(run)
        lines = spatial_centre_lines(run, geometry, _CHORDS)
        self.line = lines.reshape(len(lines), -1, 3)
        bends = run.stack("bend")
        self.rates = np.zeros_like(bends)
        if len(run) > 1:
            self.rates = np.gradient(bends, run.time, axis=0)
        self.columns = {name: run.stack(name) for name in _NUMBERED if run.has(name)}


class _Sample(NamedTuple):
    motion: _Motion
    row: int
    header: object
    make: Mapping[str, Any]

    def values(self, name: str) -> np.ndarray:
        columns = self.motion.columns
        return columns[name][self.row] if name in columns else np.zeros(0)

    def pose(self, place: np.ndarray, rotation: np.ndarray) -> Any:
        point = self.make["Point"](*map(float, place))
        turn = self.make["Quaternion"](*map(float, rotation))
        return self.make["Pose"](position=point, orientation=turn)


class _Message(NamedTuple):
    topic: str
    kind: str
    content: object


def _messages(
    runs: Mapping[str, Trajectory], geometry: Geometry, store: Typestore
) -> Iterator[tuple[str, str, int, object]]:
    make = {name.rsplit("/", 1)[1]: kind for name, kind in store.types.items()}
    motions = {plant: _Motion(plant, run, geometry) for plant, run in runs.items()}
    times = sorted(
        (round(time * _NS), plant, row)
        for plant, run in runs.items()
        for row, time in enumerate(run.time)
    )
    for time, plant, row in times:
        stamp = make["Time"](sec=time // _NS, nanosec=time % _NS)
        header = make["Header"](stamp=stamp, frame_id=WORLD)
        sample = _Sample(motions[plant], row, header, make)
        for messages in (_pose_messages, _body_messages, _segment_messages):
            for message in messages(sample):
                topic = message.topic
                if topic != "/tf":
                    topic = f"/{plant}/{topic}"
                yield topic, message.kind, time, message.content


def _pose_messages(sample: _Sample) -> Iterator[_Message]:
    motion, row, header, make = sample
    poses = zip(motion.positions[row], motion.rotations[row], strict=True)
    bodies = {f"connector_{i}": pose for i, pose in enumerate(poses, start=1)}
    heading = motion.run["heading"][row] / 2
    com = np.array([*motion.run.com[row], motion.positions[row, :, 2].mean()])
    bodies["com"] = com, np.array([0.0, 0.0, math.sin(heading), math.cos(heading)])
    transforms = []
    for name, (place, rotation) in bodies.items():
        pose = sample.pose(place, rotation)
        stamped = make["PoseStamped"](header=header, pose=pose)
        yield _Message(f"{name}/pose", "geometry_msgs/msg/PoseStamped", stamped)
        translation = make["Vector3"](*map(float, place))
        transforms.append(
            make["TransformStamped"](
                header=header,
                child_frame_id=f"{motion.plant}/{name}",
                transform=make["Transform"](translation, pose.orientation),
            )
        )
    message = make["TFMessage"](transforms=transforms)
    yield _Message("/tf", "tf2_msgs/msg/TFMessage", message)


def _body_messages(sample: _Sample) -> Iterator[_Message]:
    motion, row, _, make = sample
    geometry = motion.geometry
    shapes = make["Marker"]
    width = geometry.width
    line = [make["Point"](*map(float, point)) for point in motion.line[row]]
    markers = [_marker(sample, 0, shapes.LINE_STRIP, (width, 0.0, 0.0), points=line)]
    size = connector_size(geometry)
    poses = zip(motion.drawn[row], motion.rotations[row], strict=True)
    for i, (place, rotation) in enumerate(poses, start=1):
        pose = sample.pose(place, rotation)
        markers.append(_marker(sample, i, shapes.CUBE, size, pose=pose))
    above = sample.pose(motion.drawn[row, 0] + [0.0, 0.0, 2 * width], _LEVEL)
    markers.append(
        _marker(
            sample,
            len(markers),
            shapes.TEXT_VIEW_FACING,
            (0.0, 0.0, width),
            pose=above,
            text=motion.plant,
        )
    )
    message = make["MarkerArray"](markers=markers)
    yield _Message("body", "visualization_msgs/msg/MarkerArray", message)


def _marker(
    sample: _Sample, number: int, shape: int, size: Sequence[float], **content: Any
) -> Any:
    make = sample.make
    no_data = np.zeros(0, dtype=np.uint8)
    no_header = make["Header"](stamp=make["Time"](sec=0, nanosec=0), frame_id="")
    defaults = {
        "pose": sample.pose(np.zeros(3), _LEVEL),
        "points": [],
        "text": "",
    }
    color = (channel / 255 for channel in style_of(sample.motion.plant).rgb)
    return make["Marker"](
        header=sample.header,
        ns=sample.motion.plant,
        id=number,
        type=shape,
        action=make["Marker"].ADD,
        scale=make["Vector3"](*map(float, size)),
        color=make["ColorRGBA"](*color, 0.8),
        lifetime=make["Duration"](sec=0, nanosec=0),
        frame_locked=False,
        colors=[],
        texture_resource="",
        texture=make["CompressedImage"](header=no_header, format="", data=no_data),
        uv_coordinates=[],
        mesh_resource="",
        mesh_file=make["MeshFile"](filename="", data=no_data),
        mesh_use_embedded_materials=False,
        **(defaults | content),
    )


def _segment_messages(sample: _Sample) -> Iterator[_Message]:
    motion, row, header, make = sample
    bends = sample.values("bend")
    joints = make["JointState"](
        header=header,
        name=[f"segment_{j}" for j in range(1, len(bends) + 1)],
        position=bends,
        velocity=motion.rates[row],
        effort=np.zeros(0),
    )
    yield _Message("bends", "sensor_msgs/msg/JointState", joints)
    for side in _SIDES:
        for j, gauge in enumerate(sample.values(f"pressure_{side}"), start=1):
            pressure = make["FluidPressure"](
                header=header, fluid_pressure=gauge + AMBIENT_PA, variance=0.0
            )
            topic = f"pressure_{side}_{j}"
            yield _Message(topic, "sensor_msgs/msg/FluidPressure", pressure)
    states = np.array(
        [sample.values(f"valve_{side}") for side in _SIDES], dtype=np.int8
    )
    if states.size:
        chambers, segments = states.shape
        dimension = make["MultiArrayDimension"]
        layout = make["MultiArrayLayout"](
            dim=[
                dimension(label="segments", size=segments, stride=states.size),
                dimension(label="chambers", size=chambers, stride=chambers),
            ],
            data_offset=0,
        )
        valves = make["Int8MultiArray"](layout=layout, data=states.T.reshape(-1))
        yield _Message("valves", "std_msgs/msg/Int8MultiArray", valves)
