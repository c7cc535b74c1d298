"""Set-up file of a lab (`srs-twin shadow --setup lab.yaml`): robot, broker, motion capture and limits.

Each key sets an option of `srs-twin shadow`; options on the command line override the
file. Paths are relative to the folder of the file, or else to the current folder.
"""

from __future__ import annotations

import re
from collections.abc import Container
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, field_validator

from srs_twin.errors import InputError
from srs_twin.io.documents import Loc
from srs_twin.io.files import require_file
from srs_twin.io.validation import load_model
from srs_twin.live import links, natnet
from srs_twin.scenario.fields import FilePath, Line, PathOrName, Section, quantity

Connector = Annotated[int, Field(ge=1, le=999)]


def _address_with(port: int) -> AfterValidator:
    """Return a validator of addresses with a default port."""

    def check(given: str) -> str:
        try:
            links.address(given, port)
        except InputError as error:
            raise ValueError(str(error)) from None
        return given

    return AfterValidator(check)


class BrokerFile(Section):
    """MQTT broker; the password is in the environment variable SRS_TWIN_MQTT_PASSWORD."""

    address: Annotated[Line, _address_with(links.PORT)]
    """HOST or HOST:PORT."""
    user: Line | None = None
    """User name."""
    ca: FilePath | None = None
    """CA certificate file (PEM); enables TLS."""


class MotionCaptureFile(Section):
    """NatNet server, such as Motive."""

    address: Annotated[Line, _address_with(natnet.COMMAND_PORT)]
    """HOST or HOST:PORT of the server's command port."""
    local: Line = "127.0.0.1"
    """Address of this machine on which frames arrive."""
    up: Literal["y", "z"] = "y"
    """Axis that points up in the frames."""
    bodies: dict[Line, Connector] = {}
    """Rigid body → connector, 1 at the head (default: connector_1 → 1 and so on)."""


class LimitsFile(Section):
    """Limits at which a session ends."""

    duration_s: float | None = quantity(0.02, 1e7, None)
    """Longest session; none: until it is stopped."""
    press_on: bool = False
    """Steer on without any margin to obstacles instead of stopping."""


class SetupFile(Section):
    """Set-up of a lab."""

    robot: PathOrName
    """Shipped robot or robot file."""
    name: Annotated[str, Field(min_length=1, max_length=200)] | None = None
    """Robot's name in topics, srs/NAME/KIND (default: the robot's or its file's name).
    """
    supply_kpa: float | None = quantity(0.0, 1000.0, None)
    """Gauge pressure of the supply (default: the robot's nominal one)."""
    broker: BrokerFile | None = None
    """MQTT broker (default: 127.0.0.1:1883)."""
    motion_capture: MotionCaptureFile | None = None
    """Motion capture (default: none)."""
    limits: LimitsFile = LimitsFile()
    """Limits of a session."""

    @field_validator("name")
    @classmethod
    def _is_part_of_a_topic(cls, given: str | None) -> str | None:
        if given and re.search("[/+#]", given):
            raise ValueError(
                "the name cannot be part of a topic; use a name without /, + and #"
            )
        return given

    def options(self) -> dict[str, Any]:
        """Return the file's values by the names of the options of `srs-twin shadow`; without absent ones."""
        broker = self.broker
        capture = self.motion_capture
        values = {
            "robot": self.robot,
            "name": self.name,
            "pressure": self.supply_kpa,
            "mqtt": broker and broker.address,
            "user": broker and broker.user,
            "ca": broker and broker.ca and Path(broker.ca),
            "natnet": capture and capture.address,
            "local": capture and capture.local,
            "up": capture and capture.up,
            "body": (
                capture
                and [f"{body}={number}" for body, number in capture.bodies.items()]
            ),
            "duration": self.limits.duration_s,
            "press_on": self.limits.press_on,
        }
        return {name: value for name, value in values.items() if value is not None}


_PATHS: dict[Loc, str] = {("robot",): "robot", ("broker", "ca"): ""}
"""Keys that name files; see `Document.locate`."""


def load_setup(path: Path, overridden: Container[str] = ()) -> SetupFile:
    """Load and check a set-up file.

    Args:
        path: path of the file.
        overridden: keys with other values on the command line, whose files need not
            exist.

    Raises:
        InputError: the file cannot be read.
        InputFileError: everything that is wrong with it, with line and column.
    """
    used = {loc: kind for loc, kind in _PATHS.items() if loc[-1] not in overridden}
    return load_model(SetupFile, require_file(path), used)


def setup_json_schema() -> dict[str, object]:
    """Return a schema (draft 2020-12) that knows every key with its title, description, unit and range."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema"
    } | SetupFile.model_json_schema()
