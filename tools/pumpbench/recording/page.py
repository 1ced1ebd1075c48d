"""Rerun's viewer as a page for a browser on this machine, which talks to nobody but the recording's server.

The page that Rerun serves asks for a font, for the newest release and for examples, and posts what it is used for to
Rerun's makers. There is no switch for the latter in a browser, so the page passes through here and gets a
Content-Security-Policy, by which the browser itself refuses all of that.
"""

from __future__ import annotations

import contextlib
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Final
from urllib.parse import quote, urlsplit

PASSED_ON: Final = ("Content-Type", "Content-Encoding")


@contextlib.contextmanager
def served(upstream: str, recording: str, port: int) -> Iterator[str]:
    """Serve the page on 127.0.0.1 as long as this lasts; the value is the address to open.

    Args:
        upstream: address of the page that Rerun serves.
        recording: `rerun+http://host:port/proxy` of what it is to show.
        port: to serve on.

    Raises:
        OSError: somebody else listens on that port.
    """
    source = urlsplit(recording.removeprefix("rerun+")).netloc
    policy = (
        "default-src 'self' 'unsafe-inline' 'wasm-unsafe-eval' data: blob:; "
        f"connect-src 'self' http://{source} https://{source} data: blob:"
    )

    class Page(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            try:
                with urllib.request.urlopen(upstream + self.path) as answer:
                    body: bytes = answer.read()
                    headers = {name: answer.headers[name] for name in PASSED_ON if answer.headers[name]}
            except urllib.error.HTTPError as error:
                self.send_error(error.code)
                return
            except OSError as error:
                self.send_error(HTTPStatus.BAD_GATEWAY, str(error))
                return
            self.send_response(HTTPStatus.OK)
            for name, value in (
                headers | {"Content-Length": str(len(body)), "Content-Security-Policy": policy}
            ).items():
                self.send_header(name, value)
            self.end_headers()
            with contextlib.suppress(ConnectionError):  # the browser went away
                self.wfile.write(body)

        def log_message(self, *_arguments: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", port), Page) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.1,), daemon=True)
        thread.start()
        try:
            yield f"http://127.0.0.1:{port}/?url={quote(recording, safe='')}"
        finally:
            server.shutdown()
            thread.join()
