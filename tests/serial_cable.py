"""Two serial adapters on one CAN bus, made of ptys: what one program sends as slcan lines, the other one reads."""

import contextlib
import os
import select
import threading
import tty
from collections.abc import Iterator


@contextlib.contextmanager
def cable() -> Iterator[tuple[str, str]]:
    """Two slcan URLs whose adapters stand on the same bus."""
    ends = [os.openpty() for _ in range(2)]
    for _, slave in ends:
        tty.setraw(slave)
    stop_read, stop_write = os.pipe()
    masters = [master for master, _ in ends]

    def carry() -> None:
        rest = dict.fromkeys(masters, b"")
        while True:
            ready, _, _ = select.select([*masters, stop_read], [], [])
            if stop_read in ready:
                return
            for master in ready:
                *lines, rest[master] = (rest[master] + os.read(master, 65536)).split(b"\r")
                frames = [line for line in lines if line[:1] in b"tTrR" and line]
                if frames:
                    os.write(masters[1 - masters.index(master)], b"".join(line + b"\r" for line in frames))

    thread = threading.Thread(target=carry)
    thread.start()
    try:
        first, second = (f"slcan:{os.ttyname(slave)}@500000" for _, slave in ends)
        yield first, second
    finally:
        os.write(stop_write, b"x")
        thread.join()
        for descriptor in (stop_read, stop_write, *(end for pair in ends for end in pair)):
            os.close(descriptor)
