"""Command `srs-twin emulate`, which runs an emulated robot."""

from __future__ import annotations

import math
import os
import signal
import threading
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from srs_twin.cli.console import handle_signals, say
from srs_twin.cli.options import (
    JsonOption,
    PressureOption,
    QuietOption,
    RobotArgument,
    option,
    print_json,
)
from srs_twin.errors import InputError, InputFileError

if TYPE_CHECKING:
    from srs_twin.live.emulator import EmulatedRobot
    from srs_twin.live.links import MqttLink
    from srs_twin.live.optitrack import NatNetServer

PASSWORD = "SRS_TWIN_MQTT_PASSWORD"  # noqa: S105
"""Name of the environment variable that contains the MQTT password."""


_LONGEST_NAME = 200

_OPTION_NAMES = {
    "emulate: supply.pressure_kpa": "--pressure",
    "emulate: pneumatics.kind": "--chambers",
    ", or set `allow_overpressure: true`": "",
}
"""Texts in messages of scenario files, with their replacements for this command."""


def broker_link(
    robot: str,
    segments: int,
    address: str,
    user: str | None,
    ca: Path | None,
    **settings: Any,
) -> MqttLink:
    """Connect to the topics of a robot on an MQTT broker.

    Raises:
        InputError: the robot name cannot be part of a topic, or the broker does not
            answer.
    """
    from srs_twin.live import links

    if set(robot) & set("/+#") or not 0 < len(robot) <= _LONGEST_NAME:
        raise InputError(
            f"--name {robot[:80]!r} cannot be part of an MQTT topic; use a name"
            f" of 1 to {_LONGEST_NAME} characters without /, + and #"
        )
    host, port = links.address(address, links.PORT)
    broker = links.BrokerAccess(host, port, user, os.environ.get(PASSWORD), ca)
    return links.MqttLink(robot, segments, broker, **settings)


def interruption() -> threading.Event:
    """Return an event that is set when Ctrl-C, SIGTERM or SIGHUP is received."""
    over = threading.Event()
    handle_signals(lambda *_: over.set(), signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    return over


@dataclass(frozen=True)
class EmulationOptions:
    """Options of the simulated robot.

    Options:
        seed: Seed of the random number generator for module properties, sensor noise,
            message loss and message delay.
        fault: Fault to inject, with its location and start time in seconds, for example
            stuck_valve:2+@5, dead_sensor:1@8 or leak:3-=fast@2. Can be repeated.
        spread: Relative standard deviation of the bending gains of the modules.
        noise: Standard deviation of the bend sensor noise in rad.
        chambers: Pneumatic model, either orifice (compressible flow) or lag
            (first-order lag). [default: orifice, or lag for spatial robots]
        start: Initial position in metres and initial heading in rad, for example
            --start=0.2,-0.1,0.5.
    """

    seed: Annotated[int, option("--seed N", min=0)] = 0
    fault: Annotated[list[str] | None, option("--fault FAULT")] = None
    spread: Annotated[float, option("--gain-spread S", min=0.0, max=0.5)] = 0.1
    noise: Annotated[float, option("--noise-rad S", min=0.0, max=1.0)] = 0.02
    chambers: Annotated[str | None, option("--chambers NAME")] = None
    pressure: PressureOption = None
    start: Annotated[str, option("--start X,Y,HEADING")] = "0,0,0"

    def emulated(self, robot: str) -> EmulatedRobot:
        """Create an emulated robot with these options.

        Raises:
            InputError: the robot does not exist, or an option is invalid.
        """
        from srs_twin.live.emulator import EmulatedRobot, Simulation

        try:
            return EmulatedRobot(
                robot,
                Simulation(
                    gain_spread=self.spread,
                    pneumatics=self.chambers,
                    supply_kpa=self.pressure,
                ),
                seed=self.seed,
                faults=self.fault or (),
                noise_rad=self.noise,
                start=_pose(self.start),
            )
        except InputFileError as error:
            text = str(error)
            for key, replacement in _OPTION_NAMES.items():
                text = text.replace(key, replacement)
            raise InputError(text) from error


@dataclass(frozen=True)
class MessageOptions:
    """Message options of an emulated robot.

    Options:
        loss: Probability that a message is lost.
        jitter: Maximum random delay of a message in seconds.
        publish_supply: Also publish the supply pressure.
        duration: Stop after this many seconds. [default: run until Ctrl-C]
        user: User name for the MQTT broker.
        ca: PEM file with the CA certificate of the MQTT broker. This option enables
            TLS.
    """

    loss: Annotated[float, option("--loss FRACTION", min=0.0, max=0.99)] = 0.0
    jitter: Annotated[float, option("--jitter-s S", min=0.0, max=5.0)] = 0.0
    publish_supply: Annotated[bool, option("--publish-supply")] = False
    duration: Annotated[float | None, option("--duration S", min=0.02)] = None
    user: Annotated[str | None, option("--user NAME")] = None
    ca: Annotated[Path | None, option("--ca FILE")] = None


def emulate(
    robot: RobotArgument,
    mqtt: Annotated[str, option("--mqtt HOST:PORT")] = "127.0.0.1:1883",
    natnet: Annotated[str | None, option("--natnet HOST:PORT")] = None,
    name: Annotated[str | None, option("--name NAME")] = None,
    simulated: EmulationOptions = EmulationOptions(),
    messages: MessageOptions = MessageOptions(),
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Emulate a robot that communicates over MQTT and NatNet.

    The emulated robot is a MuJoCo simulation with unequal modules, sensor noise and
    optional faults. The robot executes valve commands and publishes bends, pressures,
    valve states and poses in real time. The messages are described in docs/live.md. The
    password of the MQTT user is read from the environment variable
    SRS_TWIN_MQTT_PASSWORD.

    Options:
        mqtt: Address of the MQTT broker.
        natnet: Local address at which NatNet frames are served.
            [default: no motion capture]
        name: Name of the robot in the MQTT topics. [default: ROBOT]
    """
    from srs_twin.live.emulator import Transport, emulate as run
    from srs_twin.live.messages import COMMAND

    emulated = simulated.emulated(robot)
    known = Path(robot).stem if name is None else name
    over = interruption()
    with ExitStack() as stack:
        link = stack.enter_context(
            broker_link(
                known,
                emulated.segments,
                mqtt,
                messages.user,
                messages.ca,
                speaks=known,
                kinds=(COMMAND,),
                chambers=emulated.spatial_chambers,
            )
        )
        capture = None
        seen = ""
        if natnet is not None:
            server = _motion_capture(natnet, emulated.segments + 1)
            capture = stack.enter_context(server)
            seen = f", seen at {natnet}"
        if not quiet:
            say(f"emulating {known} at {mqtt}{seen}; Ctrl-C stops it")
        result = run(
            emulated,
            link,
            capture,
            transport=Transport(messages.loss, messages.jitter, simulated.seed),
            stop=over.is_set,
            duration=messages.duration or math.inf,
            publishes_supply=messages.publish_supply,
        )
    if as_json:
        print_json(result)
    elif not quiet:
        ticks = f"{result['ticks']:.0f} ticks of {emulated.tick:g} s"
        say(f"{ticks}, {result['late']:.0f} of them late")
        say_losses(result["disconnected"])


def say_losses(count: float) -> None:
    """Print how often the connection to the broker was lost, if it was lost."""
    if count:
        say(f"lost connections to the broker: {count:.0f}")


def _motion_capture(given: str, connectors: int) -> NatNetServer:
    from srs_twin.live import natnet
    from srs_twin.live.links import address
    from srs_twin.live.optitrack import NatNetServer

    host, port = address(given, natnet.COMMAND_PORT)
    return NatNetServer(
        {i: f"connector_{i}" for i in range(1, connectors + 1)}, host=host, port=port
    )


def _pose(text: str) -> tuple[float, float, float]:
    try:
        x, y, heading = (float(number) for number in text.split(","))
    except ValueError:
        x = y = heading = math.nan
    if not math.isfinite(x + y + heading):
        raise InputError(
            f"--start '{text}' is not a pose; give x and y in m and the heading in"
            " rad, for example --start=0.2,-0.1,0.5"
        )
    return x, y, heading
