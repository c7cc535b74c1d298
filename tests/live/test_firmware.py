"""The firmware of examples/firmware, the files themselves: run by MicroPython, with a real broker."""

from __future__ import annotations

import contextlib
import json
import math
import os
import socket
import subprocess
import threading
import time

import firmware_rig
import numpy as np
import pytest
from benchmark_runs import run_script
from brokers import needs_broker, wait
from firmware_rig import (
    FIRMWARE,
    HOLD_S,
    NAME,
    SEGMENTS,
    WATCHDOG_S,
    Cause,
    Rig,
    lay,
    micropython,
)

from srs_twin.live.links import LOST, MqttLink
from srs_twin.live.messages import (
    BENDS,
    COMMAND,
    LARGEST_BYTES,
    STATUS,
    VALVES,
    encode,
    topic,
)

pytestmark = pytest.mark.skipif(
    micropython() is None, reason="MicroPython's Unix port is not installed"
)

ALL_OPEN = np.ones((SEGMENTS, 2))
SLACK_S = 0.2  # the bound asked for: after a command's expiry


def evaluate(code: str, given=None, folder=None):
    """Run code in MicroPython next to the firmware; return its variable `result`."""
    prologue = (
        "import sys, json\nsys.path.insert(0, sys.argv[1])\ngiven ="
        " json.load(open(sys.argv[2]))\n"
    )
    file = folder / "code.py"
    data = folder / "given.json"
    file.write_text(prologue + code + "\nprint(json.dumps(result))\n", "utf-8")
    data.write_text(json.dumps(given), "utf-8")
    command = micropython()
    assert command is not None
    done = subprocess.run(
        [*command, str(file), str(FIRMWARE), str(data)],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return json.loads(done.stdout.splitlines()[-1])


DECODE = """
from commands import decode
result = []
for payload in given:
    try:
        result.append(decode(payload.encode(), 2))
    except ValueError as error:
        result.append(str(error))
"""


def test_commands_of_the_shadow_are_decoded_exactly(tmp_path):
    states = np.array([[1.0, -1.0], [-1.0, 1.0]])
    duties = np.array([[0.25, 0.0], [0.0, 1.0]])
    times = (0.0, 1e-5, 0.02, 123456.789, 1795715650.123, -3.5, 1e11)
    given = [
        encode(COMMAND, at, values).decode()
        for at in times
        for values in (states, duties)
    ]
    fractions = ([[1, 0], [0, 1]], [[0.25, 0], [0, 1]])
    found = evaluate(DECODE, given, tmp_path)
    for k, (sent, plus, minus) in enumerate(found):
        assert sent == int(np.floor(times[k // 2] * 1000 + 1e-6))
        assert [plus, minus] == fractions[k % 2]


VALID = {"t": 1, "plus": [1, 1], "minus": [1, 1]}
BAD = (
    "",
    "[]",
    "3",
    "[" * 2000,
    "{" * 50,
    *(json.dumps(VALID | {"t": wrong}) for wrong in (math.nan, math.inf, True, "1")),
    *(
        json.dumps(VALID | {"plus": wrong})
        for wrong in (
            [1],
            [1, 1, 1],
            [1, math.nan],
            [1, "1"],
            [1, True],
            [1, None],
            [1, 2],
            "11",
            {"0": 1, "1": 1},
        )
    ),
    '{"t": 1e400, "plus": [1, 1], "minus": [1, 1]}',
    '{"t": 1, "plus": [1, 1]}',
    '{"t": 1, "plus": [1, 1], "minus": [1, 1e999]}',
    '{"a": {"t": 5}, "t": 6, "plus": [1, 1], "minus": [1, 1]}',
)


def test_payloads_that_are_no_commands_are_refused_with_a_reason(tmp_path):
    found = evaluate(DECODE, BAD, tmp_path)
    assert [each for each in found if not isinstance(each, str)] == []


def test_uptime_passes_the_wrap_around_of_ticks(tmp_path):
    code = """
from uptime import Uptime
PERIOD = 1 << 30
now = [PERIOD - 50]
uptime = Uptime(lambda: now[0] % PERIOD, lambda a, b: (a - b + PERIOD // 2) % PERIOD - PERIOD // 2)
result = []
for step in given:
    now[0] += step
    result.append(uptime.ms())
"""
    steps = [0, 20, 40, 500_000_000, 500_000_000, 500_000_000]
    assert evaluate(code, steps, tmp_path) == np.cumsum(steps).tolist()


OBEY = """
from commands import Commands
commands, result = Commands(1), []
for now, sent, *state in given:
    if sent is not None:
        plus = state[0] if state else 1
        payload = '{"t": %d.%03d, "plus": [%d], "minus": [-1]}' % (sent // 1000, sent % 1000, plus)
        commands.take(payload.encode(), now)
    result.append(commands.valves(now)[0][0])
"""


def live(start: int, stop: int, shift: int = 0):
    """(arrival, time of the controller) of commands every 20 ms that arrive at once, ms."""
    return [(now, now - shift) for now in range(start, stop, 20)]


def obeyed(tmp_path, events):
    """Return the (arrival, time of the command) at which the valve fills."""
    states = evaluate(OBEY, events, tmp_path)
    return [event for event, state in zip(events, states, strict=True) if state]


def test_a_command_holds_for_the_hold_time_after_it_was_sent_and_not_longer(tmp_path):
    late = [(2060, 2020 - 77)]  # 40 ms late
    silence = [(now, None) for now in range(2061, 2400)]
    filled = obeyed(tmp_path, live(1000, 2001, 77) + late + silence)
    assert filled[0][0] == 1300  # settled
    assert filled[-1][0] == 2020 + 199


def test_an_older_command_does_not_replace_a_newer_one(tmp_path):
    late = [(2010, 1980, -1), (2011, 2000, -1)]
    filled = obeyed(tmp_path, live(1000, 2001) + late)
    assert filled[-1] == late[-1]


def test_repeated_and_older_commands_do_not_prolong_the_hold(tmp_path):
    again = [
        (now, 2000 - 20 * k)
        for now, k in zip(range(2010, 2400, 10), range(39), strict=False)
    ]
    filled = obeyed(tmp_path, live(1000, 2001) + again)
    assert filled[-1][0] < 2200


def stalled(stall_ms: int, rate: float):
    """Events of a link that stalls and then delivers its backlog at several times the rate of sending."""
    end = 3000 + stall_ms
    sent = list(range(3000, 3000 + int(stall_ms / (1 - 1 / rate)), 20))
    arrivals = [max(at, end + int((at - 3000) / rate)) for at in sent]
    after = max(arrivals[-1], sent[-1]) + 20
    return (
        live(1000, 3000)
        + list(zip(arrivals, sent, strict=True))
        + live(after, after + 2000)
    )


@pytest.mark.parametrize("stall_ms", [500, 1500, 20_000])
def test_commands_delivered_late_after_a_stall_open_no_valve(tmp_path, stall_ms):
    for rate in (1.2, 2, 1000):
        events = stalled(stall_ms, rate)
        filled = obeyed(tmp_path, events)
        assert max(now - sent for now, sent in filled) <= 1000 * HOLD_S
        assert filled[-1] == events[-1]  # and it obeys again


def test_a_controller_that_restarts_with_another_clock_is_obeyed_again(tmp_path):
    for clock in (-5_000_000, -500, 500, 5_000_000):
        events = live(6_001_000, 6_003_000) + live(6_003_100, 6_006_000, clock)
        assert obeyed(tmp_path, events)[-1] == events[-1]


def test_a_valve_changes_from_duties_to_states_and_vents_at_import(
    tmp_path, monkeypatch
):
    lay(tmp_path, 1883)
    log = tmp_path / "log"
    monkeypatch.setenv("FIRMWARE_LOG", str(log))
    code = """
import board
for share in given:
    board.set_valves([share] * board.SEGMENTS, [0] * board.SEGMENTS)
board.vent()
result = board.bends()
"""
    bends = evaluate(code, [1, 0.25, 0.5, 1, 0.5], tmp_path)
    assert np.allclose(bends, 0.0, atol=1e-3)
    pins = [line.split()[2:] for line in log.read_text().splitlines()]
    first = [float(value) for number, value in pins if number == "2"]
    assert np.allclose(first, [0, 1, 0.25, 0.5, 0, 1, 0.5, 0], atol=1e-4)
    assert [float(value) for number, value in pins if number == "3"] == [0]


CLIENT = """
import time
import mqtt_client
mqtt_client._RETRY_MS, mqtt_client._SILENT_MS = 200, 600
client = mqtt_client.MqttClient(("127.0.0.1", given["port"]), b"c", b"srs/x/command", (b"w", b"lost"))
result, longest, end = [], 0, time.ticks_ms() + given["ms"]
while time.ticks_ms() < end:
    begun = time.ticks_us()
    result += [each.decode() for each in client.poll(time.ticks_ms())]
    client.publish(b"srs/x/bends", b"x" * 200)
    longest = max(longest, time.ticks_us() - begun)
    time.sleep_ms(2)
result = {"heard": result, "longest_s": longest / 1e6, "connections": client.connections}
"""


def served(tmp_path, ms, serve):
    """Run the client against a server that accepts connections and calls `serve(socket)` for each."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.settimeout(0.05)
        over = threading.Event()

        def accept():
            while not over.is_set():
                try:
                    near, _ = listener.accept()
                except TimeoutError:
                    continue
                near.settimeout(5)
                with near, contextlib.suppress(OSError):
                    serve(near, over)

        thread = threading.Thread(target=accept)
        thread.start()
        try:
            return evaluate(
                CLIENT, {"port": listener.getsockname()[1], "ms": ms}, tmp_path
            )
        finally:
            over.set()
            thread.join()


CONNACK = b"\x20\x02\x00\x00"
SUBACK = b"\x90\x03\x00\x01\x00"


def published(payload: bytes) -> bytes:
    length = 2 + 1 + len(payload)
    head = b""
    while length > 127:
        head += bytes([length & 127 | 128])
        length >>= 7
    return b"\x30" + head + bytes([length]) + b"\x00\x01c" + payload


def test_the_client_reads_packets_in_pieces_and_skips_large_ones(tmp_path):
    stream = (
        CONNACK
        + SUBACK
        + published(b"one")
        + published(b"x" * 70_000)
        + published(b"two")
    )

    def serve(near, over):
        near.recv(1000)
        for k in range(40):
            near.sendall(stream[k : k + 1])
            time.sleep(0.002)
        near.sendall(stream[40:] + published(b"three"))
        over.wait(5)

    found = served(tmp_path, 800, serve)
    assert found["heard"] == ["one", "two", "three"]
    assert found["connections"] == 1


def test_the_client_never_waits_for_a_link_that_takes_nothing(tmp_path):
    def serve(near, over):
        near.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
        near.sendall(
            CONNACK + SUBACK + published(b"one") + b"\x30\x7f\x00"
        )  # and half a message
        over.wait(1)

    found = served(tmp_path, 1500, serve)
    assert found["heard"][0] == "one"
    assert found["connections"] == 2  # It has given up the silent link.
    assert found["longest_s"] < 0.1


@pytest.mark.parametrize("greeting", [b"\x20\x02\x00\x05", b"HTTP/1.1 400 Bad", b""])
def test_the_client_tries_again_where_it_is_refused(tmp_path, greeting):
    greeted = []

    def serve(near, over):
        near.recv(1000)
        greeted.append(time.monotonic())
        near.sendall(greeting)

    assert served(tmp_path, 350, serve)["connections"] == 0
    assert len(greeted) == 2


@pytest.fixture
def rig(tmp_path):
    """Robot that obeys a controller."""
    with Rig(tmp_path) as found:
        wait(lambda: found.robot.filling)
        yield found


def vented(rig, count):
    wait(lambda: len(rig.robot.closings) >= count)
    return rig.vents()[count - 1]


def obeys(rig):
    wait(lambda: rig.robot.filling)


@pytest.mark.slow
@needs_broker
def test_chambers_vent_in_time_after_kills_and_a_stall_of_the_link(rig):
    rig.controller.kill()
    vents = [vented(rig, 1)]
    rig.controller.start()
    obeys(rig)
    rig.wire.stalled = True
    vents.append(vented(rig, 2))
    time.sleep(1.5)
    rig.wire.stalled = False  # delivers what was sent meanwhile
    obeys(rig)
    rig.wire.cut()
    vents.append(vented(rig, 3))
    obeys(rig)
    rig.broker.kill()
    vents.append(vented(rig, 4))
    rig.broker.start()
    obeys(rig)
    assert {vent.cause for vent in vents} == {Cause.EXPIRY} and rig.robot.resets == []
    assert max(vent.delay for vent in vents) < SLACK_S
    assert (
        min(vent.delay for vent in vents) > -0.03
    )  # and not much earlier: clocks count ms
    assert rig.oldest() < HOLD_S + SLACK_S


@pytest.mark.slow
@needs_broker
@pytest.mark.parametrize(
    "how",
    [
        "kill",
        pytest.param("hang", marks=pytest.mark.slow),
        pytest.param("error", marks=pytest.mark.slow),
    ],
)
def test_chambers_vent_within_the_watchdog_period_after_a_hang_and_at_once_after_an_error(
    rig, how
):
    with MqttLink(NAME, SEGMENTS, rig.broker.access, kinds=(STATUS,)) as link:
        time.sleep(0.3)
        if how == "kill":
            rig.robot.kill()
        else:
            rig.robot.fault(how)
        vent = vented(rig, 1)
        if how == "error":
            assert vent.cause is Cause.ERROR and vent.delay < 0
        else:
            assert vent.cause is Cause.RESET and vent.time - vent.fed < WATCHDOG_S + 0.1
        obeys(rig)  # the reset has started it again
        said = [message.names[0] for message in link.received()]
    # A killed interpreter's socket is closed, a hanging one's is replaced after the
    # reset.
    assert said[:2] == ["stopped" if how == "error" else LOST, "running"]


@pytest.mark.slow
@needs_broker
def test_the_shadow_reads_its_messages_and_garbage_does_not_stop_it(rig):
    from paho.mqtt import client as mqtt

    other = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
    other.connect("127.0.0.1", rig.broker.port)
    other.loop_start()
    kinds = (VALVES, BENDS, STATUS)
    with MqttLink(NAME, SEGMENTS, rig.broker.access, kinds=kinds) as link:
        for k in range(200):
            payload = (
                b"{" * 50,
                BAD[k % len(BAD)].encode(),
                os.urandom(200),
                b"9" * 2000,
            )[k % 4]
            other.publish(
                topic(NAME, COMMAND), payload if k % 100 else b"9" * LARGEST_BYTES
            )
            time.sleep(0.01)
        heard = link.received()
    other.disconnect()
    other.loop_stop()
    assert not [what for what in link.counts if what.startswith("bad")]
    bends = [message for message in heard if message.kind == BENDS]
    valves = [message for message in heard if message.kind == VALVES]
    assert len(bends) > 10 and {message.sent for message in bends} >= {
        message.sent for message in valves[1:-1]
    }
    assert all(np.allclose(message.values, 0.0, atol=1e-3) for message in bends)
    filled = [message.values for message in valves if (message.values == 1).any()]
    assert len(filled) > 0.8 * len(valves) > 10  # it obeys on
    assert len({value.tobytes() for value in filled}) > 10
    assert rig.robot.resets == []


@pytest.mark.slow
@needs_broker
def test_the_newest_of_many_commands_is_obeyed(tmp_path, monkeypatch):
    """Four commands per tick leave no backlog."""
    monkeypatch.setenv("CONTROLLER_PERIOD_S", "0.005")
    with Rig(tmp_path) as rig:
        wait(lambda: rig.robot.filling)
        time.sleep(1.5)
        feeds = rig.robot.feeds[-50:]
        sent = rig.controller.sent()
        ages = [at - firmware_rig.latest(sent, bits, at) for at, bits in feeds if bits]
    assert len(ages) > 20 and np.median(ages) < 0.04


@needs_broker
@pytest.mark.nightly
def test_chambers_vent_in_time_after_sixty_kills_and_twenty_losses():
    done = run_script(
        "tools/firmware_kills.py", "--kills", "60", "--losses", "20", "--seed", "1"
    )
    print(done.stdout)
    assert done.returncode == 0, done.stderr
