"""Set-up file that describes a lab for `srs-twin shadow --setup lab.yaml`.

Each key sets an option of `srs-twin shadow`. Options on the command line override the
file. A relative path is looked up first in the folder of the set-up file, and then in
the current folder.
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
    def check(given: str) -> str:
        try:
            links.address(given, port)
        except InputError as error:
            raise ValueError(str(error)) from None
        return given

    return AfterValidator(check)


class BrokerFile(Section):
    """Connection to an MQTT broker.

    The password is read from the environment variable SRS_TWIN_MQTT_PASSWORD.
    """

    address: Annotated[Line, _address_with(links.PORT)]
    """Address of the broker in the form HOST or HOST:PORT."""
    user: Line | None = None
    """User name (default: anonymous login)."""
    ca: FilePath | None = None
    """PEM file with the CA certificate that enables TLS (default: no TLS)."""


class MotionCaptureFile(Section):
    """Connection to a NatNet server, such as Motive."""

    address: Annotated[Line, _address_with(natnet.COMMAND_PORT)]
    """Address of the server's command port in the form HOST or HOST:PORT."""
    local: Line = "127.0.0.1"
    """Address of this machine to which the server sends frames."""
    up: Literal["y", "z"] = "y"
    """Upward axis of the motion capture system."""
    bodies: dict[Line, Connector] = {}
    """Connector number of each rigid body, counted from 1 at the head (default: the
    number at the end of a name such as connector_1)."""


class LimitsFile(Section):
    """Limits of a session."""

    duration_s: float | None = quantity(0.02, 1e7, None)
    """Maximum duration of a session (default: no limit)."""
    allow_zero_margin: bool = False
    """Whether the robot continues without a margin to obstacles instead of stopping."""


class SetupFile(Section):
    """Robot, equipment and session limits of a lab."""

    robot: PathOrName
    """Name of a shipped robot, or path of a robot file."""
    name: Annotated[str, Field(min_length=1, max_length=200)] | None = None
    """Name of the robot in the topics srs/NAME/KIND (default: name of the robot or
    file).
    """
    supply_kpa: float | None = quantity(0.1, 2000.0, None)
    """Gauge supply pressure (default: nominal supply pressure of the robot)."""
    broker: BrokerFile | None = None
    """MQTT broker (default: 127.0.0.1:1883)."""
    motion_capture: MotionCaptureFile | None = None
    """Motion capture server (default: no motion capture)."""
    limits: LimitsFile = LimitsFile()
    """Limits of a session."""

    @field_validator("name")
    @classmethod
    def _is_part_of_a_topic(cls, given: str | None) -> str | None:
        if given and re.search("[/+#]", given):
            raise ValueError(
                "the name cannot be part of an MQTT topic; use a name without the"
                " characters /, + and #"
            )
        return given

    def options(self) -> dict[str, Any]:
        """Return the values in the file, keyed by option of `srs-twin shadow`."""
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
            "allow_zero_margin": self.limits.allow_zero_margin,
        }
        return {name: value for name, value in values.items() if value is not None}


_PATHS: dict[Loc, str] = {("robot",): "robot", ("broker", "ca"): ""}
"""Keys of file paths, with the kind of shipped files that are also allowed by name."""


def load_setup(path: Path, overridden: Container[str] = ()) -> SetupFile:
    """Load and check a set-up file.

    Args:
        path: path of the set-up file.
        overridden: keys that the command line overrides. Files that are named by these
            keys need not exist.

    Raises:
        InputError: the file cannot be read.
        InputFileError: the file has errors. The message lists all errors with line and
            column.
    """
    used = {loc: kind for loc, kind in _PATHS.items() if loc[-1] not in overridden}
    return load_model(SetupFile, require_file(path), used)


def setup_json_schema() -> dict[str, object]:
    """Return the JSON schema (draft 2020-12) of set-up files."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema"
    } | SetupFile.model_json_schema()
