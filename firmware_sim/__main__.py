"""The firmware as a process: `python -m firmware_sim --bus URL`.

It waits for the bench's roll call, does one run, and ends with it.

With `--console` a thread serves the serial port. It shares no lock with the control loop: it reads the copies that the
loop leaves behind after each turn, and takes bytes no faster than a UART does, so that a flood costs the loop little
CPU and no frame. A console that fails ends alone, with one line on stderr; the run goes on.
"""

import argparse
import os
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

from can_bus.codec import message
from can_bus.frame import Frame
from can_bus.process import exit_status
from can_bus.url import open_link

from .console import Console, FirmwareView
from .firmware import NVM_BYTES, Cause, Firmware
from .nvm import FileMemory, NvmError
from .serial_port import PortError, SerialPort
from .wire import own_messages, subscriptions

POLL_SECONDS = 0.05

BYTES_PER_SECOND = 11520
"""Of the console: 115200 baud."""


def memory(path: Path) -> FileMemory:
    """The device's non-volatile memory in a file that only this user can read; made if it does not exist.

    Raises:
        NvmError: the file is no such memory.
        OSError: it cannot be opened.
    """
    return FileMemory(str(path), NVM_BYTES, opener=lambda name, flags: os.open(name, flags, 0o600))


def attend(port: SerialPort, console: Console, over: threading.Event) -> None:
    """Serve the console until the run is over: a thread of its own, which the control loop never waits for."""
    try:
        while not over.is_set():
            port.wait(POLL_SECONDS)
            data = port.read()
            console.unsent = port.dropped
            port.write(console.feed(data))
            over.wait(len(data) / BYTES_PER_SECOND)
    except OSError as error:
        print(f"firmware_sim: the console is gone: {error}", file=sys.stderr)


class _Attended:
    """The console of the device that runs now, and its thread."""

    def __init__(self, firmware: Firmware, port: SerialPort) -> None:
        self.view = FirmwareView(firmware)
        self._console = Console(self.view)
        self.view.log = firmware.log = self._console.log
        self._over = threading.Event()
        self._thread = threading.Thread(target=attend, args=(port, self._console, self._over), daemon=True)
        self._thread.start()

    def replace(self, firmware: Firmware) -> None:
        """The device after a reset."""
        firmware.log = self._console.log
        self.view.replace(firmware)

    def close(self) -> None:
        """End the thread before its port is closed, whose descriptor may soon be another file's."""
        self._over.set()
        self._thread.join(1)


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
    firmware = Firmware(nvm, cause)
    token = message("SYNC_Step").can_id
    attended = None if port is None else _Attended(firmware, port)
    try:
        with open_link(url, filters=[message(name).can_id for name in [*subscriptions(), *own_messages()]]) as link:
            link.send(firmware.start())
            while not firmware.finished:
                for frame in link.recv(None):
                    if firmware.reset_requested and frame.can_id == token and nvm is not None:
                        firmware = Firmware(nvm, Cause.SOFTWARE)
                        if attended is not None:
                            attended.replace(firmware)
                        answer: Sequence[Frame] = firmware.start()  # this token is lost, as in any reset
                    else:
                        answer = firmware.receive(frame)
                    if answer:
                        link.send(answer)
                        if attended is not None:
                            attended.view.publish()  # behind the answer: nobody on the bus waits for it
    finally:
        if attended is not None:
            attended.close()


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
