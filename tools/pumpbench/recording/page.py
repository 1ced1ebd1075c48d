"""Rerun's web viewer as a page on this machine that talks to nobody else.

Rerun's own server gives the viewer's files to the whole network or, asked to bind, to this machine; but the page it
gives then asks four hosts for fonts, examples and news, and reports its use to one of them. So the files are taken from
it once and served here, with a content security policy that lets the browser talk to the page's own server and to the
recording's, and to no other.
"""

from __future__ import annotations

import contextlib
import functools
import http.server
import socket
import subprocess
import tempfile
import threading
import time
import urllib.request
from pathlib import Path
from typing import Final

from pumpbench.recording.tool import RecordingError, quiet_environment, rerun_binary

ADDRESS: Final = "127.0.0.1"
FILES: Final = ("index.html", "re_viewer.js", "re_viewer_bg.wasm", "favicon.ico")
START_SECONDS: Final = 30.0


class Page:
    """Serves the page from threads of its own until it is closed.

    Args:
        port: of the page.
        source_port: of the recording's server.

    Raises:
        RecordingError: Rerun does not give its viewer.
        OSError: the port is taken.
    """

    def __init__(self, port: int, source_port: int) -> None:
        with contextlib.ExitStack() as stack:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="pumpbench-page-")))
            _take_files(folder)
            handler = functools.partial(_Handler, directory=str(folder), policy=_policy(source_port))
            server = stack.enter_context(http.server.ThreadingHTTPServer((ADDRESS, port), handler))
            stack.callback(server.shutdown)
            threading.Thread(target=server.serve_forever, daemon=True).start()
            self._stack = stack.pop_all()

    def close(self) -> None:
        """Stop serving."""
        self._stack.close()


def _policy(source_port: int) -> str:
    """What a browser may load: scripts and wasm of the page itself, and the recording, by either name of the host."""
    sources = " ".join(f"http://{host}:{source_port}" for host in (ADDRESS, "localhost"))
    scripts = "'self' 'unsafe-inline' 'unsafe-eval' blob:"
    return (
        f"default-src 'self' blob: data:; script-src {scripts}; style-src 'self' 'unsafe-inline'; "
        f"connect-src 'self' blob: data: {sources}"
    )


class _Handler(http.server.SimpleHTTPRequestHandler):
    """A file server that sends the policy along and writes no log."""

    def __init__(self, *arguments: object, directory: str, policy: str) -> None:
        self._policy = policy
        super().__init__(*arguments, directory=directory)  # type: ignore[arg-type]

    def end_headers(self) -> None:
        self.send_header("Content-Security-Policy", self._policy)
        super().end_headers()

    def log_message(self, *_arguments: object) -> None:
        pass


def _take_files(folder: Path) -> None:
    """Get the viewer out of Rerun's program, which serves it but does not tell where it has it."""
    with socket.socket() as probe:
        probe.bind((ADDRESS, 0))
        port = probe.getsockname()[1]
    source = f"rerun+http://{ADDRESS}:1/proxy"  # it wants to know one; nobody will ask it
    command = [str(rerun_binary()), "--serve-web", "--bind", ADDRESS, "--web-viewer-port", str(port), source]
    with tempfile.TemporaryDirectory() as scratch:
        server = subprocess.Popen(
            command,
            env=quiet_environment(Path(scratch)),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            _wait_for(server, port)
            for name in FILES:
                address = f"http://{ADDRESS}:{port}/{name.replace('index.html', '')}"
                with urllib.request.urlopen(address, timeout=START_SECONDS) as answer:
                    (folder / name).write_bytes(answer.read())
        except OSError as error:
            raise RecordingError(f"Rerun's web viewer cannot be had: {error}") from error
        finally:
            server.kill()  # it may have inherited that SIGTERM is ignored
            server.wait()


def _wait_for(server: subprocess.Popen[bytes], port: int) -> None:
    deadline = time.monotonic() + START_SECONDS
    while True:
        with contextlib.suppress(OSError), socket.create_connection((ADDRESS, port), timeout=1):
            return
        if server.poll() is not None or time.monotonic() > deadline:
            raise ConnectionError("its server does not come up")
        time.sleep(0.02)
