"""A robot's topics at a real broker: what is sent arrives, with a password, after restarts, among garbage."""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np
import pytest
from brokers import broker, free_port, needs_broker, wait

from srs_twin import InputError
from srs_twin.live.links import LOST, BrokerAccess, MqttLink, address
from srs_twin.live.messages import BENDS, COMMAND, STATUS, topic

pytestmark = needs_broker


def test_what_is_sent_arrives_with_its_times(tmp_path):
    port = free_port()
    with (
        broker(tmp_path, port),
        MqttLink("r", 2, BrokerAccess(port=port), kinds=(BENDS, STATUS)) as here,
    ):
        with MqttLink("r", 2, BrokerAccess(port=port), kinds=(COMMAND,)) as there:
            wait(lambda: there.connected)
            time.sleep(0.2)  # subscribed
            there.send(BENDS, np.array([0.25, np.nan]))
            here.send(COMMAND, np.array([[1, -1], [-1, 1]]))
            heard = []
            told = []
            wait(lambda: heard.extend(here.received()) or heard)
            wait(lambda: told.extend(there.received()) or told)
        assert np.array_equal(heard[0].values, [0.25, np.nan], equal_nan=True)
        assert 0 <= heard[0].arrived - heard[0].sent < 5
        assert (told[0].kind, told[0].values.tolist()) == (COMMAND, [[1, -1], [-1, 1]])


def test_a_broker_that_is_killed_and_comes_back(tmp_path):
    port = free_port()
    with broker(tmp_path, port):
        here = MqttLink("r", 1, BrokerAccess(port=port), kinds=(BENDS,))
        there = MqttLink("r", 1, BrokerAccess(port=port), kinds=())
    wait(lambda: not here.connected)
    with broker(tmp_path, port):
        wait(lambda: here.connected and there.connected)
        heard = []

        def sent() -> bool:
            there.send(BENDS, np.array([0.5]))
            time.sleep(0.02)
            heard.extend(here.received())
            return bool(heard)

        wait(sent)
        for each in (here, there):
            each.close()


def test_who_breaks_off_is_said_to_be_lost(tmp_path):
    port = free_port()
    with (
        broker(tmp_path, port),
        MqttLink("r", 1, BrokerAccess(port=port), kinds=(STATUS,)) as here,
    ):
        gone = MqttLink("r", 1, BrokerAccess(port=port), kinds=(), speaks="r")
        time.sleep(0.2)
        gone._client._sock_close()  # as if its machine were gone
        gone._client.loop_stop()
        heard = []
        wait(lambda: heard.extend(here.received()) or heard)
        assert heard[0].names == (LOST,)


def test_a_password_is_asked_for(tmp_path):
    port = free_port()
    with broker(tmp_path, port, password="bench"):
        with MqttLink("r", 1, BrokerAccess("127.0.0.1", port, "lab", "bench")) as link:
            assert link.connected
        for login in ((), ("lab", "wrong")):
            with pytest.raises(
                InputError, match="refuses the connection: Not authorized"
            ):
                MqttLink("r", 1, BrokerAccess("127.0.0.1", port, *login))


def refused(link):
    return sum(n for what, n in link.counts.items() if what.startswith("bad"))


def until_refused(link, wanted):
    """Wait until so many messages are refused, or their number has not changed for a second."""
    last = -1
    changed = time.monotonic()
    while (now := refused(link)) < wanted and time.monotonic() < changed + 1.0:
        if now != last:
            last = now
            changed = time.monotonic()
        time.sleep(0.001)


@pytest.mark.slow
def test_ten_thousand_hostile_messages_stop_nothing_and_are_counted(tmp_path):
    from paho.mqtt import client as mqtt

    port = free_port()
    rng = np.random.default_rng(3)
    with (
        broker(tmp_path, port),
        MqttLink("r", 2, BrokerAccess(port=port), kinds=(BENDS, COMMAND)) as link,
    ):
        other = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
        other.max_queued_messages_set(0)
        other.connect("127.0.0.1", port)
        other.loop_start()
        bad = 0
        for k in range(10_000):
            kind = (BENDS, COMMAND)[k % 2]
            payload = (
                rng.bytes(int(rng.integers(0, 300))),
                b'{"t": 1, "rad": [9e9]}',
                b"{" * 50,
            )[k % 3]
            other.publish(topic("r", kind), payload, qos=1).wait_for_publish(10)
            bad += 1
            if bad % 100 == 0:
                until_refused(link, bad)
        other.publish(
            topic("r", BENDS), b'{"t": 1, "rad": [0.5, null]}', qos=1
        ).wait_for_publish(10)
        heard = []
        wait(lambda: heard.extend(link.received()) or heard)
        # A broker drops what a subscriber on a busy machine has not taken.
        assert 0.95 * bad <= refused(link) <= bad
        other.disconnect()
        other.loop_stop()


def test_no_broker_is_said_in_one_line():
    port = free_port()
    with pytest.raises(InputError, match=f"no broker answers at 127.0.0.1:{port}"):
        MqttLink("r", 1, BrokerAccess(port=port))


@pytest.mark.parametrize(
    ("given", "found"),
    [
        ("10.0.0.2", ("10.0.0.2", 7)),
        ("lab:99", ("lab", 99)),
        ("127.0.0.1:1", ("127.0.0.1", 1)),
    ],
)
def test_addresses(given, found):
    if found is None:
        with pytest.raises(InputError, match="is not an address"):
            address(given, 7)
        return
    assert address(given, 7) == found


@pytest.mark.default_cases(at=[0, 14, 31])
@pytest.mark.parametrize(
    "given",
    [
        "",
        ":1",
        "lab:x",
        "lab:0",
        "lab:70000",
        "lab:65536",
        "lab:-1",
        "lab:+1",
        "lab: 1",
        "lab:1e3",
        "lab:",
        "lab:²",
        "lab:١",
        "lab:" + "9" * 30,
        "..",
        "..:1883",
        ".",
        "a..b",
        "a\u3002\u3002b",
        " ",
        "a b",
        "a/b",
        "u@h",
        "☃",
        "-a",
        "a-",
        "xn--",
        "x" * 64,
        "x.y." * 80,
        "[::1]:1883",
        "::1",
        "mqtt://lab:1883",
    ],
)
def test_what_is_no_address_is_refused(given):
    with pytest.raises(InputError, match="is not an address"):
        address(given, 7)


@pytest.mark.parametrize(
    "words", [("--mqtt", "..:1883"), ("--mqtt", "lab:0"), ("--name", "n" * 70_000)]
)
def test_an_address_or_a_name_that_cannot_be_used_has_exit_code_2(
    srs_twin, tmp_path, words
):
    done = srs_twin("emulate", "gen2", "--duration", "0.1", *words, cwd=tmp_path)
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1
    assert (
        "is not an address" in done.stderr
        or "cannot be part of an MQTT topic" in done.stderr
    )


@pytest.mark.default_cases(at=[0, 6, 7, 8])
@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "not a certificate"),
        (b"hello", "not a certificate"),
        (b"\x30\x82\x01\x00" * 50, "not a certificate"),
        (
            b"-----BEGIN PRIVATE KEY-----\nMIIB\n-----END PRIVATE KEY-----\n",
            "not a certificate",
        ),
        (
            b"-----BEGIN CERTIFICATE-----\nMIIB\n-----END CERTIFICATE-----\n",
            "not a certificate",
        ),
        (b"-----BEGIN CERTIFICATE-----\nMIIB\n", "not a certificate"),
        (None, "no such file"),
        (Path.mkdir, "a folder; give one file"),
        (os.mkfifo, "not a regular file"),
    ],
)
def test_a_file_that_is_no_certificate_is_refused(tmp_path, content, words):
    file = tmp_path / "ca.pem"
    if callable(content):
        content(file)
    elif content is not None:
        file.write_bytes(content)
    with pytest.raises(InputError, match=f"ca.pem: .*{words}"):
        MqttLink("r", 1, BrokerAccess(port=free_port(), ca=file))
