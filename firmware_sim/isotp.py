"""Messages longer than a frame, as ISO 15765-2 carries them: normal addressing, classic CAN, both directions.

What it does *not* do: time. The device has no clock but the bench's, so it asks for no pause between frames (STmin 0)
and keeps none that the other side asks for, and no time-out ends a transfer. A new request does: it ends whatever was
half received or half sent, so that no tester can leave the device stuck.
"""

SINGLE, FIRST, CONSECUTIVE, FLOW_CONTROL = range(4)
CONTINUE, WAIT, OVERFLOW = range(3)
"""Status of a flow control."""

FRAME = 8
PADDING = 0xCC
RECEIVE_MAX = 128
"""Bytes of the longest request; a longer one is answered with Overflow."""

SEND_MAX = 4095
"""Bytes of the longest message with a 12-bit length."""


class IsoTp:
    """One connection, between two nodes that take turns: request, then answer."""

    def __init__(self) -> None:
        self._received = b""
        self._expected = 0  # bytes of the message being received; 0 = none
        self._next = 0  # number of the consecutive frame that comes next, either way
        self._unsent = b""

    def receive(self, frame: bytes) -> tuple[bytes | None, list[bytes]]:
        """Take one frame.

        Args:
            frame: its payload, 0 to 8 bytes; what makes no sense is ignored, as the standard asks.

        Returns:
            The message this frame completes, if it does, and the frames to send now.
        """
        kind = frame[0] >> 4 if frame else -1
        if kind == SINGLE:
            return self._on_single(frame), []
        if kind == FIRST and len(frame) == FRAME:
            return None, self._on_first(frame)
        if kind == CONSECUTIVE:
            return self._on_consecutive(frame), []
        if kind == FLOW_CONTROL and len(frame) >= 3:
            return None, self._on_flow_control(frame[0] & 0xF, frame[1])
        return None, []

    def send(self, message: bytes) -> list[bytes]:
        """The first frames of a message; the others follow when the receiver lets them.

        Raises:
            ValueError: it is empty or longer than `SEND_MAX`.
        """
        if not 0 < len(message) <= SEND_MAX:
            raise ValueError(f"a message of {len(message)} bytes, expected 1 to {SEND_MAX}")
        self._unsent = b""
        if len(message) < FRAME:
            return [_padded(bytes([len(message)]) + message)]
        self._unsent = message[FRAME - 2 :]
        self._next = 1
        return [bytes([FIRST << 4 | len(message) >> 8, len(message) & 0xFF]) + message[: FRAME - 2]]

    def _forget(self) -> None:
        """End what is half done."""
        self._received = self._unsent = b""
        self._expected = 0

    def _on_single(self, frame: bytes) -> bytes | None:
        length = frame[0] & 0xF
        if not 0 < length < min(len(frame), FRAME):
            return None
        self._forget()
        return frame[1 : 1 + length]

    def _on_first(self, frame: bytes) -> list[bytes]:
        length = (frame[0] & 0xF) << 8 | frame[1]
        if 0 < length < FRAME:
            return []
        self._forget()
        if not 0 < length <= RECEIVE_MAX:  # 0: a 32-bit length follows
            return [_padded(bytes([FLOW_CONTROL << 4 | OVERFLOW, 0, 0]))]
        self._expected = length
        self._received = frame[2:]
        self._next = 1
        return [_padded(bytes([FLOW_CONTROL << 4 | CONTINUE, 0, 0]))]

    def _on_consecutive(self, frame: bytes) -> bytes | None:
        if self._expected == 0:
            return None
        missing = self._expected - len(self._received)
        if frame[0] & 0xF != self._next or len(frame) - 1 < min(missing, FRAME - 1):
            self._forget()
            return None
        self._next = (self._next + 1) & 0xF
        self._received += frame[1 : 1 + missing]
        if len(self._received) < self._expected:
            return None
        message = self._received
        self._forget()
        return message

    def _on_flow_control(self, status: int, block_size: int) -> list[bytes]:
        if status == WAIT:
            return []
        if status != CONTINUE:
            self._unsent = b""
        frames: list[bytes] = []
        while self._unsent and (block_size == 0 or len(frames) < block_size):
            frames.append(_padded(bytes([CONSECUTIVE << 4 | self._next]) + self._unsent[: FRAME - 1]))
            self._unsent = self._unsent[FRAME - 1 :]
            self._next = (self._next + 1) & 0xF
        return frames


def _padded(frame: bytes) -> bytes:
    return frame.ljust(FRAME, bytes([PADDING]))
