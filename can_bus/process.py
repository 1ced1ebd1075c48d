"""A node as a process: what its command line returns when the bus or the arguments fail."""

import sys
from collections.abc import Callable

import can

from can_bus.codec import CodecError
from can_bus.link import BusLost
from can_bus.url import BusUrlError
from can_bus.yaml_file import FileError


def exit_status(name: str, node: Callable[[], None]) -> int:
    """Run a node to its end; an error of a kind we know is one line on stderr.

    Returns:
        0 the run ended, 2 wrong usage or file, 3 the bus was lost or could not be opened, 130 interrupted.
    """
    try:
        node()
    except (BusUrlError, CodecError, FileError) as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 2
    except (BusLost, can.CanError, OSError) as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 3
    except KeyboardInterrupt:
        return 130
    return 0
