"""A robot's topics at a real broker: what is sent arrives, with a password and after restarts."""

from __future__ import annotations

import os
import time
from pathlib import Path

import numpy as np
import pytest
from brokers import Broker, free_port, heard, needs_broker, wait

from srs_twin import InputError
from srs_twin.live.links import LOST, BrokerAccess, MqttLink, address
from srs_twin.live.messages import BENDS, COMMAND, STATUS


def test_what_is_sent_arrives_with_its_times(broker):
    with (
        MqttLink("r", 2, broker.access, kinds=(BENDS, STATUS)) as here,
        MqttLink("r", 2, broker.access, kinds=(COMMAND,)) as there,
    ):
        time.sleep(0.2)  # subscribed
        there.send(BENDS, np.array([0.25, np.nan]))
        here.send(COMMAND, np.array([[1, -1], [-1, 1]]))
        (bends,) = heard(here)
        (command,) = heard(there)
    assert np.array_equal(bends.values, [0.25, np.nan], equal_nan=True)
    assert 0 <= bends.arrived - bends.sent < 5
    assert (command.kind, command.values.tolist()) == (COMMAND, [[1, -1], [-1, 1]])


def test_a_broker_that_is_killed_and_comes_back(broker):
    with (
        MqttLink("r", 1, broker.access, kinds=(BENDS,)) as here,
        MqttLink("r", 1, broker.access, kinds=()) as there,
    ):
        broker.kill()
        wait(lambda: here.connection_change() == "the connection to the broker is lost")
        broker.start()
        wait(lambda: here.connection_change() == "the connection to the broker is back")

        def arrives() -> bool:
            there.send(BENDS, np.array([0.5]))
            return bool(here.received())

        wait(arrives)
        # A loss between two polls is only counted.
        broker.kill()
        wait(lambda: not here.connected)
        broker.start()
        wait(lambda: here.connected)
        assert here.connection_change() == ""
        assert (here.counts["connected"], here.counts["disconnected"]) == (3, 2)


def test_who_breaks_off_is_said_to_be_lost(broker):
    with MqttLink("r", 1, broker.access, kinds=(STATUS,)) as here:
        gone = MqttLink("r", 1, broker.access, kinds=(), speaks="r")
        time.sleep(0.2)
        gone._client._sock_close()  # as if its machine were gone
        gone._client.loop_stop()
        assert heard(here)[0].names == (LOST,)


@needs_broker
def test_a_password_is_asked_for(tmp_path):
    with Broker(tmp_path, password="bench") as broker:
        with MqttLink("r", 1, BrokerAccess("127.0.0.1", broker.port, "lab", "bench")):
            pass
        for login in ((), ("lab", "wrong")):
            with pytest.raises(
                InputError, match="refuses the connection: Not authorized"
            ):
                MqttLink("r", 1, BrokerAccess("127.0.0.1", broker.port, *login))


def test_no_broker_is_said_in_one_line():
    port = free_port()
    with pytest.raises(InputError, match=f"no broker answers at 127.0.0.1:{port}"):
        MqttLink("r", 1, BrokerAccess(port=port))


@pytest.mark.parametrize(
    ("given", "found"),
    [
        ("10.0.0.2", ("10.0.0.2", 7)),
        ("lab:99", ("lab", 99)),
        ("lab:65535", ("lab", 65_535)),
    ],
)
def test_addresses(given, found):
    assert address(given, 7) == found


@pytest.mark.parametrize(
    "given",
    [
        "",
        ":1",
        "lab:",
        "lab:x",
        "lab:0",
        "lab:65536",
        "lab:+1",
        "lab:١",
        "lab:" + "9" * 30,
        "a..b",
        "a b",
        "u@h",
        "a-",
        "x" * 64,
        "x.y." * 80,
        "[::1]:1883",
        "mqtt://lab:1883",
    ],
)
def test_what_is_no_address_is_refused(given):
    with pytest.raises(InputError, match="is not an address"):
        address(given, 7)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "not a certificate"),
        (
            b"-----BEGIN CERTIFICATE-----\nMIIB\n-----END CERTIFICATE-----\n",
            "not a certificate",
        ),
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
