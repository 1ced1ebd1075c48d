#!/usr/bin/env python3
"""The emulated microcontroller as the device: QEMU runs fw.elf, its UART is a serial port with slcan on it.

    pumpbench run --strategy nma --firmware "examples/c_firmware/cortex_m3/run.py {bus}"

joins that port to a bus until the run ends. Without a URL the port is only announced, for a bench that opens it itself:

    examples/c_firmware/cortex_m3/run.py                                       # prints slcan:/dev/pts/7@500000
    pumpbench run --strategy nma --bus slcan:/dev/pts/7@500000 --firmware none

It wants the Python that has pumpbench. Exit status: 0 the run ended, 2 wrong usage, 3 the bus or the emulator is gone.
"""

import argparse
import contextlib
import ctypes
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from can_bus.gateway import Gateway, serve
from can_bus.process import exit_status
from can_bus.url import open_link

KERNEL = Path(__file__).parents[1] / "build" / "fw.elf"
MACHINE = ("-M", "mps2-an385", "-display", "none", "-monitor", "none", "-serial", "pty")
PR_SET_PDEATHSIG = 1


def end_with_parent() -> None:
    """In the emulator's process: leave nothing behind, even when this script is killed."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


@contextlib.contextmanager
def emulator(qemu: str, kernel: Path) -> Iterator[tuple["subprocess.Popen[str]", str]]:
    """QEMU with the firmware, and the URL of its UART; it ends with the context.

    Raises:
        OSError: it does not start.
    """
    command = [qemu, *MACHINE, "-kernel", str(kernel)]
    with subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        text=True,
        preexec_fn=end_with_parent,  # noqa: PLW1509, there are no threads here
    ) as process:
        try:
            assert process.stdout is not None
            port = re.search(r"redirected to (\S+)", process.stdout.readline())
            if port is None:
                raise OSError(f"{qemu} ended with status {process.wait()}, before it had a serial port")
            yield process, f"slcan:{port[1]}@500000"
        finally:
            process.kill()


def run(qemu: str, kernel: Path, bus: str | None) -> None:
    """Be the device on a bus until the run ends; without a bus, on a serial port for as long as the emulator lives.

    Raises:
        BusLost, OSError: the bus is gone, or the emulator.
    """
    with emulator(qemu, kernel) as (process, port):
        if bus is None:
            print(port, flush=True)
            raise OSError(f"{qemu} ended with status {process.wait()}")
        with open_link(bus) as plant, open_link(port) as device:
            serve(Gateway(), device, plant)


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bus", nargs="?", metavar="URL", help="the bus to join, e.g. unix:/run/bench.sock")
    parser.add_argument("--kernel", type=Path, default=KERNEL, metavar="FILE", help="the program (build/fw.elf)")
    parser.add_argument("--qemu", default="qemu-system-arm", metavar="PROGRAM", help="the emulator")
    options = parser.parse_args()
    if shutil.which(options.qemu) is None:
        parser.error(f"there is no {options.qemu}: install it, or start this through tools/with_arm")
    if not options.kernel.is_file():
        parser.error(f"{options.kernel}: no such file; make it with `make -C examples/c_firmware cortex-m3`")
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    return exit_status("cortex_m3", lambda: run(options.qemu, options.kernel, options.bus))


if __name__ == "__main__":
    sys.exit(main())
