"""The firmware as a process: `python -m firmware_sim --bus URL`.

It waits for the bench's roll call, does one run, and ends with it.
"""

import argparse
import os
import sys
import threading
from collections.abc import Iterable, Sequence
from pathlib import Path

from can_bus.codec import message
from can_bus.frame import Frame
from can_bus.process import exit_status
from can_bus.url import open_link

from .console import Console, Pairs
from .firmware import NVM_WORDS, Cause, Firmware, subscriptions
from .nvm import FileMemory, NvmError, memory_size
from .serial_port import PortError, SerialPort

POLL_SECONDS = 0.05


def memory(path: Path) -> FileMemory:
    """The device's non-volatile memory in a file that only this user can read; made if it does not exist.

    Raises:
        NvmError: the file is no such memory.
        OSError: it cannot be opened.
    """
    return FileMemory(str(path), memory_size(NVM_WORDS), opener=lambda name, flags: os.open(name, flags, 0o600))


class _Live:
    """The device that runs now, as the console sees it: a reset replaces it."""

    def __init__(self, firmware: Firmware) -> None:
        self.firmware = firmware
        self.console = Console(self)
        self.firmware.log = self.console.log

    def restart(self, nvm: FileMemory) -> list[Frame]:
        """A software reset; what the device then says by itself."""
        self.firmware = Firmware(nvm, Cause.SOFTWARE)
        self.firmware.log = self.console.log
        return self.firmware.start()

    def status(self) -> Pairs:
        return self.firmware.status()

    def parameters(self) -> dict[str, int]:
        return self.firmware.parameters()

    def faults(self) -> Iterable[Pairs]:
        return self.firmware.faults()

    def version(self) -> Pairs:
        return self.firmware.version()

    def request_reset(self) -> bool:
        return self.firmware.request_reset()


def attend(port: SerialPort, console: Console, over: threading.Event) -> None:
    """Serve the console until the run is over: a thread of its own, which the control loop never waits for."""
    while not over.is_set():
        port.wait(POLL_SECONDS)
        port.write(console.feed(port.read()))


def serve(
    url: str, nvm: FileMemory | None = None, cause: Cause = Cause.POWER_ON, port: SerialPort | None = None
) -> None:
    """Run one firmware on a bus until the bench ends the run.

    Args:
        url: of the bus.
        nvm: its non-volatile memory; None: it forgets everything at its end.
        cause: why it starts, as it will tell.
        port: of the console; None: there is none.

    Raises:
        BusUrlError: the URL names no bus.
        BusLost: the bus went away or lost frames.
    """
    live = _Live(Firmware(nvm, cause))
    token = message("SYNC_Step").can_id
    over = threading.Event()
    if port is not None:
        threading.Thread(target=attend, args=(port, live.console, over), daemon=True).start()
    try:
        with open_link(url, filters=[message(name).can_id for name in subscriptions()]) as link:
            boot = live.firmware.start()
            if boot:
                link.send(boot)
            while not live.firmware.finished:
                for frame in link.recv(None):
                    if live.firmware.reset_requested and frame.can_id == token and nvm is not None:
                        answer: Sequence[Frame] = live.restart(nvm)  # this token is lost, as in any reset
                    else:
                        answer = live.firmware.receive(frame)
                    if answer:
                        link.send(answer)
    finally:
        over.set()


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit status: 0 the bench ended the run, 2 wrong usage, 3 the bus was lost."""
    parser = argparse.ArgumentParser(prog="python -m firmware_sim", description=__doc__)
    parser.add_argument(
        "--bus", default=os.environ.get("PUMPBENCH_BUS"), help="bus URL; default: the variable PUMPBENCH_BUS"
    )
    parser.add_argument("--nvm", type=Path, help="file of the non-volatile memory; kept over a restart")
    parser.add_argument(
        "--reset-cause", choices=[cause.name.lower() for cause in Cause], default="power_on", help="told at boot"
    )
    parser.add_argument(
        "--console", metavar="PORT", help="serial console: pty, pty:/path/of/a/link, a device, or a pyserial URL"
    )
    options = parser.parse_args(arguments)
    if not options.bus:
        parser.error("--bus URL is needed, e.g. socketcan:vcan0, unix:/run/bench.sock")
    try:
        nvm = None if options.nvm is None else memory(options.nvm)
    except (NvmError, OSError) as error:
        parser.error(f"--nvm: {error}")
    port = None
    if options.console is not None:
        try:
            port = SerialPort(options.console)
        except PortError as error:
            parser.error(f"--console: {error}")
        print(f"console on {port.name}", file=sys.stderr)
    try:
        return exit_status("firmware_sim", lambda: serve(options.bus, nvm, Cause[options.reset_cause.upper()], port))
    finally:
        if port is not None:
            port.close()


if __name__ == "__main__":
    sys.exit(main())
