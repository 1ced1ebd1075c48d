"""The python-can plugin: `can.Bus(interface="hilbus", channel="unix:/path")`."""

from __future__ import annotations

import time
from typing import Any

import can
from can.typechecking import CanFilters

from can_bus.frame import from_message, to_message
from can_bus.hub_link import HubLink
from can_bus.inproc import InprocLink, inproc_hub


class HilBus(can.BusABC):
    """A hub, or a bus inside this process, for everything that speaks python-can.

    Works with `can.Notifier`, `can.logger` and `can.viewer` alike. Time stamps are taken when a message is
    read, not when it was switched. CAN FD is refused.
    """

    def __init__(
        self,
        channel: str,
        can_filters: CanFilters | None = None,
        receive_own_messages: bool = False,
        wait: float = 0.0,
        **kwargs: Any,
    ) -> None:
        """Connect.

        Args:
            channel: `unix:/path`, `tcp:127.0.0.1:port` or `inproc:name`.
            can_filters: as for every python-can bus, applied in this process.
            receive_own_messages: whether sent messages come back, in their place in the bus's order.
            wait: seconds to wait for a hub that is not there yet.
            **kwargs: ignored, for the sake of configuration files.
        """
        if kwargs.get("fd"):
            raise ValueError("hilbus carries classic CAN only, fd=True is not possible")
        url = str(channel)
        self._link: HubLink | InprocLink
        if url.startswith("inproc:"):
            self._link = InprocLink(inproc_hub(url.removeprefix("inproc:")), echo=receive_own_messages)
        else:
            self._link = HubLink(url, echo=receive_own_messages, wait=wait)
        self.channel = url
        self.channel_info = f"hilbus {url}"
        super().__init__(channel=channel, can_filters=can_filters)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        frame = self._link.recv_one(timeout)
        if frame is None:
            return None, False
        return to_message(frame, timestamp=time.time(), channel=self.channel), False

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a message; `timeout` is not needed, a hub always takes it."""
        self._link.send([from_message(msg)])

    def fileno(self) -> int:
        """Readable when a message waits: one `recv` takes one message, nothing is buffered here."""
        return self._link.fileno()

    def shutdown(self) -> None:
        """Leave the bus; calling it again is fine."""
        super().shutdown()
        self._link.close()
