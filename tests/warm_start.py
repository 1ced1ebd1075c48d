"""`python -m pumpbench` out of a process that has imported already what most commands need.

Two of the three seconds of a short command are imports, and the tests give hundreds. A command is a process of its own
all the same, with its own directory, environment, output and exit status; only the imports are shared. rerun is not
among them: it starts threads of its own when it is imported, and a fork copies no thread.
"""

import importlib
import json
import os
import runpy
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

PRELOADED = (
    "matplotlib.backends.backend_agg",
    "matplotlib.figure",
    "pandas",
    "pumpbench.rig",
    "pyarrow.parquet",
    "rich.console",
    "typer",
)

REQUEST = 1 << 20
"""Most bytes of arguments and environment."""


class WarmStart:
    """The process to fork from; it ends when this is closed or its owner is gone."""

    def __init__(self) -> None:
        self._control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            command = [sys.executable, __file__, str(theirs.fileno())]
            self._server = subprocess.Popen(command, pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL)
        self.pid = self._server.pid

    def close(self) -> None:
        """End it."""
        self._control.close()
        self._server.wait()

    def run(self, arguments: Sequence[str], cwd: Path, timeout: float) -> "subprocess.CompletedProcess[str]":
        """As `subprocess.run` of `python -m pumpbench`, with its output captured as text.

        Raises:
            subprocess.TimeoutExpired: after `timeout` seconds; the command is killed.
        """
        request = {"arguments": arguments, "cwd": str(cwd), "environment": dict(os.environ)}
        ours, theirs = socket.socketpair()
        with tempfile.TemporaryFile("w+") as stdout, tempfile.TemporaryFile("w+") as stderr, ours:
            with theirs:
                descriptors = [theirs.fileno(), stdout.fileno(), stderr.fileno()]
                socket.send_fds(self._control, [json.dumps(request).encode()], descriptors)
            lines = ours.makefile()
            pid = int(lines.readline())
            ours.settimeout(timeout)
            try:
                status = int(lines.readline())
            except TimeoutError:
                os.kill(pid, signal.SIGKILL)
                raise subprocess.TimeoutExpired(list(arguments), timeout) from None
            stdout.seek(0)
            stderr.seek(0)
            return subprocess.CompletedProcess(list(arguments), status, stdout.read(), stderr.read())


def serve(control: socket.socket) -> None:
    """Fork for every request until the other end is closed. Returns in the process that becomes the command."""
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody waits for those that wait for a command
    while True:
        request, descriptors, _, _ = socket.recv_fds(control, REQUEST, 3)
        if not request:
            sys.exit()
        if os.fork() == 0:
            break
        for each in descriptors:
            os.close(each)
    control.close()
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    with socket.socket(fileno=descriptors[0]) as reply:
        pid = os.fork()
        if pid:
            reply.sendall(b"%d\n" % pid)
            reply.sendall(b"%d\n" % os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]))
            os._exit(0)
    for target, each in enumerate(descriptors[1:], start=1):
        os.dup2(each, target)
        os.close(each)
    command = json.loads(request)
    os.chdir(command["cwd"])
    os.environ.clear()
    os.environ.update(command["environment"])
    sys.argv[1:] = command["arguments"]


if __name__ == "__main__":
    for name in PRELOADED:
        importlib.import_module(name)
    serve(socket.socket(fileno=int(sys.argv[1])))
    sys.path[0] = str(Path.cwd())  # as `python -m` has it
    runpy.run_module("pumpbench", run_name="__main__", alter_sys=True)
