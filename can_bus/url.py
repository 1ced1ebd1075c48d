"""Bus URLs: one string says where a bus is, for python-can programs and for the nodes of this bench."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

import can
from can.interfaces import VALID_INTERFACES

from can_bus.adapter import PythonCanLink
from can_bus.address import BusUrlError, parse_address
from can_bus.hilbus import HilBus
from can_bus.hub_link import HubLink
from can_bus.inproc import InprocLink, inproc_hub
from can_bus.link import Link
from can_bus.slcan import SlcanLink
from can_bus.socketcan import SocketcanLink

__all__ = ["BusUrlError", "open_bus", "open_link"]

_EXPECTED = (
    "expected unix:/path, tcp:127.0.0.1:port, inproc:name, socketcan:vcan0, slcan:/dev/ttyACM0@500000"
    " or another python-can interface:channel"
)
_OPTION = re.compile(r",([a-z_]+)=([^,]*)$")
_BITRATE = re.compile(r"@([0-9]+)$")


def open_bus(url: str, *, receive_own_messages: bool = False) -> can.BusABC:
    """Open a bus for a program that speaks python-can.

    Raises BusUrlError when the URL cannot be understood and can.CanInitializationError when nothing is there.
    `socketcan:` gives python-can's own bus, which loses frames silently when its reader is slow; the link of
    `open_link` does not.
    """
    scheme = _scheme(url)
    if scheme in ("unix", "tcp"):
        parse_address(url)
        return HilBus(url, receive_own_messages=receive_own_messages)
    if scheme == "inproc":
        return HilBus(url, receive_own_messages=receive_own_messages)
    interface, settings = _python_can(url)
    try:
        return can.Bus(interface=interface, receive_own_messages=receive_own_messages, **settings)
    except (can.CanError, OSError, ValueError, TypeError, ImportError) as error:
        raise can.CanInitializationError(f"{url}: {error}") from error


def open_link(url: str, *, filters: Iterable[int] | None = None, wait: float = 0.0) -> Link:
    """Open a bus for a node of this bench.

    Args:
        url: see `BusUrlError`'s text for the forms.
        filters: the standard identifiers wanted; None for every frame. Error frames always come.
        wait: seconds to wait for a hub that is not there yet (`unix:` and `tcp:` only).

    Raises BusUrlError when the URL cannot be understood and can.CanInitializationError when nothing is there.
    """
    scheme = _scheme(url)
    if scheme in ("unix", "tcp"):
        return HubLink(url, filters=filters, wait=wait)
    if scheme == "inproc":
        return InprocLink(inproc_hub(url.removeprefix("inproc:")), filters=filters)
    if scheme == "socketcan":
        _, settings = _python_can(url)
        return SocketcanLink(settings["channel"], filters=filters)
    if scheme == "slcan":
        return SlcanLink(open_bus(url), url, filters=filters)
    return PythonCanLink(open_bus(url), url, filters=filters)


def _scheme(url: str) -> str:
    scheme, colon, rest = url.partition(":")
    if scheme in ("hub", "inproc") and not rest:
        raise BusUrlError(
            f"{url!r}: this is a private bus of one run, it has no address to open; name a bus:"
            " unix:/path, tcp:127.0.0.1:port or inproc:name"
        )
    if not colon or not rest:
        raise BusUrlError(f"{url!r}: {_EXPECTED}")
    return scheme


def _python_can(url: str) -> tuple[str, dict[str, Any]]:
    """Split `interface:channel[@bitrate][,key=value...]` into an interface and the settings of its bus."""
    interface, _, channel = url.partition(":")
    if interface not in VALID_INTERFACES:
        raise BusUrlError(f"{url!r}: python-can knows no interface {interface!r}; {_EXPECTED}")
    settings: dict[str, Any] = {}
    while match := _OPTION.search(channel):
        settings[match[1]] = _value(match[2])
        channel = channel[: match.start()]
    if interface != "socketcan" and (match := _BITRATE.search(channel)):
        settings["bitrate"] = int(match[1])
        channel = channel[: match.start()]
    if not channel:
        raise BusUrlError(f"{url!r}: no channel; {_EXPECTED}")
    if interface == "slcan":
        settings.setdefault("sleep_after_open", 0)
    settings["channel"] = channel
    return interface, settings


def _value(text: str) -> object:
    if text.lower() in ("true", "false"):
        return text.lower() == "true"
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text
