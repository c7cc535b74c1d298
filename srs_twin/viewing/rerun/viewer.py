"""Rerun viewer in a window or a browser, and verification of recordings.

Only this machine can connect to the viewer. Rerun's web page would load fonts from the
internet, which discloses the use of the page and causes a delay without a network. A
proxy server therefore removes the links to the fonts. The proxy server also adds a
Content-Security-Policy, so that the browser blocks all requests to other hosts.
"""

from __future__ import annotations

import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.util import find_spec
from pathlib import Path
from typing import IO
from urllib.parse import quote, urlsplit

from srs_twin.errors import InputError

_INSTALL = "pip install 'rerun-sdk>=0.41,<0.42'"


def has_rerun() -> bool:
    """Return whether Rerun is installed."""
    return find_spec("rerun") is not None


def require_rerun() -> None:
    """Check that Rerun is installed.

    Raises:
        InputError: Rerun is missing.
    """
    if not has_rerun():
        raise InputError(f"rerun-sdk is not installed; install it with: {_INSTALL}")


def rerun_executable() -> Path:
    """Return the path of the program `rerun` in the Python environment."""
    program = Path(sys.executable).parent / (
        "rerun.exe" if os.name == "nt" else "rerun"
    )
    if not program.is_file():
        raise InputError(f"{program} is missing; install it with: {_INSTALL}")
    return program


def lacks_display() -> bool:
    """Return whether this is a Linux machine without a display."""
    display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    return sys.platform.startswith("linux") and not display


def open_recording(path: str | Path) -> None:
    """Open a recording in a viewer window and wait until the window is closed."""
    recording = _recording(path)
    program = rerun_executable()
    if lacks_display():
        raise InputError(
            "no display was found for the viewer, because neither DISPLAY nor"
            f" WAYLAND_DISPLAY is set. Open {recording.parent / 'report.html'} in a"
            " browser, serve the recording with `srs-twin view"
            f" {shlex.quote(str(recording))} --web`, or copy {recording} to a"
            f" machine with a screen and run 'rerun {recording.name}' there"
        )
    # The default address would accept connections from the network.
    exit_code = subprocess.run(
        [program, "--bind", HOST, recording], check=False
    ).returncode
    if exit_code > 0:
        raise InputError(
            f"the viewer failed with exit code {exit_code}; see the message above"
        )


def verify_recording(path: str | Path) -> None:
    """Verify a recording with `rerun rrd verify`."""
    recording = _recording(path)
    command = [str(rerun_executable()), "rrd", "verify", str(recording)]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    # If the file is no recording, `rerun` exits with 0 and prints "0 files verified".
    if "1 file verified" not in done.stdout + done.stderr:
        lines = (done.stderr or done.stdout).strip().splitlines()
        raise InputError(
            f"{path}: the recording is incomplete or damaged"
            f" ({lines[-1] if lines else 'no output of rerun'})"
        )


def _recording(path: str | Path) -> Path:
    recording = Path(path)
    if not recording.is_file():
        raise InputError(
            f"{path}: this recording does not exist; run `srs-twin run SCENARIO` to"
            " write a recording"
        )
    return recording


HOST = "127.0.0.1"
"""Address at which the viewer accepts connections."""

_STOP_TIMEOUT_S = 10.0
"""Time between SIGTERM and SIGKILL when the viewer is stopped, s."""

Rerun = subprocess.Popen[bytes]


@contextmanager
def running_rerun(*arguments: str) -> Iterator[tuple[Rerun, IO[bytes]]]:
    """Run Rerun in a `with` block and yield the process and its output file."""
    command = [str(rerun_executable()), "--bind", HOST, *arguments]
    with tempfile.TemporaryFile() as output:
        # The script `rerun` starts the actual program in a child process. A process
        # group allows both processes to be stopped together.
        rerun = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            start_new_session=True,
        )
        try:
            yield rerun, output
        finally:
            _stop(rerun)


def free_port() -> int:
    """Return the number of a free TCP port on this machine."""
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])


def output_lines(output: IO[bytes]) -> list[str]:
    """Return the lines printed by Rerun, or the single line "no output"."""
    output.seek(0)
    return output.read().decode(errors="replace").strip().splitlines() or ["no output"]


def _stop(rerun: Rerun) -> None:
    for signal_number in (signal.SIGTERM, signal.SIGKILL):
        if rerun.poll() is not None:
            return
        os.killpg(rerun.pid, signal_number)
        try:
            rerun.wait(timeout=_STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            continue


_START_TIMEOUT_S = 30.0
_FETCH_TIMEOUT_S = 30.0
# The viewer needs WebAssembly, an inline start script, and connections to the port of
# the recording.
_POLICY = "; ".join(
    (
        "default-src 'self'",
        "script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval' blob:",
        "worker-src 'self' blob:",
        "style-src 'self' 'unsafe-inline'",
        "img-src 'self' data: blob:",
        f"connect-src 'self' data: blob: http://{HOST}:*",
    )
)
_EXTERNAL_LINK = re.compile(r"<link\b[^>]*https?://[^>]*>")


@contextmanager
def serve_recordings(
    recordings: Sequence[Path], port: int = 0, data_port: int | None = None
) -> Iterator[tuple[str, Callable[[], None]]]:
    """Serve recordings in the web viewer on 127.0.0.1.

    The context manager yields the URL of the page and a function that serves requests
    until it is interrupted.

    Args:
        recordings: paths of the recordings.
        port: port of the page, or 0 to select a free port.
        data_port: port on which the viewer accepts streamed data, or None to select a
            free port.
    """
    data_port = data_port or free_port()
    viewer_port = free_port()
    ports = ("--port", str(data_port), "--web-viewer-port", str(viewer_port))
    recording = quote(f"rerun+http://{HOST}:{data_port}/proxy", safe="")
    upstream = f"http://{HOST}:{viewer_port}"
    try:
        server = ThreadingHTTPServer(
            (HOST, port), partial(_ProxyHandler, upstream, f"url={recording}")
        )
    except (OSError, OverflowError) as error:
        raise InputError(
            f"port {port} cannot be used ({error}); omit `--port` to use a free port"
        ) from error
    with (
        server,
        running_rerun("--serve-web", *ports, *map(str, recordings)) as (rerun, output),
    ):
        if not is_served(rerun, f"{upstream}/"):
            raise InputError(
                f"Rerun does not serve the web viewer: {output_lines(output)[-1]}"
            )
        yield f"http://{HOST}:{server.server_port}/", server.serve_forever


class _ProxyHandler(BaseHTTPRequestHandler):
    """Request handler that removes links to other hosts from Rerun's files."""

    def __init__(
        self,
        source: str,
        query: str,
        connection: socket.socket,
        client: tuple[str, int],
        server: ThreadingHTTPServer,
    ) -> None:
        self.source = source
        self.query = query
        super().__init__(connection, client, server)

    def do_GET(self) -> None:
        url = urlsplit(self.path)
        if url.path == "/" and url.query != self.query:
            self.send_response(302)
            self.send_header("Location", f"/?{self.query}")
            self.end_headers()
            return
        try:
            with _opener().open(
                self.source + quote(url.path), timeout=_FETCH_TIMEOUT_S
            ) as response:
                kind = response.headers.get_content_type()
                content = response.read()
        except (urllib.error.URLError, OSError) as error:
            self.send_error(getattr(error, "code", 502))
            return
        if kind == "text/html":
            content = _EXTERNAL_LINK.sub("", content.decode("utf-8")).encode("utf-8")
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Content-Security-Policy", _POLICY)
        self.end_headers()
        with suppress(ConnectionError):  # the page was closed while it was loading
            self.wfile.write(content)

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002
        """Suppress log messages."""


def _opener() -> urllib.request.OpenerDirector:
    """Return a URL opener that connects to this machine without a proxy."""
    return urllib.request.build_opener(urllib.request.ProxyHandler({}))


def is_served(server: Rerun, address: str) -> bool:
    """Wait for an address to respond, and return whether it did in time."""
    head = urllib.request.Request(address, method="HEAD")
    deadline = time.monotonic() + _START_TIMEOUT_S
    while server.poll() is None and time.monotonic() < deadline:
        try:
            _opener().open(head, timeout=2.0).close()
            return True
        except (urllib.error.URLError, OSError):
            time.sleep(0.1)
    return False
