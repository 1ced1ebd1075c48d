"""The firmware as a process: `python -m firmware_sim --bus URL`.

It waits for the bench's roll call, does one run, and ends with it.
"""

import argparse
import os
import sys
from collections.abc import Sequence

from can_bus.codec import message
from can_bus.process import exit_status
from can_bus.url import open_link

from .firmware import Firmware, subscriptions


def serve(url: str) -> None:
    """Run one firmware on a bus until the bench ends the run.

    Raises:
        BusUrlError: the URL names no bus.
        BusLost: the bus went away or lost frames.
    """
    firmware = Firmware()
    with open_link(url, filters=[message(name).can_id for name in subscriptions()]) as link:
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
    options = parser.parse_args(arguments)
    if not options.bus:
        parser.error("--bus URL is needed, e.g. socketcan:vcan0, unix:/run/bench.sock")
    return exit_status("firmware_sim", lambda: serve(options.bus))


if __name__ == "__main__":
    sys.exit(main())
