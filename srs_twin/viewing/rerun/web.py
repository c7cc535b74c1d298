"""A recording in the browser: Rerun's viewer as a page on this machine, which needs nothing from outside.

Rerun serves its viewer and the recording itself, but its page asks for fonts from the internet: offline that
may hold it up, online it tells others. So the page goes through a small server of ours, which drops these
requests and lets the browser forbid all others by a Content-Security-Policy.
"""

from __future__ import annotations

import re
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import IO, Any
from urllib.parse import quote, urlsplit

from srs_twin.errors import InputError
from srs_twin.viewing.rerun.viewer import HOST, Rerun, free_port, output_lines, running_rerun

_START_S = 30.0
_FETCH_S = 30.0
# The viewer is WebAssembly, starts by a script in the page, and talks to the recording's port.
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
_OUTSIDE = re.compile(r"<link\b[^>]*https?://[^>]*>")


@contextmanager
def served(
    recordings: Sequence[Path], port: int = 0, data: int | None = None
) -> Iterator[tuple[str, Callable[[], None]]]:
    """Serve recordings on 127.0.0.1; give the page's address and what serves until it is interrupted.

    However the block ends, everything that was started ends with it.

    Args:
        recordings: files of `write_recording`.
        port: of the page; 0 takes a free one.
        data: port of the viewer's data, to which a running program may stream; default a free one.

    Raises:
        InputError: the port is taken, or Rerun does not start; with its last words.
    """
    data, page = data or free_port(), free_port()
    ports = ("--port", str(data), "--web-viewer-port", str(page))
    recording = quote(f"rerun+http://{HOST}:{data}/proxy", safe="")
    upstream = f"http://{HOST}:{page}"
    try:
        server = ThreadingHTTPServer((HOST, port), partial(_Page, upstream, f"url={recording}"))
    except (OSError, OverflowError) as error:
        raise InputError(
            f"port {port} cannot be had ({error}); without --port a free one is taken"
        ) from error
    with server, running_rerun("--serve-web", *ports, *map(str, recordings)) as (rerun, said):
        _wait(rerun, f"{upstream}/", said)
        yield f"http://{HOST}:{server.server_port}/", server.serve_forever


class _Page(BaseHTTPRequestHandler):
    """Hands on what Rerun serves, without what is from outside."""

    def __init__(self, source: str, query: str, *request: Any) -> None:
        """Answer a request.

        Args:
            source: where Rerun serves its viewer.
            query: what tells the viewer which recording to open.
            request: what the server hands over.
        """
        self.source, self.query = source, query
        super().__init__(*request)

    def do_GET(self) -> None:
        """Answer with Rerun's file; the bare address leads to the recording."""
        asked = urlsplit(self.path)
        if asked.path == "/" and asked.query != self.query:
            self.send_response(302)
            self.send_header("Location", f"/?{self.query}")
            self.end_headers()
            return
        try:
            with _opener().open(self.source + quote(asked.path), timeout=_FETCH_S) as answer:
                kind, content = answer.headers.get_content_type(), answer.read()
        except (urllib.error.URLError, OSError) as error:
            self.send_error(getattr(error, "code", 502))
            return
        if kind == "text/html":
            content = _OUTSIDE.sub("", content.decode("utf-8")).encode("utf-8")
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Content-Security-Policy", _POLICY)
        self.end_headers()
        with suppress(ConnectionError):  # a page that was closed while it loaded
            self.wfile.write(content)

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002
        """Say nothing of requests."""


def _opener() -> urllib.request.OpenerDirector:
    """Return what fetches from this machine: a proxy has nothing to do with that."""
    return urllib.request.build_opener(urllib.request.ProxyHandler({}))


def _wait(rerun: Rerun, address: str, said: IO[bytes]) -> None:
    """Wait until Rerun serves its page."""
    deadline = time.monotonic() + _START_S
    while rerun.poll() is None and time.monotonic() < deadline:
        try:
            _opener().open(address, timeout=2.0).close()
            return
        except (urllib.error.URLError, OSError):
            time.sleep(0.1)
    raise InputError(f"Rerun does not serve its viewer: {output_lines(said)[-1]}")
