"""`srs-twin shadow`: the twin beside a running robot."""

from __future__ import annotations

import math
import signal
import threading
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from srs_twin.cli import say
from srs_twin.cli.emulate import broker_link
from srs_twin.cli.options import JsonOption, PressureOption, QuietOption, RobotArgument, option, print_json
from srs_twin.errors import InputError

if TYPE_CHECKING:
    from srs_twin.live.links import Link
    from srs_twin.live.mqtt import MqttLink


def shadow(
    robot: RobotArgument,
    mqtt: Annotated[str | None, option("--mqtt HOST:PORT")] = None,
    natnet: Annotated[str | None, option("--natnet HOST:PORT")] = None,
    mcap: Annotated[Path | None, option("--mcap FILE")] = None,
    out: Annotated[Path | None, option("--out DIR")] = None,
    follow: Annotated[str | None, option("--follow SCENARIO")] = None,
    name: Annotated[str | None, option("--name NAME")] = None,
    body: Annotated[list[str] | None, option("--body BODY=CONNECTOR")] = None,
    local: Annotated[str, option("--local ADDRESS")] = "127.0.0.1",
    up: Annotated[str, option("--up AXIS")] = "y",
    speed: Annotated[float, option("--speed X", min=0.01, max=1000.0)] = 1.0,
    pressure: PressureOption = None,
    members: Annotated[int, option("--members N", min=8, max=256)] = 32,
    seed: Annotated[int, option("--seed N", min=0)] = 0,
    window: Annotated[bool, option("--window")] = False,
    web: Annotated[bool, option("--web")] = False,
    duration: Annotated[float | None, option("--duration-s S", min=0.02)] = None,
    user: Annotated[str | None, option("--user NAME")] = None,
    ca: Annotated[Path | None, option("--ca FILE")] = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Run a twin beside a robot: state, next second, faults.

    Takes commands, bends and pressures over MQTT, frames of motion capture over NatNet, or all of them from a
    journal. With --follow it steers the robot by its estimate. docs/live.md describes the messages. The
    password of --user is taken from the environment variable SRS_TWIN_MQTT_PASSWORD.

    Options:
        mqtt: The broker. [default: 127.0.0.1:1883, or none with --mcap]
        natnet: Where motion capture answers. [default: none]
        mcap: A journal of an earlier session to play instead.
        out: Folder of journal, recording and results; what was learnt in it before is taken up.
        follow: A scenario whose follower steers the robot.
        name: Of the robot in topics. [default: ROBOT]
        body: Body of the motion capture and its connector, repeatable. [default: connector_1=1 …]
        local: Address of this machine on which frames arrive.
        up: Axis that is up in the frames, y or z.
        speed: How many times as fast a journal is played.
        members: Of the ensemble.
        seed: Of its draws.
        window: Show it in the window of Rerun.
        web: Show it on a page of this machine.
        duration: Ends it. [default: Ctrl-C does]
        user: At the broker.
        ca: CA certificate file (PEM); enables TLS.
    """
    from srs_twin.io.files import made_folder, open_folder
    from srs_twin.live import natnet as protocol
    from srs_twin.live.helm import Helm
    from srs_twin.live.journal import McapLink
    from srs_twin.live.links import address
    from srs_twin.live.optitrack import NatNetLink
    from srs_twin.live.session import KEPT, TICK_S, Session, warm_up
    from srs_twin.live.shadow import Shadow, frames_of
    from srs_twin.robot.file import load_robot
    from srs_twin.scenario import load_scenario

    if out is not None:
        open_folder(out, KEPT)
    if mcap is not None and (mqtt is not None or natnet is not None or follow is not None):
        raise InputError("--mcap plays what has been; --mqtt, --natnet and --follow are for a running robot")
    spec, known = load_robot(robot), name or Path(robot).stem
    frames = frames_of(body, spec.geometry.connectors) if body else None
    supply = None if pressure is None else pressure * 1000
    twin = Shadow(spec, supply_pa=supply, members=members, seed=seed, frames=frames)
    helm = Helm(load_scenario(follow), twin, TICK_S) if follow else None
    warm_up(spec)
    over = threading.Event()
    for ends in (signal.SIGINT, signal.SIGTERM):
        signal.signal(ends, lambda *_: over.set())
    with ExitStack() as stack:
        links: list[Link] = []
        commands: MqttLink | None = None
        if mcap is not None:
            links.append(stack.enter_context(McapLink(mcap, known, spec.segments, speed=speed)))
        else:
            commands = stack.enter_context(
                broker_link(
                    known,
                    spec.segments,
                    "127.0.0.1:1883" if mqtt is None else mqtt,
                    user,
                    ca,
                    speaks=known if helm else None,
                )
            )
            links.append(commands)
        if natnet is not None:
            host, port = address(natnet, protocol.COMMAND_PORT)
            links.append(stack.enter_context(NatNetLink(host, port, local=local, up=up)))
        views, shown = [], ""
        if out is not None:
            stack.enter_context(made_folder(out))
        if window or web or out is not None:
            from srs_twin.viewing.rerun.live import live_view

            keep = None if out is None else _recording(out)
            view, shown = stack.enter_context(live_view(spec, keep=keep, window=window, web=web))
            views.append(view)
        session = Session(twin, links, out=out, helm=helm, commands=commands, views=views)
        if not quiet:
            say(f"beside {known}{', with what was learnt before' if session.resumed else ''}; Ctrl-C ends it")
            if shown:
                say(f"open {shown} in a browser")
        told = session.run(math.inf if duration is None else duration, over.is_set)
    if as_json:
        print_json(told)
    elif not quiet:
        _tell(told)


def _recording(out: Path) -> Path:
    """Return where the session's recording goes: one a session, as journals."""
    number = 1
    while (out / f"recording-{number}.rrd").exists():
        number += 1
    return out / f"recording-{number}.rrd"


def _tell(told: dict[str, Any]) -> None:
    ticks, latency = told["tick_ms"], told["latency_ms"]
    if ticks["median"] is not None:
        say(f"{told['seconds']:.1f} s, ticks of {ticks['median']:.1f} ms, 99 % below {ticks['p99']:.1f} ms")
    if latency["median"] is not None:
        say(f"readings are {latency['median']:.0f} ms old when they are used")
    if "estimate" not in told:
        say("nothing was heard of the robot")
        return
    found = told["estimate"]
    x, y, heading = found["pose"]
    a, b, c = (1.96 * each for each in found["pose_sd"])
    say(f"at x {x:.3f} ± {a:.3f} m, y {y:.3f} ± {b:.3f} m, heading {heading:.2f} ± {c:.2f} rad"
        f"{', but ' + found['lost'] if found['lost'] else ''}")  # fmt: skip
    for each in told["faults"]:
        say(f"{each['time_s']:.1f} s: {each['part']}: {each['fault']}")
    if "following" in told:
        say(f"following ended: {told['following']['ending']}")
