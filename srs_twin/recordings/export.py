"""Export of runs as MCAP with ROS 2 messages, as CSV, or as NumPy archives.

The topics of a plant, for example ``twin``, are:

- ``/twin/connector_1/pose`` (geometry_msgs/PoseStamped): pose of each connector.
- ``/twin/com/pose`` (geometry_msgs/PoseStamped): pose of the centre of mass.
- ``/tf``: transforms from ``world`` to ``twin/connector_1`` etc.
- ``/twin/bends`` (sensor_msgs/JointState): bends, rad, positive to the left.
- ``/twin/pressure_plus_1`` (sensor_msgs/FluidPressure): absolute chamber pressure, Pa.
- ``/twin/valves`` (std_msgs/Int8MultiArray): valve states of the + and − chamber of
  each segment.

Time stamps and log times are simulated times since the start of the run.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from srs_twin.errors import InputError
from srs_twin.io.files import atomic_write
from srs_twin.pneumatics.chambers import AMBIENT_PA
from srs_twin.trajectory import Trajectory

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

WORLD = "world"
"""Reference frame of all poses."""

_NS = 1_000_000_000
_SIDES = ("plus", "minus")


def write_csv(path: Path, run: Trajectory) -> None:
    """Write the columns of a trajectory as CSV in SI units."""
    names = list(run.columns)
    with atomic_write(path) as part, part.open("w", encoding="utf-8") as file:
        file.write(",".join(names) + "\n")
        for row in zip(*(run.columns[name].tolist() for name in names), strict=True):
            file.write(",".join(map(repr, row)) + "\n")


def write_npz(path: Path, run: Trajectory) -> None:
    """Write the columns of a trajectory as a NumPy archive.

    The entries ``units`` and ``metadata`` are JSON strings.
    """
    about = {
        "units": json.dumps(dict(run.units)),
        "metadata": json.dumps(dict(run.metadata)),
    }
    with atomic_write(path) as part, part.open("wb") as file:
        np.savez_compressed(
            file,
            allow_pickle=False,
            **run.columns,
            **{k: np.array(v) for k, v in about.items()},
        )


def write_mcap(path: Path, runs: Mapping[str, Trajectory]) -> None:
    """Write the trajectories of plants as ROS 2 messages in an MCAP file.

    An existing file is replaced.
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
        for topic, kind, time, message in _messages(runs, store):
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
    """Return the recording map for an exported MCAP file."""
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
    bends = []
    pressures = []
    for plant, run in runs.items():
        for j in range(1, run.position.shape[1]):
            path = f'/{plant}/bends.position[:]{{name=="segment_{j}"}}'
            bends.append(
                {"value": path, "enabled": True, "timestampMethod": "headerStamp"}
            )
            value = f"/{plant}/pressure_plus_{j}.fluid_pressure"
            pressures.append(
                {"value": value, "enabled": True, "timestampMethod": "headerStamp"}
            )
    return {
        "configById": {
            "3D!snakes": {
                "followTf": WORLD,
                "scene": {"transforms": {"axisScale": 0.05}},
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


class _Sample(NamedTuple):
    plant: str
    values: Mapping[str, float]
    header: object
    make: Mapping[str, Callable[..., object]]

    def numbered(self, name: str) -> list[float]:
        keys = (f"{name}_{j}" for j in range(1, len(self.values)))
        return [self.values[key] for key in takewhile(self.values.__contains__, keys)]


class _Message(NamedTuple):
    topic: str
    kind: str
    content: object


def _messages(
    runs: Mapping[str, Trajectory], store: Typestore
) -> Iterator[tuple[str, str, int, object]]:
    make = {name.rsplit("/", 1)[1]: kind for name, kind in store.types.items()}
    times = sorted(
        (round(time * _NS), plant, k)
        for plant, run in runs.items()
        for k, time in enumerate(run.time)
    )
    for time, plant, k in times:
        values = {name: float(own[k]) for name, own in runs[plant].columns.items()}
        stamp = make["Time"](sec=time // _NS, nanosec=time % _NS)
        header = make["Header"](stamp=stamp, frame_id=WORLD)
        sample = _Sample(plant, values, header, make)
        for message in (*_pose_messages(sample), *_segment_messages(sample)):
            topic = message.topic
            if topic != "/tf":
                topic = f"/{plant}/{topic}"
            yield topic, message.kind, time, message.content


def _pose_messages(sample: _Sample) -> Iterator[_Message]:
    _, values, header, make = sample
    poses = zip(
        sample.numbered("x"),
        sample.numbered("y"),
        sample.numbered("connector_heading"),
        strict=True,
    )
    bodies = {f"connector_{i}": pose for i, pose in enumerate(poses, start=1)}
    bodies["com"] = (values["com_x"], values["com_y"], values["heading"])
    transforms = []
    for name, (x, y, angle) in bodies.items():
        turn = make["Quaternion"](
            x=0.0, y=0.0, z=math.sin(angle / 2), w=math.cos(angle / 2)
        )
        pose = make["Pose"](position=make["Point"](x=x, y=y, z=0.0), orientation=turn)
        stamped = make["PoseStamped"](header=header, pose=pose)
        yield _Message(f"{name}/pose", "geometry_msgs/msg/PoseStamped", stamped)
        place = make["Vector3"](x=x, y=y, z=0.0)
        transforms.append(
            make["TransformStamped"](
                header=header,
                child_frame_id=f"{sample.plant}/{name}",
                transform=make["Transform"](translation=place, rotation=turn),
            )
        )
    message = make["TFMessage"](transforms=transforms)
    yield _Message("/tf", "tf2_msgs/msg/TFMessage", message)


def _segment_messages(sample: _Sample) -> Iterator[_Message]:
    _, _, header, make = sample
    bends = np.array(sample.numbered("bend"))
    nothing = np.zeros(0)
    joints = make["JointState"](
        header=header,
        name=[f"segment_{j}" for j in range(1, len(bends) + 1)],
        position=bends,
        velocity=nothing,
        effort=nothing,
    )
    yield _Message("bends", "sensor_msgs/msg/JointState", joints)
    for side in _SIDES:
        for j, gauge in enumerate(sample.numbered(f"pressure_{side}"), start=1):
            pressure = make["FluidPressure"](
                header=header, fluid_pressure=gauge + AMBIENT_PA, variance=0.0
            )
            topic = f"pressure_{side}_{j}"
            yield _Message(topic, "sensor_msgs/msg/FluidPressure", pressure)
    states = np.array(
        [sample.numbered(f"valve_{side}") for side in _SIDES], dtype=np.int8
    )
    if states.size:
        layout = make["MultiArrayLayout"](dim=[], data_offset=0)
        valves = make["Int8MultiArray"](layout=layout, data=states.T.reshape(-1))
        yield _Message("valves", "std_msgs/msg/Int8MultiArray", valves)
