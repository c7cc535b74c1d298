"""Command `srs-twin shadow`, which runs the live twin of a robot."""

from __future__ import annotations

import math
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from srs_twin.cli.console import say
from srs_twin.cli.options import (
    JsonOption,
    PressureOption,
    QuietOption,
    argument,
    option,
    print_json,
)
from srs_twin.errors import InputError
from srs_twin.live.emulate_command import broker_link, interruption, say_losses

if TYPE_CHECKING:
    from srs_twin.live.links import Link, MqttLink
    from srs_twin.live.optitrack import NatNetLink
    from srs_twin.live.session import Session, View
    from srs_twin.live.shadow import Shadow
    from srs_twin.live.steering import EstimateSteering
    from srs_twin.robot.spec import RobotSpec

BROKER = "127.0.0.1:1883"

_NEEDED = {
    "local": ("natnet",),
    "up": ("natnet",),
    "body": ("natnet", "mcap"),
    "allow_zero_margin": ("follow",),
    "speed": ("mcap",),
}
"""For each option, the options of which at least one is required."""


@dataclass(frozen=True)
class LabOptions:
    """Options of `srs-twin shadow` that a set-up file may also contain.

    Options:
        robot: Name of a shipped robot, or path of a robot file. [default: from --setup]
        mqtt: Address of the MQTT broker. [default: 127.0.0.1:1883, or none with --mcap]
        natnet: Address of the motion capture server (NatNet). [default: none]
        name: Name of the robot in the MQTT topics. [default: ROBOT]
        body: Name of a rigid body in motion capture, and number of its connector,
            counted from 1 at the head. Can be repeated. [default:
            connector_1=1 and so on]
        local: Address of this machine to which the motion capture server sends frames.
        up: Upward axis of the motion capture system (y or z).
        allow_zero_margin: Continue without a margin to the obstacles, instead of
            stopping, if no path has a margin (see docs/live.md#steering).
        duration: Stop after this many seconds. [default: run until Ctrl-C]
        user: User name for the MQTT broker.
        ca: PEM file with the CA certificate of the MQTT broker, which enables TLS.
    """

    robot: Annotated[str | None, argument("ROBOT", shipped=["robot"])] = None
    mqtt: Annotated[str | None, option("--mqtt HOST:PORT")] = None
    natnet: Annotated[str | None, option("--natnet HOST:PORT")] = None
    name: Annotated[str | None, option("--name NAME")] = None
    body: Annotated[list[str] | None, option("--body BODY=CONNECTOR")] = None
    local: Annotated[str, option("--local ADDRESS")] = "127.0.0.1"
    up: Annotated[Literal["y", "z"], option("--up AXIS")] = "y"
    pressure: PressureOption = None
    allow_zero_margin: Annotated[bool, option("--allow-zero-margin")] = False
    duration: Annotated[float | None, option("--duration S", min=0.02)] = None
    user: Annotated[str | None, option("--user NAME")] = None
    ca: Annotated[Path | None, option("--ca FILE")] = None

    def with_setup(self, path: Path, context: typer.Context) -> LabOptions:
        """Return these options with values from a set-up file.

        Options on the command line override the file.

        Raises:
            InputError: the file cannot be read or has errors.
        """
        from srs_twin.live.setup_file import load_setup

        given = [name for name in context.params if _is_given(context, name)]
        values = load_setup(path, given).options()
        for name in given:
            values.pop(name, None)
        return replace(self, **values)

    @property
    def topic_name(self) -> str:
        """Name of the robot in the MQTT topics."""
        return Path(str(self.robot)).stem if self.name is None else self.name


@dataclass(frozen=True)
class SessionOptions:
    """Session options of `srs-twin shadow`.

    Options:
        setup: YAML file with the options of your lab (see `srs-twin schema setup`).
            Options on the command line override the file. [default: none]
        mcap: Journal of an earlier session, which is replayed instead of receiving
            live messages.
        speed: Playback speed of the journal relative to real time.
        out: Output folder. If an earlier session saved its state in this folder, the
            state is restored.
        follow: Scenario whose planned path the robot follows (name of a shipped
            scenario, or path of a file).
        members: Number of ensemble members in the state estimator.
        seed: Seed of the random number generator.
        window: Show the live view in a Rerun window.
        web: Show the live view in a browser on this machine.
    """

    setup: Annotated[Path | None, option("--setup FILE.yaml")] = None
    mcap: Annotated[Path | None, option("--mcap FILE")] = None
    speed: Annotated[float, option("--speed X", min=0.01, max=1000.0)] = 1.0
    out: Annotated[Path | None, option("--out DIR")] = None
    follow: Annotated[str | None, option("--follow SCENARIO")] = None
    members: Annotated[int, option("--members N", min=8, max=256)] = 32
    seed: Annotated[int, option("--seed N", min=0)] = 0
    window: Annotated[bool, option("--window")] = False
    web: Annotated[bool, option("--web")] = False

    @property
    def keys(self) -> str:
        """Text that describes the keys for controlling the session."""
        if self.mcap is not None:
            return ""
        if self.follow is not None:
            return "; keys: p pauses, v vents, g goes on, s stops"
        return "; s stops"


def shadow(
    context: typer.Context,
    lab: LabOptions,
    options: SessionOptions,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Estimate the state of a running robot and detect faults.

    The live twin receives commands, bends and pressures over MQTT, and motion capture
    frames over NatNet. With --mcap, it reads these messages from a journal instead. The
    live twin also predicts the motion and, with --follow, steers the robot along a
    path. The session is controlled with the keys p (pause), g (go), v (vent) and s
    (stop), or with the words pause, go, vent and stop on the topic srs/NAME/control.
    The messages are described in docs/live.md. The MQTT password is read from the
    environment variable SRS_TWIN_MQTT_PASSWORD.
    """
    from threadpoolctl import threadpool_limits

    from srs_twin.io.files import make_folder
    from srs_twin.robot.file import load_robot

    lab = _checked(lab, options, context)
    # BLAS uses a single thread, because the matrices are too small for several threads.
    threadpool_limits(limits=1, user_api="blas")
    twin, steering = _twin(load_robot(str(lab.robot)), lab, options)
    over = interruption()
    with ExitStack() as stack:
        if options.out is not None:
            stack.enter_context(make_folder(options.out))
        session, page = _session(stack, lab, options, twin, steering)
        if not quiet:
            _print_start(lab.topic_name, session.resumed, options.keys, page)
        result: dict[str, Any] = session.run(lab.duration or math.inf, over.is_set)
    if as_json:
        print_json(result)
    elif not quiet:
        _print_result(result)
        say_losses(result["messages"].get("disconnected", 0))
    if "estimate" not in result:
        sources = " and ".join(filter(None, (lab.mqtt or BROKER, lab.natnet)))
        raise InputError(
            f"no messages of the robot '{lab.topic_name}' arrived from"
            f" {options.mcap or sources} in {result['seconds']:.0f} s; check that the"
            " robot is running, and that its name and its number of segments are"
            " right"
        )


def _checked(
    lab: LabOptions, options: SessionOptions, context: typer.Context
) -> LabOptions:
    from srs_twin.io.files import check_output_folder, require_file
    from srs_twin.live.session import KEPT

    of_a_robot = lab.mqtt, lab.natnet, options.follow
    if options.mcap is not None and any(given is not None for given in of_a_robot):
        raise InputError(
            "--mcap replays a recorded journal, but --mqtt, --natnet and --follow need"
            " a running robot; remove --mcap or the other options"
        )
    if options.setup is not None:
        lab = lab.with_setup(options.setup, context)
    if lab.robot is None:
        raise InputError(
            "no robot is given; give ROBOT, or use --setup with a set-up file that names"
            " the robot"
        )
    values = vars(lab) | vars(options)
    for name, needed in _NEEDED.items():
        if _is_given(context, name) and not any(values[other] for other in needed):
            raise InputError(
                f"--{name.replace('_', '-')} has no effect without"
                f" --{' or --'.join(needed)}; add that option or remove this one"
            )
    if options.mcap is not None:
        require_file(options.mcap, suffix=".mcap")
    if options.out is not None:
        check_output_folder(options.out, KEPT)
    return lab


def _is_given(context: typer.Context, name: str) -> bool:
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"


def _twin(
    spec: RobotSpec, lab: LabOptions, options: SessionOptions
) -> tuple[Shadow, EstimateSteering | None]:
    from srs_twin.live.session import TICK_S, warm_up
    from srs_twin.live.shadow import Shadow, frames_of
    from srs_twin.live.steering import EstimateSteering
    from srs_twin.scenario.loading import load_scenario

    twin = Shadow(
        spec,
        supply_pa=None if lab.pressure is None else lab.pressure * 1000,
        members=options.members,
        seed=options.seed,
        frames=frames_of(lab.body or (), spec.geometry.connectors),
    )
    steering = None
    if options.follow:
        steering = EstimateSteering(
            load_scenario(options.follow),
            twin,
            TICK_S,
            allow_zero_margin=lab.allow_zero_margin,
        )
    warm_up(spec)
    return twin, steering


def _session(
    stack: ExitStack,
    lab: LabOptions,
    options: SessionOptions,
    twin: Shadow,
    steering: EstimateSteering | None,
) -> tuple[Session, str]:
    from srs_twin.live.journal import McapLink
    from srs_twin.live.links import typed_words
    from srs_twin.live.session import Keys, Session

    links: list[Link] = []
    commands: MqttLink | None = None
    keys: Keys = tuple
    if options.mcap is not None:
        journal = McapLink(
            options.mcap, lab.topic_name, twin.spec.segments, speed=options.speed
        )
        links.append(stack.enter_context(journal))
    else:
        commands = broker_link(
            lab.topic_name,
            twin.spec.segments,
            lab.mqtt or BROKER,
            lab.user,
            lab.ca,
            speaks=lab.topic_name if steering else None,
        )
        links.append(stack.enter_context(commands))
        if lab.natnet is not None:
            links.append(stack.enter_context(_motion_capture(lab.natnet, lab)))
        keys = stack.enter_context(typed_words())
    views, page = _live_views(stack, options, twin.spec)
    session = Session(
        twin,
        links,
        out=options.out,
        steering=steering,
        commands=commands,
        views=views,
        keys=keys,
    )
    return session, page


def _motion_capture(natnet: str, lab: LabOptions) -> NatNetLink:
    from srs_twin.live.links import address
    from srs_twin.live.natnet import COMMAND_PORT
    from srs_twin.live.optitrack import NatNetLink

    host, port = address(natnet, COMMAND_PORT)
    return NatNetLink(host, port, local=lab.local, up=lab.up)


def _live_views(
    stack: ExitStack, options: SessionOptions, spec: RobotSpec
) -> tuple[list[View], str]:
    if not (options.window or options.web or options.out):
        return [], ""
    from srs_twin.io.files import create_numbered_file
    from srs_twin.live.session import RECORDINGS
    from srs_twin.viewing.rerun.viewer import require_rerun

    require_rerun()
    from srs_twin.viewing.rerun.live import live_view

    recording = None
    if options.out is not None:
        recording = create_numbered_file(options.out, RECORDINGS)
    view, page = stack.enter_context(
        live_view(spec, recording=recording, window=options.window, web=options.web)
    )
    return [view], page


def _print_start(name: str, resumed: bool, keys: str, page: str) -> None:
    restored = ", with its earlier state" if resumed else ""
    say(f"live twin of {name}{restored}; Ctrl-C stops it{keys}")
    if page:
        say(f"open {page} in a browser")


def _print_result(result: dict[str, Any]) -> None:
    ticks = result["tick_ms"]
    latency = result["latency_ms"]
    if ticks["median"] is not None:
        say(
            f"{result['seconds']:.1f} s, ticks of {ticks['median']:.1f} ms, 99 % below"
            f" {ticks['p99']:.1f} ms"
        )
    if latency["median"] is not None:
        say(f"readings are {latency['median']:.0f} ms old when they are used")
    if "estimate" not in result:
        return
    estimate = result["estimate"]
    x, y, heading = estimate["pose"]
    x_sd, y_sd, heading_sd = estimate["pose_sd"]
    lost = f", but {estimate['lost']}" if estimate["lost"] else ""
    say(
        f"at x {x:.3f} ± {1.96 * x_sd:.3f} m, y {y:.3f} ± {1.96 * y_sd:.3f} m,"
        f" heading {heading:.2f} ± {1.96 * heading_sd:.2f} rad{lost}"
    )
    for fault in result["faults"]:
        say(f"{fault['time_s']:.1f} s: {fault['part']}: {fault['fault']}")
    if "following" not in result:
        return
    if result["following"]["seconds"]:
        say(f"following ended: {result['following']['ending']}")
    else:
        say("following did not begin")
