"""The user as the device knows them: the mode they chose and whether they suspended, by the numbers of MODE_Cmd."""

from collections.abc import Iterator

from .control.layout import MODE_OFF, MODE_S4

SUPPORTED_MODES = tuple(range(MODE_OFF, MODE_S4 + 1))
"""Modes this build accepts; any other is refused with DoseRejected."""

REQUEST_SUSPEND, REQUEST_RESUME = 1, 2
"""MODE_Cmd.SuspendRequest."""

SEQUENCES = 255
"""ModeCmdSeq runs from 0 to 254; 255 is SNA."""


class User:
    """What the user asked for last.

    Attributes:
        mode: MODE_Cmd.ModeRequest.
        suspended: delivery is to stop until the user resumes it.
        refused: commands with a mode that this build has not, so far.
        sequence_errors: commands that were older than the last one, so far.
    """

    def __init__(self) -> None:
        self.mode = MODE_OFF
        self.suspended = False
        self.refused = 0
        self.sequence_errors = 0
        self._sequence: int | None = None

    def hear(self, values: dict[str, int]) -> bool:
        """A MODE_Cmd, obeyed once however often it is repeated; whether it resumes delivery."""
        sequence = values["ModeCmdSeq"]
        if sequence == self._sequence:
            return False
        last = sequence - 1 if self._sequence is None else self._sequence
        if sequence >= SEQUENCES or (sequence - last) % SEQUENCES > SEQUENCES // 2:
            self.sequence_errors += 1
            return False
        self._sequence = sequence
        if values["ModeRequest"] in SUPPORTED_MODES:
            self.mode = values["ModeRequest"]
        else:
            self.refused += 1
        if values["SuspendRequest"] in (REQUEST_SUSPEND, REQUEST_RESUME):
            self.suspended = values["SuspendRequest"] == REQUEST_SUSPEND
        return values["SuspendRequest"] == REQUEST_RESUME

    def save(self) -> list[int]:
        """Words for the non-volatile memory."""
        return [self.mode, -1 if self._sequence is None else self._sequence, int(self.suspended)]

    def restore(self, words: Iterator[int]) -> None:
        """Take back what `save` wrote."""
        self.mode = next(words)
        sequence = next(words)
        self._sequence = None if sequence < 0 else sequence
        self.suspended = next(words) == 1
