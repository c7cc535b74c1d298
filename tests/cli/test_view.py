"""`srs-twin view`: several runs side by side, and the web viewer."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from io import BytesIO
from pathlib import Path

import browser
import psutil
import pytest
from browser import fraction, shows_a_snake
from conftest import exists, wait_until
from matplotlib.image import imread
from screenshot import screenshots
from viewing_runs import pair, robot

from srs_twin.cli.view import _serve, name_recordings
from srs_twin.comparison.compare import compare
from srs_twin.errors import InputError
from srs_twin.viewing.content import RunContent
from srs_twin.viewing.plots.style import STYLES
from srs_twin.viewing.rerun.recording import write_recording, write_side_by_side
from srs_twin.viewing.rerun.viewer import serve_recordings, verify_recording

OPENER = urllib.request.build_opener(urllib.request.ProxyHandler({}))


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    made = {}
    for name, changes in {
        "straight on": {},
        "left+1": {"yaw_rate": 0.3, "connectors": 6},
    }.items():
        runs = pair(duration=2.0, **changes)
        path = folder / name / "recording.rrd"
        path.parent.mkdir()
        spec = robot(runs["twin"].position.shape[1])
        write_recording(path, RunContent(spec, runs, compare(*runs.values())))
        made[name] = path
    return made


def entities(path):
    from rerun.chunk import RrdReader

    return {chunk.entity_path for chunk in RrdReader(path).stream().to_chunks()}


def test_side_by_side_recording_contains_all_entities(recordings, tmp_path):
    path = tmp_path / "both.rrd"
    write_side_by_side(path, recordings)
    verify_recording(path)
    found = entities(path)
    for name, recording in recordings.items():
        root = "/" + name.replace(" ", "\\ ").replace("+", "\\+")
        ours = {each for each in entities(recording) if not each.startswith("/__")}
        assert {root + each for each in ours} <= found
        assert len(ours) > 20


@pytest.mark.slow
def test_viewer_shows_runs_side_by_side(recordings, tmp_path):
    path = tmp_path / "both.rrd"
    write_side_by_side(path, recordings)
    try:
        (png,) = screenshots(path, [1.5], size=(1000, 600))
    except InputError as error:
        if "no Vulkan driver" not in str(error):
            raise
        pytest.skip(str(error))
    picture = imread(BytesIO(png))[..., :3] * 255
    middle = picture.shape[1] // 2
    below = 3 * picture.shape[0] // 4
    for half in (picture[:below, :middle], picture[:below, middle:]):
        assert shows_a_snake(half)
    for half in (picture[below:, :middle], picture[below:, middle:]):
        assert fraction(half, STYLES["twin"].rgb) > 0.001, "its speed is plotted below"


def test_names_are_those_of_the_folders(tmp_path):
    one, two, file = (
        tmp_path / p for p in ("a/turn/recording.rrd", "b/turn/recording.rrd", "x.rrd")
    )
    assert name_recordings([one, file]) == {"turn": one, "x.rrd": file}
    assert list(name_recordings([one, two])) == ["a/turn", "b/turn"]
    with pytest.raises(InputError, match="a/turn: this recording is given twice"):
        name_recordings([one, one])


def test_foreign_recording_is_refused(recordings, tmp_path):
    import rerun as rr

    log = rr.RecordingStream("another")
    memory = log.memory_recording()
    log.log("a/b", rr.TextLog("hello"))
    (tmp_path / "other.rrd").write_bytes(memory.drain_as_bytes())
    with pytest.raises(
        InputError,
        match=r"other\.rrd: the file was not recorded by srs-twin, because it"
        r" contains no snake",
    ):
        write_side_by_side(
            tmp_path / "both.rrd",
            {"a": recordings["left+1"], "other.rrd": tmp_path / "other.rrd"},
        )
    assert not (tmp_path / "both.rrd").exists()


def test_web_page_requests_no_other_hosts(recordings):
    with serve_recordings([recordings["left+1"]]) as (address, serve):
        threading.Thread(target=serve, daemon=True).start()
        with OPENER.open(address, timeout=120) as answer:
            page = answer.read().decode()
            policy = answer.headers["Content-Security-Policy"]
            assert "url=rerun%2Bhttp%3A%2F%2F127.0.0.1%3A" in answer.url, (
                "it opens the recording"
            )
        loaded = re.findall(r"""(?:src|href)=["']([^"']+)""", page) + re.findall(
            r"url\(([^)]*)", page
        )
        assert loaded and not [each for each in loaded if "//" in each]
        assert "default-src 'self'" in policy and "https:" not in policy
        with OPENER.open(address + "re_viewer_bg.wasm", timeout=120) as answer:
            assert answer.headers["Content-Type"] == "application/wasm"
            assert answer.read(4) == b"\x00asm"
        with pytest.raises(urllib.error.HTTPError, match="404"):
            OPENER.open(address + "nothing-there", timeout=120)
        everybody = psutil.Process().children(recursive=True)
        reruns = [process.pid for process in everybody if "rerun" in process.name()]
        listening = [
            connection.laddr.ip
            for process in (psutil.Process(), *everybody)
            for connection in process.net_connections("tcp")
            if connection.status == psutil.CONN_LISTEN
        ]
        assert len(listening) >= 3 and set(listening) == {"127.0.0.1"}, (
            "page, Rerun's page, recording"
        )
    wait_until(lambda: not any(map(exists, reruns)))


@pytest.mark.usefixtures("interruptible")
@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGTERM])
def test_page_is_served_until_interrupted(recordings, end):
    script = os.path.join(os.path.dirname(sys.executable), "srs-twin")
    command = [script, "view", str(recordings["left+1"].parent), "--web"]
    started = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    address = started.stdout.readline().strip()
    assert re.fullmatch(r"http://127\.0\.0\.1:\d+/", address)
    started.stderr.readline()
    OPENER.open(address, timeout=120).close()
    started.send_signal(end)
    out, said = started.communicate(timeout=300)
    assert (started.returncode, out, said) == (0, "", "")
    with pytest.raises(urllib.error.URLError):
        OPENER.open(address, timeout=5)


def test_page_does_not_handle_signals_that_the_caller_ignores(monkeypatch):
    before = signal.signal(signal.SIGTERM, signal.SIG_IGN)
    try:
        with monkeypatch.context() as patched:
            patched.setattr(
                "srs_twin.viewing.rerun.viewer.serve_recordings", interrupted
            )
            _serve(Path("recording.rrd"), 0)
        assert signal.getsignal(signal.SIGTERM) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGTERM, before)


def interrupted(*_):
    raise KeyboardInterrupt


def test_invalid_options_are_refused(recordings, srs_twin, tmp_path):
    run = str(recordings["left+1"].parent)
    done = srs_twin("view", run, "--port", "9000", cwd=tmp_path)
    assert (
        done.returncode == 2
        and done.stderr.strip() == "--port requires --web; add --web or remove --port"
    )
    done = srs_twin("view", run, run, cwd=tmp_path)
    assert done.returncode == 2 and "given twice" in done.stderr
    with serve_recordings([recordings["left+1"]]) as (address, _):
        port = address.rstrip("/").rpartition(":")[2]
        done = srs_twin("view", run, "--web", "--port", port, cwd=tmp_path)
    assert done.returncode == 2 and f"port {port} cannot be used" in done.stderr


@pytest.mark.slow
@pytest.mark.skipif(
    bool(browser.missing()), reason=browser.missing() or "a browser is here"
)
def test_browser_shows_recording_offline(recordings, srs_twin):
    with (
        serve_recordings([recordings["straight on"]]) as (address, serve),
        browser.chromium() as chromium,
    ):
        threading.Thread(target=serve, daemon=True).start()
        begun = time.monotonic()
        chromium.get(address)
        blue = STYLES["twin"].rgb
        _, shown = browser.picture(
            chromium,
            lambda page: shows_a_snake(page) and fraction(page[:, -200:], blue) > 0.001,
        )
        assert shows_a_snake(shown), (
            f"nothing to see after {time.monotonic() - begun:.0f} s"
        )
        assert fraction(shown[:, -200:], blue) > 0.001, "plots stand on the right"
        asked = browser.requested(chromium)
    assert len(asked) >= 4
    assert not [
        each
        for each in asked
        if not re.match(r"(http://127\.0\.0\.1:\d+/|data:|blob:)", each)
    ]
