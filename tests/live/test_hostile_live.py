"""Hostile messages and packets are ignored, counted and named, and a valid command is obeyed in one tick."""

from __future__ import annotations

import json
from random import Random
from types import SimpleNamespace

import hostile_messages as hostile
import numpy as np
import pytest
from test_emulator import Bench
from test_safe_exits import Steering, Wire, simulated_machine

from srs_twin import load_robot
from srs_twin.live import emulator
from srs_twin.live.links import MqttLink, clock
from srs_twin.live.messages import BENDS, COMMAND, CONTROL, encode, topic
from srs_twin.live.optitrack import NatNetLink, NatNetServer
from srs_twin.live.session import Session, warm_up
from srs_twin.live.shadow import Shadow

SEGMENTS = 4


class Client:
    """Replacement of paho's client that accepts every connection and keeps published messages."""

    def __init__(self, *_) -> None:
        self.sent: list[tuple[float, str, bytes]] = []

    def connect(self, *_, **__) -> None:
        self.on_connect(self, None, None, SimpleNamespace(is_failure=False), None)

    def publish(self, topic: str, payload: bytes) -> SimpleNamespace:
        self.sent.append((clock(), topic, payload))
        return SimpleNamespace(wait_for_publish=lambda _: None)

    def __getattr__(self, name: str):
        return lambda *_, **__: None


@pytest.fixture
def link(monkeypatch):
    monkeypatch.setattr("paho.mqtt.client.Client", Client)
    with MqttLink("robot", SEGMENTS) as link:
        yield link


def deliver(link: MqttLink, kind: str, payload: bytes, retained: bool = False) -> None:
    link._on_message(
        None,
        None,
        SimpleNamespace(topic=topic("robot", kind), payload=payload, retain=retained),
    )


def named(link) -> int:
    """Return how many were refused; each has a reason, and reasons are few."""
    reasons = {
        what: count for what, count in link.counts.items() if what.startswith("bad: ")
    }
    assert "bad: for other reasons" not in reasons and len(reasons) < 40
    # Nothing but a reason that was foreseen; names of exceptions have no blank in them.
    assert all(" " in what.removeprefix("bad: ") for what in reasons), reasons
    return sum(reasons.values())


COUNT = 200


def test_a_session_ignores_hostile_messages_and_obeys_a_stop(link, monkeypatch):
    draw = Random(COUNT)
    simulated_machine(monkeypatch)
    monkeypatch.setattr(NatNetLink, "_start", lambda _: None)
    with NatNetServer({}) as server, NatNetLink(port=server.port) as eyes:
        sender = "127.0.0.1", server.port
        eyes._threads.clear()
        eyes._arrived(hostile.natnet.write_server(), sender)
        warm_up(load_robot("gen4"))
        shadow = Shadow(load_robot("gen4"), members=8)
        wire = Wire(SEGMENTS)
        session = Session(
            shadow, [wire, link, eyes], steering=Steering(), commands=link
        )
        told = {"messages": 0, "packets": 0, "times": 0, "stop": 0.0}

        def stop() -> bool:
            """Deliver twenty of each between two ticks; at the end a stop, and nothing after it."""
            if len(session.ticks) < 10 or told["stop"]:
                return False
            if told["messages"] >= COUNT:
                deliver(link, CONTROL, b"stop")
                told["stop"] = clock()
                return False
            for _ in range(20):
                deliver(link, *hostile.message(draw, SEGMENTS))
                eyes._arrived(*hostile.packet(draw, sender))
                told["messages"] += 1
                told["packets"] += 1
            # In bounds, and no time of the robot's clock.
            wrong = hostile.valid(BENDS, SEGMENTS, draw.uniform(1e7, 8e9))
            deliver(link, BENDS, json.dumps(wrong).encode())
            told["times"] += 1
            return False

        found = session.run(60.0, stop)
    assert named(link) == told["messages"] >= COUNT
    assert named(eyes) == told["packets"]
    assert found["dropped"]["bends off its clock"] == told["times"]
    assert found["error"] is None and found["problems"] == []
    assert found["seconds"] < 59 and not found["estimate"]["lost"]
    assert np.abs(found["estimate"]["bend_rad"]).max() < 0.05
    after = [
        json.loads(each)
        for at, name, each in link._client.sent
        if at > told["stop"] and COMMAND in name
    ]
    assert after and all(
        each["plus"] == each["minus"] == [-1] * SEGMENTS for each in after
    )


def test_a_robot_ignores_hostile_messages_and_obeys_a_command_within_one_tick(
    link, monkeypatch
):
    draw = Random(COUNT)
    bench = Bench(monkeypatch)
    whole = bench._sleep

    def sleep(seconds: float) -> None:
        whole(seconds)
        if bench.now > 101.0 and not named(link):
            for _ in range(COUNT):
                deliver(link, *hostile.message(draw, SEGMENTS))
            monkeypatch.setattr("srs_twin.live.links.clock", lambda: bench.now)
            deliver(link, COMMAND, encode(COMMAND, 1.0, np.ones((SEGMENTS, 2))))

    monkeypatch.setattr(emulator, "time", SimpleNamespace(sleep=sleep))
    emulator.emulate(bench, link, None, duration=2.0)
    assert named(link) == COUNT
    first = next(at for at, obeys in bench.obeyed if obeys)
    assert 101.0 < first < 101.0 + 2 * bench.tick
