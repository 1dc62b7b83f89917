"""The trajectories of a study in a browser, served on this machine alone."""

from __future__ import annotations

import sys
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

from hybrid_opt.display.view import CarryView
from studies.errors import ReportError
from studies.report.data import gather_carries
from studies.report.stage import PAGE

HOST = "127.0.0.1"


def watch(root: Path, port: int) -> None:
    """Serve the report of a results folder until Ctrl-C; without a report, a page that plays its
    best selected trajectory.

    Args:
        port: where to listen; another free one is taken if it is in use.

    Raises:
        DualArmError: the results are incomplete, or no port is free.
    """
    server = page_server(page_of(root), port)
    print(f"Open http://{HOST}:{server.server_port} in a browser; Ctrl-C ends it.", file=sys.stderr)
    try:
        server.serve_forever()
    except KeyboardInterrupt:
        server.server_close()


def page_of(root: Path) -> bytes:
    """The page of a results folder.

    Raises:
        DualArmError: the results are incomplete.
    """
    if (root / PAGE).exists():
        return (root / PAGE).read_bytes()
    _, carries = gather_carries(root)
    return CarryView(carries[-1].timed).page().encode()


def page_server(page: bytes, port: int) -> ThreadingHTTPServer:
    """What gives a page to a browser of this machine, listening already.

    Raises:
        ReportError: no port is free.
    """

    class Handler(BaseHTTPRequestHandler):
        """Answers every request with the page."""

        def do_GET(self) -> None:
            """See `BaseHTTPRequestHandler`."""
            self.send_response(200)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.send_header("Content-Length", str(len(page)))
            self.end_headers()
            self.wfile.write(page)

        def log_message(self, *_: object) -> None:
            """Say nothing of requests."""

    for number in (port, 0):
        try:
            return ThreadingHTTPServer((HOST, number), Handler)
        except OSError as error:
            problem = error.strerror
    raise ReportError(f"nothing can be served at {HOST}: {problem}; open {PAGE} in a browser")
