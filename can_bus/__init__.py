"""The wire: open a bus, the embedded hub, frames to signals and back, lockstep, the gateway with its faults."""

from can_bus.url import BusUrlError, open_bus, open_link

__all__ = ["BusUrlError", "open_bus", "open_link"]
