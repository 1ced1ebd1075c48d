"""What the doctor hears on a bus: every frame is counted, and what is wrong with it noted in words."""

from collections import Counter
from collections.abc import Sequence

import dbc
from can_bus import codec
from can_bus.codec import Check, Receiver
from can_bus.frame import CAN_EFF_MASK, Frame
from plant_server.pump import NMT_BOOT_UP

TX_COUNT_MOST = 254
"""TxCount counts no further."""

BY_CTRL = tuple(message.name for message in dbc.load().messages if message.senders == ["CTRL"])


class Ears:
    """Keeps count of what comes from the bus; nothing is overlooked, and nothing is done about it.

    Attributes:
        frames: of any kind, error frames left out.
        errors: error frames of the CAN controller.
        own: frames of CTRL by message.
        values: of the newest good frame of a message.
        strangers: frames whose id the DBC does not know.
        echoes, others: frames on the bench's ids by message: such as the bench had sent itself, and all others.
        malformed, checksums, counters: message -> what was wrong with the first such frame of it.
        late: messages of CTRL heard behind its SYNC_Done, with how often.
        answers: SYNC_Done beyond the first one for the same token.
        restarts: HB_CTRL BootUp in the middle of the run.
        statuses: DoneStatus of the answers that were asked for.
        wrong_calls, wrong_steps: (StepIndex asked for, DoneStepIndex told) in the roll call and in the run.
        miscounts: (TxCount, frames that came) of turns in which they differ.
        turns: turns of the run that were answered.
    """

    def __init__(self) -> None:
        self.frames = 0
        self.errors = 0
        self.own: Counter[str] = Counter()
        self.values: dict[str, dict[str, int]] = {}
        self.strangers: Counter[int] = Counter()
        self.echoes: Counter[str] = Counter()
        self.others: Counter[str] = Counter()
        self.malformed: dict[str, str] = {}
        self.checksums: dict[str, str] = {}
        self.counters: dict[str, str] = {}
        self.late: Counter[str] = Counter()
        self.answers = 0
        self.restarts = 0
        self.statuses: Counter[int] = Counter()
        self.wrong_calls: list[tuple[int, int]] = []
        self.wrong_steps: list[tuple[int, int]] = []
        self.miscounts: list[tuple[int, int]] = []
        self.turns = 0
        self.diagnosis: bytes | None = None  # the newest UDS_Response
        self._receiver = Receiver(BY_CTRL)
        self._codecs = codec.messages_by_id()
        self._sent: set[Frame] = set()
        self._running = False
        self._fresh: dict[int, int] = {}  # ids heard since the counters began anew, with their newest counter
        self._asked = 0
        self._over = True  # the turn: SYNC_Done was heard
        self._in_turn = 0

    def give_turn(self, asked: int, frames: Sequence[Frame], *, running: bool) -> None:
        """The bench is about to send this batch, whose token has this StepIndex."""
        self._sent.update(frames)
        self._asked, self._over, self._in_turn = asked, False, 0
        if not running or not self._running:
            self._fresh.clear()  # a roll call, and the run behind it: counters begin anew
            self._receiver.reset()
        self._running = running

    def note_sent(self, frames: Sequence[Frame]) -> None:
        """The bench is about to send this outside of a turn."""
        self._sent.update(frames)

    def hear(self, frame: Frame) -> None:
        """Take note of a frame."""
        if frame.is_error:
            self.errors += 1
            return
        self.frames += 1
        message = self._codecs.get(frame.can_id & CAN_EFF_MASK)
        if message is None:
            self.strangers[frame.can_id] += 1
        elif message.sender != "CTRL":
            (self.echoes if frame in self._sent else self.others)[message.name] += 1
        elif message.name == "UDS_Response":
            self.own[message.name] += 1
            self.diagnosis = frame.data
        else:
            self.own[message.name] += 1
            self._hear_ctrl(frame, message)

    def _hear_ctrl(self, frame: Frame, message: codec.MessageCodec) -> None:
        name = message.name
        self._in_turn += 1
        if name == "HB_CTRL" and self._running and frame.data[:1] and frame.data[0] & 0x7F == NMT_BOOT_UP:
            self.restarts += 1
            self._in_turn = 0  # the token comes again
            self._fresh.clear()
            self._receiver.reset()
        verdict, _, values, _ = self._receiver.receive(frame)
        if verdict == Check.MALFORMED:
            kind = "a remote frame" if frame.is_remote else "a 29-bit frame" if frame.is_extended else "a data frame"
            text = f"{kind} of {len(frame.data)} bytes, ought to be a data frame of {message.length} with an 11-bit id"
            self.malformed.setdefault(name, text)
        elif verdict == Check.ERROR:
            self.checksums.setdefault(name, self._checksum(frame, message))
        elif message.data_ids is not None:
            self._count(frame, name)
        if values:
            self.values[name] = values
        if name == "SYNC_Done" and verdict not in (Check.MALFORMED, Check.ERROR):
            self._hear_done(message.unpack(frame.data))  # another device's has a counter of its own
        elif self._over:
            self.late[name] += 1

    @staticmethod
    def _checksum(frame: Frame, message: codec.MessageCodec) -> str:
        word = int.from_bytes(bytes([0, frame.data[1] & 0xF0, *frame.data[2:]]), "little")
        right = codec.protect(message, word, frame.data[1] & 0xF)[0]
        assert message.data_ids is not None
        number = frame.data[1] & 0xF
        return (
            f"[{frame.data.hex(' ')}] has CHECKSUM {frame.data[0]:02x}, ought to be {right:02x} "
            f"(COUNTER {number}, data id {message.data_ids[number]:02x})"
        )

    def _count(self, frame: Frame, name: str) -> None:
        """Judge COUNTER; only in the run, for during the roll call it begins anew with every answer."""
        number = frame.data[1] & 0xF
        last = self._fresh.get(frame.can_id)
        self._fresh[frame.can_id] = number
        if not self._running:
            return
        if last is None and number != 0:
            self.counters.setdefault(name, f"begins with {number} after the roll call, ought to begin with 0")
        elif last is not None and number != (last + 1) % codec.COUNTER_MODULUS:
            self.counters.setdefault(name, f"{number} behind {last}, ought to be {(last + 1) % codec.COUNTER_MODULUS}")

    def _hear_done(self, values: dict[str, int]) -> None:
        if values["DoneStepIndex"] != self._asked:
            wrong = self.wrong_steps if self._running else self.wrong_calls
            wrong.append((self._asked, values["DoneStepIndex"]))
            return
        if self._over:
            self.answers += 1
            return
        self._over = True
        self.statuses[values["DoneStatus"]] += 1
        if not self._running:
            return
        self.turns += 1
        if values["TxCount"] != min(self._in_turn, TX_COUNT_MOST):
            self.miscounts.append((values["TxCount"], self._in_turn))
