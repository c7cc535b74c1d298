"""NatNet: what is written is read back in every version, by another program as well; hostile packets."""

from __future__ import annotations

import math
import socket
import struct
import time

import natnet_packets as packets
import numpy as np
import pytest
from brokers import wait
from hypothesis import given, settings, strategies as st

from srs_twin import InputError
from srs_twin.live import natnet
from srs_twin.live.messages import BadMessageError
from srs_twin.live.natnet import VERSIONS, Frame, RigidBody
from srs_twin.live.optitrack import NatNetLink, NatNetServer

BODIES = {
    1: RigidBody((0.1, 0.02, -0.3), (0.0, 0.38268343, 0.0, 0.92387953), 0.0003),
    7: RigidBody((0.2, 0.02, -0.4), tracked=False),
}
FRAME = Frame(41, 12.25, BODIES)


def read(packet: bytes, version: natnet.Version) -> Frame:
    kind, content = natnet.opened(packet)
    assert kind == natnet.Packet.FRAME
    return natnet.read_frame(content, version)


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("version", VERSIONS)
def test_a_frame_comes_back(version):
    found = read(packets.write_frame(FRAME, version), version)
    assert (found.number, found.time) == (41, 12.25)
    assert found.bodies.keys() == BODIES.keys()
    for key, body in BODIES.items():
        assert found.bodies[key].place == pytest.approx(body.place)
        assert found.bodies[key].turn == pytest.approx(body.turn)
        assert found.bodies[key].tracked == body.tracked


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("version", VERSIONS)
def test_names_and_versions_come_back(version):
    names = {1: "connector_1", 2: "Körper"}
    kind, content = natnet.opened(packets.write_models(names, version))
    assert (kind, natnet.read_models(content, version)) == (
        natnet.Packet.MODELDEF,
        names,
    )
    kind, content = natnet.opened(packets.write_server(version))
    assert (kind, natnet.read_server(content)) == (
        natnet.Packet.SERVER_INFO,
        (version, None),
    )
    _, content = natnet.opened(
        packets.write_server(version, group="239.255.42.99", port=1600)
    )
    assert natnet.read_server(content)[1] == (
        ("239.255.42.99", 1600) if version >= (3, 0) else None
    )


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("version", VERSIONS)
def test_another_program_reads_our_frames(version):
    theirs = pytest.importorskip("natnet.data_frame")
    from natnet.packet_buffer import PacketBuffer
    from natnet.version import Version

    _, content = natnet.opened(packets.write_frame(FRAME, version))
    found = theirs.DataFrame.read_from_buffer(PacketBuffer(content), Version(*version))
    assert found.prefix.frame_number == 41
    assert found.suffix.timestamp == 12.25
    assert [each.id_num for each in found.rigid_bodies] == [1, 7]
    assert found.rigid_bodies[0].pos == pytest.approx(BODIES[1].place)
    assert [each.tracking_valid for each in found.rigid_bodies] == [True, False]


def test_written_packets_are_those_of_version_4_1():
    names = {1: "connector_1", 7: "Körper"}
    assert natnet.write_frame(FRAME) == packets.write_frame(FRAME, (4, 1))
    assert natnet.write_models(names) == packets.write_models(names, (4, 1))
    assert natnet.write_server() == packets.write_server((4, 1))


def strange(version: natnet.Version) -> bytes:
    """Return a frame with everything that is not ours, written by hand."""

    def listed(*parts: bytes) -> bytes:
        whole = b"".join(parts)
        size = struct.pack("<i", len(whole)) if version >= (4, 1) else b""
        return struct.pack("<i", len(parts)) + size + whole

    body = struct.pack("<i7f", 3, 1, 2, 3, 0, 0, 0, 1)
    if version < (3, 0):
        body += struct.pack("<i", 2) + struct.pack("<6f2i2f", *range(6), 1, 2, 0.1, 0.2)
    body += struct.pack("<fH", 0.001, 1)
    marker_set = b"all\0" + struct.pack("<i3f", 1, 1, 2, 3)
    channels = struct.pack("<iiif", 1, 1, 1, 0.5)
    label = struct.pack("<i4fH", 5, 9, 9, 9, 0.01, 1) + (
        b"\0" * 4 if version >= (3, 0) else b""
    )
    content = (
        struct.pack("<i", 8)
        + listed(marker_set, marker_set)
        + listed(struct.pack("<3f", 4, 5, 6))
    )
    content += listed(body) + listed(struct.pack("<ii", 1, 1) + body)
    content += listed(b"an asset of some length") if version >= (4, 1) else b""
    content += listed(label)
    content += listed(channels) * ((version >= (2, 9)) + (version >= (2, 11)))
    content += struct.pack("<II", 0, 0) + struct.pack(
        "<d" if version >= (2, 7) else "<f", 2.5
    )
    return natnet.closed(natnet.Packet.FRAME, content + b"\0" * 40)


@pytest.mark.default_cases(at=[0, 2, 9])
@pytest.mark.parametrize("version", VERSIONS)
def test_what_is_not_ours_is_passed_over(version):
    found = read(strange(version), version)
    assert (found.number, found.time, list(found.bodies)) == (8, 2.5, [3])
    assert found.bodies[3].place == (1, 2, 3)


@settings(max_examples=300)
@given(version=st.sampled_from(VERSIONS), data=st.data())
def test_no_packet_does_more_than_be_refused(version, data):
    whole = packets.write_frame(FRAME, version)
    if data.draw(st.booleans()):
        at = data.draw(st.integers(0, len(whole) - 1))
        packet = (
            whole[:at] + data.draw(st.binary(min_size=1, max_size=8)) + whole[at + 1 :]
        )
    else:
        packet = data.draw(st.binary(max_size=200))
    try:
        kind, content = natnet.opened(packet)
        {natnet.Packet.SERVER_INFO: lambda: natnet.read_server(content)}.get(
            kind, lambda: natnet.read_frame(content, version)
        )()
        natnet.read_models(content, version)
    except BadMessageError as error:
        assert str(error)


@pytest.mark.parametrize("up", ["y", "z"])
def test_axes_and_headings(up):
    angle = 0.7
    half = math.sin(angle / 2), math.cos(angle / 2)
    if up == "z":
        body = RigidBody((1.0, 2.0, 0.1), (0.0, 0.0, *half))
    else:  # Motive's y is up, and its z comes towards us: (x, y, z) → (x, −z, y)
        body = RigidBody((1.0, 0.1, -2.0), (0.0, half[0], 0.0, half[1]))
    assert natnet.rotate(body, up) == pytest.approx([1.0, 2.0, 0.1, angle])


def test_frames_arrive_and_come_back_after_a_silence(monkeypatch):
    version = (2, 10)
    monkeypatch.setattr(natnet, "write_server", lambda: packets.write_server(version))
    monkeypatch.setattr(
        natnet, "write_models", lambda names: packets.write_models(names, version)
    )
    monkeypatch.setattr(
        natnet, "write_frame", lambda frame: packets.write_frame(frame, version)
    )
    names = {1: "connector_1", 7: "connector_2"}
    with NatNetServer(names) as server, NatNetLink(port=server.port) as link:
        seen = []

        def streamed() -> bool:
            server.send(time.monotonic(), BODIES)
            time.sleep(0.005)
            seen.extend(link.received())
            return len(seen) > 20 and seen[-1].names == ("connector_1",)

        wait(streamed)
        assert seen[-1].values[0] == pytest.approx(
            [0.1, 0.3, 0.02, math.pi / 4], abs=1e-6
        )
        assert 0 <= seen[-1].arrived - seen[-1].sent < 0.5
        port = server.port
        server.close()
        time.sleep(0.3)
        # `streamed` sends with the new server.
        with NatNetServer(names, port=port) as server:  # noqa: PLR1704, PLW2901
            seen.clear()
            wait(streamed)


def test_a_group_is_joined(monkeypatch):
    group = "239.255.42.98"
    port = 15_511
    server_info = packets.write_server((4, 1), group=group, port=port)
    monkeypatch.setattr(natnet, "write_server", lambda: server_info)
    with (
        NatNetServer({1: "one"}) as server,
        NatNetLink(port=server.port) as link,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        sender.bind(("127.0.0.1", 0))
        sender.setsockopt(
            socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("127.0.0.1")
        )
        sender.setsockopt(
            socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, struct.pack("b", 0)
        )
        seen = []

        def streamed() -> bool:
            sender.sendto(natnet.write_frame(FRAME), (group, port))
            time.sleep(0.01)
            seen.extend(link.received())
            return len(seen) > 3

        try:
            wait(streamed, 5)
        except OSError:
            pytest.skip("no multicast on loopback here")


def test_an_address_of_others_is_refused():
    with pytest.raises(InputError, match="cannot be used for NatNet"):
        NatNetServer({}, host="192.0.2.1")
    with pytest.raises(InputError, match=r"frames cannot be received at 192\.0\.2\.1"):
        NatNetLink(local="192.0.2.1")
    with pytest.raises(InputError, match="up 'x' is unknown; allowed: y, z"):
        NatNetLink(up="x")


def test_a_server_given_by_its_name_is_heard():
    with (
        NatNetServer({1: "one"}) as server,
        NatNetLink("localhost", server.port) as link,
    ):
        wait(lambda: link.version is not None)
    assert not any(what.startswith("bad: ") for what in link.counts)


@pytest.mark.parametrize(
    "given", [{"host": "nowhere"}, {"local": "nowhere"}, {"local": ".."}]
)
def test_a_name_that_no_host_has_is_refused(monkeypatch, given):
    def unknown(name: str) -> str:
        if name in given.values():
            raise socket.gaierror("unknown")
        return name

    monkeypatch.setattr(socket, "gethostbyname", unknown)
    with pytest.raises(InputError, match="cannot be found"):
        NatNetLink(**given)


HERE = (1.0, 2.0, 3.0)
WEST = (0.0, math.sqrt(0.5), 0.0, math.sqrt(0.5))
"""Quaternion of a body that looks to the left, where y is up."""


def stretched(quaternion: tuple[float, ...], length: float) -> tuple[float, ...]:
    return tuple(length * each for each in quaternion)


UNUSABLE = [
    RigidBody((math.nan, 2.0, 3.0)),
    RigidBody((1.0, math.inf, 3.0)),
    RigidBody((1.0, 2.0, -1000.1)),
    *(RigidBody(HERE, stretched(WEST, length)) for length in (0.0, 0.89, 1.11)),
    RigidBody(HERE, (0.0, 0.0, math.nan, 1.0)),
]


def test_bodies_at_impossible_places_or_turns_are_not_seen():
    found = read(natnet.write_frame(Frame(1, 0.0, dict(enumerate(UNUSABLE)))), (4, 1))
    assert [each.tracked for each in found.bodies.values()] == [False] * 7
    assert np.isnan(natnet.rotate(UNUSABLE[-1], "y")).all()


@pytest.mark.parametrize("length", [0.91, 1.09])
def test_quaternions_near_length_1_are_normalised(length):
    body = RigidBody((999.0, 2.0, -1000.0), stretched(WEST, length))
    found = read(natnet.write_frame(Frame(1, 0.0, {1: body})), (4, 1)).bodies[1]
    assert found.tracked
    assert natnet.rotate(found, "y")[3] == pytest.approx(math.pi / 2)


@pytest.mark.parametrize("time", [1.1e10, -1.1e10, math.nan])
def test_frames_with_an_impossible_time_are_refused(time):
    with pytest.raises(BadMessageError, match="the time of the frame"):
        read(natnet.write_frame(Frame(1, time, {})), (4, 1))


@pytest.fixture
def fed(monkeypatch):
    """Return a link that hears no socket, and a function that hands it packets at given times."""
    now = [100.0]
    monkeypatch.setattr("srs_twin.live.optitrack.clock", lambda: now[0])
    monkeypatch.setattr(NatNetLink, "_start", lambda _: None)
    with NatNetServer({}) as server, NatNetLink(port=server.port) as link:
        asked = []
        monkeypatch.setattr(
            link._sockets[0].__class__,
            "sendto",
            lambda _, packet, __: asked.append(natnet.opened(packet)[0]),
        )

        def feed(
            packet: bytes, at: float, sender: tuple[str, int] | None = None
        ) -> None:
            now[0] = 100.0 + at
            link._packet(
                *natnet.opened(packet), sender or ("127.0.0.1", server.port), now[0]
            )
            link._idle()

        monkeypatch.setattr(link, "_threads", [])
        yield link, feed, asked


def packet_of(number: int, *bodies: int) -> bytes:
    seen = {key: RigidBody((1.0, 2.0, 3.0)) for key in bodies}
    return natnet.write_frame(Frame(number, 0.01 * number, seen))


def test_reordered_frames_are_not_lost(fed):
    link, feed, _ = fed
    feed(natnet.write_server(), 0.0)
    for k, number in enumerate((10, 12, 11, 13, 15, 14, 16, 16, 19)):
        feed(packet_of(number, 1), 0.01 * k)
    kinds = ("lost", "reordered", "repeated")
    assert [link.counts[f"frames {kind}"] for kind in kinds] == [2, 2, 1]
    feed(packet_of(2**31 - 1, 1), 0.2)
    feed(packet_of(3, 1), 0.3)
    assert link.counts["frames lost"] == 2, (
        "a server that began to count again lost nothing"
    )


def test_models_are_asked_for_again_when_an_unknown_body_appears_and_now_and_then(fed):
    link, feed, asked = fed
    feed(natnet.write_server(), 0.0)
    feed(natnet.write_models({1: "head"}), 0.1)
    asked.clear()
    feed(packet_of(1, 1), 1.5)
    assert natnet.Packet.REQUEST_MODELDEF not in asked
    feed(packet_of(2, 1, 2), 3.0)
    assert natnet.Packet.REQUEST_MODELDEF in asked
    feed(natnet.write_models({1: "head", 2: "tail"}), 3.1)
    asked.clear()
    feed(packet_of(3, 1, 2), 4.5)
    assert natnet.Packet.REQUEST_MODELDEF not in asked
    feed(packet_of(4, 1, 2), 20.0)
    assert natnet.Packet.REQUEST_MODELDEF in asked
    feed(natnet.write_models({1: "nose", 2: "tail"}), 20.1)
    feed(packet_of(5, 1, 2), 20.2)
    assert link.received()[-1].names == ("nose", "tail")


def test_bodies_without_a_usable_pose_are_counted_and_left_out(fed):
    link, feed, _ = fed
    feed(natnet.write_server(), 0.0)
    frame = Frame(1, 0.5, dict(enumerate([*UNUSABLE, RigidBody(HERE, tracked=False)])))
    feed(natnet.write_frame(frame), 0.1)
    (message,) = link.received()
    assert message.values.shape == (0, 4)
    assert (message.sent, message.arrived) == (0.5, 100.1)
    assert link.counts["bodies without a usable pose"] == len(UNUSABLE)


@pytest.mark.parametrize("group", ["10.0.0.1", "0.0.0.0", "255.255.255.255"])
def test_a_group_that_cannot_be_joined_is_named_and_motion_capture_goes_on(fed, group):
    link, feed, _ = fed
    with pytest.raises(BadMessageError, match="cannot be joined"):
        feed(packets.write_server((4, 1), group=group), 0.0)
    assert len(link._sockets) == 1
    feed(packet_of(1, 1), 0.1)
    assert link.received()[0].names == ("1",)
    for k, right in enumerate(("239.255.42.97", "239.255.42.96")):
        try:
            feed(packets.write_server((4, 1), group=right, port=15_513), 0.2 + k)
        except BadMessageError:
            pytest.skip("no multicast on loopback here")
        assert len(link._sockets) == 2 and link._group == (right, 15_513)


def test_answers_of_another_program_on_the_servers_machine_are_refused(fed):
    link, feed, _ = fed
    with pytest.raises(BadMessageError, match="from an unexpected address"):
        feed(packets.write_server((2, 7)), 0.0, ("127.0.0.1", 9))
    assert link.version is None


def test_no_error_ends_the_thread_that_listens(monkeypatch):
    def fails(*_):
        raise ZeroDivisionError

    with NatNetServer({1: "one"}) as server, NatNetLink(port=server.port) as link:
        wait(lambda: link.version is not None)
        monkeypatch.setattr(natnet, "read_frame", fails)
        server.send(1.0, BODIES)
        wait(lambda: link.counts["bad: ZeroDivisionError"])
        assert all(each.is_alive() for each in link._threads)
