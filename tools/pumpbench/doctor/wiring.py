"""What can be said of a bus before and beside its frames: is it there, may we, is it up, what does the adapter say."""

import fcntl
import grp
import os
import socket
import struct
from pathlib import Path

from serial.tools.list_ports import comports

SIOCGIFFLAGS, IFF_UP = 0x8913, 1

ADAPTER_FLAGS = {
    0: "receive queue full",
    1: "transmit queue full",
    2: "error warning",
    3: "data overrun",
    5: "error passive",
    6: "arbitration lost",
    7: "bus error",
}
"""Bits of the slcan status (LAWICEL), bit 4 unused."""


def obstacle(url: str) -> tuple[str, str] | None:
    """What is seen at once to be in the way of opening a bus, and what to do; None if nothing is.

    Args:
        url: of the bus; one that cannot be understood is left to who opens it.
    """
    kind, _, rest = url.partition(":")
    if kind == "socketcan":
        return _interface_obstacle(rest)
    if kind == "slcan" and rest.startswith("/"):
        return _port_obstacle(Path(rest.split("@")[0].split(",")[0]))
    return None


def _interface_obstacle(name: str) -> tuple[str, str] | None:
    if name not in (known for _, known in socket.if_nameindex()):
        return None  # who opens it says so, or that the kernel has no CAN
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        answer = fcntl.ioctl(any_socket, SIOCGIFFLAGS, struct.pack("16sH14x", name.encode(), 0))
    if struct.unpack("16sH14x", answer)[1] & IFF_UP:
        return None
    return f"the interface {name} is down", advice_to_open(f"socketcan:{name}")


def _port_obstacle(port: Path) -> tuple[str, str] | None:
    if not port.exists():
        ports = ", ".join(sorted(found.device for found in comports()))
        return f"there is no {port}", f"plug the adapter in; serial ports of this machine: {ports or 'none'}"
    if not os.access(port, os.R_OK | os.W_OK):
        group = grp.getgrgid(port.stat().st_gid).gr_name
        return (
            f"{port} may not be opened by this user",
            f"join its group ({group}) with `sudo usermod -aG {group} $USER`, then log in again",
        )
    return None


def advice_to_open(url: str) -> str:
    """What to do about a bus that cannot be opened."""
    kind, _, rest = url.partition(":")
    if kind in ("unix", "tcp"):
        return (
            f"start the program that serves this hub, or let the doctor do it: --host, and then the device joins {url}"
        )
    if kind == "socketcan":
        return (
            f"an adapter: `sudo ip link set {rest} up type can bitrate 500000`; a vcan: `sudo ip link add {rest} type "
            f"vcan && sudo ip link set {rest} up`, or prefix the command with tools/with_vcan"
        )
    if kind == "slcan":
        return "is it the adapter's port, does another program hold it, is the bit rate behind @ one the adapter has?"
    return "see python-can's documentation of this interface"


def advice_when_silent(url: str, *, started: bool) -> str:
    """What to do when a bus is open and no frame comes."""
    kind, _, rest = url.partition(":")
    if started:
        return "does the program of --firmware open the bus it is given ({bus} in its command, or PUMPBENCH_BUS)?"
    if kind == "slcan":
        rate = rest.partition("@")[2].split(",")[0] or "the adapter's own"
        return (
            f"is the device powered, its bit rate the adapter's ({rate}), CAN_H and CAN_L not swapped, 120 ohm at both "
            "ends, the adapter not in listen-only mode?"
        )
    if kind == "socketcan":
        return (
            f"a program: does it open {rest}? A board: is it powered, is its bit rate that of `ip -details link show "
            f"{rest}`, CAN_H and CAN_L not swapped, 120 ohm at both ends?"
        )
    return f"start the device's program on {url}; it has to answer SYNC_Step(Init)"


def adapter_words(status: int) -> str:
    """The status flags of an slcan adapter in words."""
    return ", ".join(text for bit, text in ADAPTER_FLAGS.items() if status >> bit & 1) or "no error"
