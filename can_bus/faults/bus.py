"""Faults of the bus: frames nobody of the bench sent, and a node that the bus does not hear."""

from typing import Annotated, ClassVar, Literal

from pydantic import Field, field_validator, model_validator

from can_bus import codec
from can_bus.frame import CAN_ERR_FLAG, CAN_SFF_MASK, MAX_DATA, Frame

from .base import TARGETS, Fault, Memory
from .fields import MessageName

ERROR_BUS_OFF, ERROR_RESTARTED, ERROR_BUS = 0x40, 0x100, 0x80
"""Classes of error frames (linux/can/error.h)."""

TESTER_ASKS = "UDS_Request"


class BusFault(Fault):
    """Puts frames on one side of the gateway in every step of its window, ahead of what passes the turn on."""

    target: ClassVar[int] = TARGETS["PLANT"]

    side: Literal["device", "plant"] = "device"
    every: Annotated[int, Field(ge=1)] = 1
    """Steps from one time to the next."""

    @property
    def can_id(self) -> int:
        """What FAULT_Inject names."""
        return 0

    def inject(self, memory: Memory) -> list[Frame]:
        """The frames of one step."""
        raise NotImplementedError


class Babble(BusFault):
    """A babbling node: `frames` frames in every step, with the id of `message` or with `id`, and random bytes."""

    CODE: ClassVar[int] = 9
    kind: Literal["babble"] = "babble"
    message: MessageName | None = None
    id: Annotated[int, Field(ge=0, le=CAN_SFF_MASK)] | None = None
    frames: Annotated[int, Field(ge=1, le=5000)] = 100
    seed: Annotated[int, Field(ge=0)] = 0

    @model_validator(mode="after")
    def _one_of_them(self) -> "Babble":
        if self.message is not None and self.id is not None:
            raise ValueError("give either message or id")
        return self

    @property
    def can_id(self) -> int:
        """0 wins every arbitration."""
        return (self.id or 0) if self.message is None else codec.message(self.message).can_id

    def inject(self, memory: Memory) -> list[Frame]:
        """Babble."""
        length = MAX_DATA if self.message is None else codec.message(self.message).length
        return [Frame(self.can_id, memory.random.randbytes(length)) for _ in range(self.frames)]


class ForeignId(BusFault):
    """A node that does not belong here sends frames with an `id` that is not in the DBC."""

    CODE: ClassVar[int] = 26
    kind: Literal["foreign_id"] = "foreign_id"
    id: Annotated[int, Field(ge=0, le=CAN_SFF_MASK)] = 0x555
    data: str = "0011223344556677"
    frames: Annotated[int, Field(ge=1, le=5000)] = 1

    @field_validator("id")
    @classmethod
    def _foreign(cls, value: int) -> int:
        if value in codec.messages_by_id():
            raise ValueError(f"0x{value:03X} is {codec.messages_by_id()[value].name} in the DBC")
        return value

    @field_validator("data")
    @classmethod
    def _bytes(cls, value: str) -> str:
        try:
            size = len(bytes.fromhex(value))
        except ValueError:
            size = MAX_DATA + 1
        if size > MAX_DATA:
            raise ValueError('data is up to 8 bytes in hexadecimal, e.g. "00ff12"')
        return value

    @property
    def can_id(self) -> int:
        """The foreign one."""
        return self.id

    def inject(self, memory: Memory) -> list[Frame]:
        """Send."""
        return [Frame(self.id, bytes.fromhex(self.data))] * self.frames


class ErrorFrames(BusFault):
    """The controller reports bus errors: `frames` error frames (CAN_ERR_BUSERROR) in every step."""

    CODE: ClassVar[int] = 12
    kind: Literal["error_frames"] = "error_frames"
    frames: Annotated[int, Field(ge=1, le=5000)] = 1

    def inject(self, memory: Memory) -> list[Frame]:
        """Report."""
        return [Frame(CAN_ERR_FLAG | ERROR_BUS, bytes(MAX_DATA))] * self.frames


class SlowTask(BusFault):
    """A task of the device takes `work` units more in every step: a UDS request to the firmware's load routine.

    `task` counts the device's tasks from 0. Another firmware may know the routine (docs/diagnostics.md) or refuse it;
    then nothing happens.
    """

    CODE: ClassVar[int] = 33
    target: ClassVar[int] = TARGETS["CTRL"]
    kind: Literal["slow_task"] = "slow_task"
    side: Literal["device"] = "device"
    task: Annotated[int, Field(ge=0, le=255)] = 1
    work: Annotated[int, Field(ge=1, le=65535)] = 1000

    def inject(self, memory: Memory) -> list[Frame]:
        """An extended session, then the routine; no answers wanted."""
        can_id = codec.message(TESTER_ASKS).can_id
        load = bytes([0x07, 0x31, 0x81, 0x02, 0x01, self.task]) + self.work.to_bytes(2, "big")
        return [Frame(can_id, bytes([0x02, 0x10, 0x83]).ljust(MAX_DATA, b"\0")), Frame(can_id, load)]


class BusOff(Fault):
    """The device's controller is off the bus: nothing reaches the device or comes from it but the lockstep.

    The device gets an error frame CAN_ERR_BUSOFF at the beginning and CAN_ERR_RESTARTED at the end, as from a Linux
    driver.
    """

    CODE: ClassVar[int] = 10
    kind: Literal["bus_off"] = "bus_off"
