"""The sketch of a microcontroller in docs/live.md does what the page says of robots."""

from __future__ import annotations

import json
import sys
import types

import numpy as np
from conftest import ROOT
from pages import Page

from srs_twin.live.messages import BENDS, VALVES, decode, encode


class Over(Exception):
    """Ends the sketch's endless loop."""


def test_the_sketch_obeys_tells_and_vents_when_nobody_commands(monkeypatch):
    (sketch,) = [b for b in Page(ROOT / "docs/live.md").blocks if b.language == "py"]
    now, told, driven = [0], [], {}

    class Client:
        def __init__(self, *_, **__):
            self.heard = lambda topic, payload: None

        def set_callback(self, heard):
            self.heard = heard

        def set_last_will(self, topic, payload):
            told.append((topic, payload))

        def connect(self):
            pass

        def subscribe(self, topic):
            assert topic == b"srs/snake/command"

        def check_msg(self):
            if now[0] == 100:
                self.heard(b"srs/snake/command", encode("command", 0.1, np.tile([1.0, -1.0], (4, 1))))

        def publish(self, topic, payload):
            told.append((topic, payload))

    def sleep_ms(span):
        assert span == 20
        now[0] += 20
        if now[0] > 400:
            raise Over

    time = types.SimpleNamespace(ticks_ms=lambda: now[0], ticks_diff=lambda a, b: a - b, sleep_ms=sleep_ms)
    monkeypatch.setitem(sys.modules, "time", time)
    monkeypatch.setitem(sys.modules, "umqtt", types.ModuleType("umqtt"))
    monkeypatch.setitem(sys.modules, "umqtt.simple", types.SimpleNamespace(MQTTClient=Client))

    def valve(j, side, on):
        driven[now[0], j, side] = on

    scope = {"json": json, "valve": valve, "hall": lambda j: 0.1 * j}
    try:
        exec(sketch.text, scope)
    except Over:
        pass
    finally:
        monkeypatch.undo()
    filled = {at for (at, j, side), on in driven.items() if on and side == "+"}
    assert filled == set(range(100, 301, 20))
    assert not any(on for (_, _, side), on in driven.items() if side == "-")
    for topic, payload in told:
        kind = topic.decode().rpartition("/")[2]
        message = decode(kind, payload.encode() if isinstance(payload, str) else payload,
                         source="snake", arrived=0.0, segments=4)  # fmt: skip
        if kind == BENDS:
            assert message.values.tolist() == [0.0, 0.1, 0.2, 0.1 * 3]
        elif kind == VALVES:
            assert (message.values[:, 0] == (1 if round(message.sent * 1000) in filled else -1)).all()
