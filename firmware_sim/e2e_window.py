"""Whether a cyclic message may be used: a window over its last checks, after AUTOSAR's E2E state machine (E2E-03).

`can_bus.codec.Receiver` judges frame by frame; a CRC of 8 bits lets one damaged frame in 256 pass, so a link that is
being disturbed is not to be believed even where a frame looks good. A message is checked once in every step in which
something of it came:

* good: a frame that may be read. What came beside it takes nothing away, for a frame that fails its check is as if it
  had not been sent (E2E-01), and noise must not be able to change a dose (ROB-02).
* bad: only frames that may not be read, by their CRC, length, format or sequence.
* neither: the last frame again, which is old but no error.

A step without a frame is no check. How old a value may get is the business of the ladder, and the first sample after a
gap may be the one that says that glucose is very low. The window is not kept over a reset: the device then begins
without data, as at the start of a run.
"""

import enum

from can_bus.codec import Check

WINDOW = 4
"""Checks that count."""

MASK = (1 << WINDOW) - 1

MAY_BE_READ = (Check.OK, Check.OK_SOME_LOST)

ERRORS_AT_MOST = 1
"""Of these, checks with an error in which the message is still valid, or becomes so."""

OK_AT_START = 1
"""A run's first frame is used: one sample alone does not lead to Auto (STA-01), and the ladder watches its age."""

OK_TO_STAY = 1

OK_TO_RETURN = 2
"""After a disturbance one good frame may be chance."""


class Validity(enum.IntEnum):
    """What may be done with the values of a message."""

    NO_DATA = 0  # nothing good has come yet
    VALID = 1  # they are used
    INVALID = 2  # they are not


NEEDED = {Validity.NO_DATA: OK_AT_START, Validity.VALID: OK_TO_STAY, Validity.INVALID: OK_TO_RETURN}
"""Good checks within the window that make or keep a message valid."""


class E2eWindow:
    """The window of one message.

    Attributes:
        state: after the newest check.
    """

    def __init__(self) -> None:
        self.state = Validity.NO_DATA
        self._good = 0  # a bit per check, the newest lowest
        self._bad = 0
        self._heard: set[Check] = set()  # since the last check

    def hear(self, check: Check) -> None:
        """A frame of this message came."""
        self._heard.add(check)

    def close(self) -> bool:
        """Check what came since the last call, to be called once per step; whether it may be used."""
        if self._heard:
            good = not self._heard.isdisjoint(MAY_BE_READ)
            bad = not good and self._heard != {Check.REPEATED}
            self._good = (self._good << 1 | good) & MASK
            self._bad = (self._bad << 1 | bad) & MASK
            self._heard.clear()
            self._judge()
        return self.state == Validity.VALID

    def _judge(self) -> None:
        if self._good.bit_count() >= NEEDED[self.state] and self._bad.bit_count() <= ERRORS_AT_MOST:
            self.state = Validity.VALID
        elif self.state == Validity.VALID:
            self.state = Validity.INVALID
