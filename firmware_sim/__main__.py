"""The firmware as a process: `python -m firmware_sim --bus URL`.

It waits for the bench's roll call, does one run, and ends with it.
"""

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from can_bus.codec import message
from can_bus.process import exit_status
from can_bus.url import open_link

from .firmware import NVM_WORDS, Cause, Firmware, subscriptions
from .nvm import FileMemory, NvmError, memory_size


def memory(path: Path) -> FileMemory:
    """The device's non-volatile memory in a file that only this user can read; made if it does not exist.

    Raises:
        NvmError: the file is no such memory.
        OSError: it cannot be opened.
    """
    return FileMemory(str(path), memory_size(NVM_WORDS), opener=lambda name, flags: os.open(name, flags, 0o600))


def serve(url: str, nvm: FileMemory | None = None, cause: Cause = Cause.POWER_ON) -> None:
    """Run one firmware on a bus until the bench ends the run.

    Args:
        url: of the bus.
        nvm: its non-volatile memory; None: it forgets everything at its end.
        cause: why it starts, as it will tell.

    Raises:
        BusUrlError: the URL names no bus.
        BusLost: the bus went away or lost frames.
    """
    firmware = Firmware(nvm, cause)
    with open_link(url, filters=[message(name).can_id for name in subscriptions()]) as link:
        boot = firmware.start()
        if boot:
            link.send(boot)
        while not firmware.finished:
            for frame in link.recv(None):
                answer = firmware.receive(frame)
                if answer:
                    link.send(answer)


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
    options = parser.parse_args(arguments)
    if not options.bus:
        parser.error("--bus URL is needed, e.g. socketcan:vcan0, unix:/run/bench.sock")
    try:
        nvm = None if options.nvm is None else memory(options.nvm)
    except (NvmError, OSError) as error:
        parser.error(f"--nvm: {error}")
    return exit_status("firmware_sim", lambda: serve(options.bus, nvm, Cause[options.reset_cause.upper()]))


if __name__ == "__main__":
    sys.exit(main())
