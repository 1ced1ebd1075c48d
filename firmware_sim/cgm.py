"""The CGM as the firmware sees it: which sample may be dosed on, and how old the newest one is."""

from collections.abc import Iterator
from dataclasses import dataclass

STATE_OK, STATE_BELOW_RANGE, STATE_ABOVE_RANGE = 1, 4, 5
"""CGM_Reading.CgmState of the usable kinds of sample."""

GLUCOSE_LOW, GLUCOSE_HIGH = 200, 8000
"""0.1 mg/dL: what a sensor in state Ok may say (project's choice, requirement SEN-04)."""

BELOW_RANGE_ACTS_AS, ABOVE_RANGE_ACTS_AS = 400, 4000
"""0.1 mg/dL (requirement SEN-05); below range suspends besides, for 40 is only where the sensor's scale ends."""

AGE_USABLE = 3
"""Steps: a sample older than this is not used at all (15 min; requirement SEN-01)."""

SEQUENCE_MODULUS = 65535
"""CgmSampleSeq runs from 0 to 65534; 65535 is SNA."""

NEVER = 1 << 20
"""Age of a sample that has not come yet."""

SETTLING_SAMPLES = 3
"""Samples in a row after a gap before trends are trusted again (requirement SEN-08)."""

JUMP = 500
"""0.1 mg/dL in one step: a rise above this is believed only when the next sample agrees (requirement SEN-06)."""

NOISE_HIGH = 30
"""CgmNoise in 0.5 mg/dL above which insulin stays at or below the schedule (requirement SEN-09)."""

NOISE_RESERVED = 254

FAULT_BITS = 1 | 2 | 8
"""CgmFaultBits that do the same: noise, compression low, calibration error."""

SESSION_SNA = 255


@dataclass
class Verdict:
    """What one step's samples came to."""

    glucose: int = -1  # 0.1 mg/dL, -1 = nothing usable
    refused: int = 0  # samples refused for what they say or when they were taken
    repeated: int = 0  # samples refused as not newer than the last one
    late: int = 0  # samples used that were taken at an earlier instant
    missing: int = 0  # sample numbers skipped whose frames never came


class Cgm:
    """Judges samples by state, range, number and time; keeps the age of the newest usable one."""

    def __init__(self) -> None:
        self._sequence: int | None = None
        self._taken: int | None = None  # step of the newest usable sample
        self.below_range = False  # the newest usable sample says only that glucose is very low
        self._skipped = 0  # frames in this step that E2E did not allow to read
        self._unused = 0  # frames since the newest usable sample that came and could not be used
        self.streak = 0  # steps in a row with a usable sample
        self.since_gap = 0  # usable samples since the last gap longer than AGE_USABLE
        self.stuck_limit = 0  # equal values in a row that make the sensor unusable; 0 = off
        self.doubtful = False  # the sensor itself says that it is not to be trusted
        self._session = SESSION_SNA
        self._glucose_last = -1  # newest usable sample
        self._unconfirmed = -1  # a rise that waits for the next sample to agree
        self._equal = 0  # samples in a row with the value of the one before
        self._value_last = -1

    @property
    def waiting(self) -> bool:
        """Whether a rise waits for its confirmation."""
        return self._unconfirmed >= 0

    def status(self, values: dict[str, int]) -> None:
        """A CGM_Status: noise, faults, and whether it is another sensor."""
        noisy = NOISE_HIGH < values["CgmNoise"] < NOISE_RESERVED
        self.doubtful = noisy or values["CgmFaultBits"] & FAULT_BITS != 0
        session = values["CgmSessionId"]
        if session not in (SESSION_SNA, self._session):
            if self._session != SESSION_SNA:
                self.since_gap = 0
                self._unconfirmed = self._glucose_last = self._value_last = -1
            self._session = session

    def age(self, step: int) -> int:
        """Steps since the newest usable sample was taken."""
        return NEVER if self._taken is None else step - self._taken

    @property
    def sequence(self) -> int | None:
        """CgmSampleSeq of the newest usable sample."""
        return self._sequence

    @property
    def settling(self) -> bool:
        """Whether trends must not be trusted yet."""
        return self.since_gap < SETTLING_SAMPLES

    def skip(self) -> None:
        """A frame came that E2E does not allow to read.

        After a gap it is a sample, unused but not lost; beside a usable sample it is a copy.
        """
        self._skipped += 1

    def judge(self, samples: list[dict[str, int]], step: int) -> Verdict:
        """Take the CGM_Reading frames that arrived for instant `step` (checked by E2E before)."""
        verdict = Verdict()
        gap = self.age(step) > AGE_USABLE + 1
        for sample in samples:
            glucose = self._glucose(sample)
            age = (step - sample["CgmSampleStep"]) % 256
            if glucose < 0 or age > AGE_USABLE:
                verdict.refused += 1
                self._unused += 1
                continue
            number = sample["CgmSampleSeq"]
            ahead = 1
            if self._sequence is not None:
                ahead = (number - self._sequence) % SEQUENCE_MODULUS
                if not 0 < ahead < SEQUENCE_MODULUS // 2:
                    verdict.repeated += 1
                    continue
            if self._stuck(sample["GlucoseConc"], sample["CgmState"]) or self._jumped(glucose, step - age):
                verdict.refused += 1
                self._unused += 1
                continue
            verdict.late += age > 0
            verdict.missing += max(ahead - 1 - self._unused, 0)
            self._glucose_last = glucose
            self._unconfirmed = -1
            self._unused = 0
            self._sequence = number
            self._taken = step - age
            self.below_range = sample["CgmState"] == STATE_BELOW_RANGE
            verdict.glucose = glucose
        skipped = self._skipped
        self._skipped = 0
        if verdict.glucose < 0:
            self._unused += skipped
            self.streak = 0
        else:
            self.streak += 1
            self.since_gap = 1 if gap else min(self.since_gap + 1, SETTLING_SAMPLES)
        return verdict

    def _stuck(self, value: int, state: int) -> bool:
        """Whether this value has come too often in a row (requirement SEN-07); beyond the range it may."""
        if state != STATE_OK:
            self._equal, self._value_last = 0, -1
            return False
        self._equal = self._equal + 1 if value == self._value_last else 1
        self._value_last = value
        return 0 < self.stuck_limit <= self._equal

    def _jumped(self, glucose: int, taken: int) -> bool:
        """Whether a sample rises so fast that it waits for the next one to agree; a fall never waits."""
        if self._taken is None or self._glucose_last < 0 or taken - self._taken > AGE_USABLE:
            return False
        allowed = JUMP * max(taken - self._taken, 1)
        if glucose - self._glucose_last <= allowed:
            return False
        if self._unconfirmed >= 0 and -JUMP <= glucose - self._unconfirmed <= JUMP:
            return False
        self._unconfirmed = glucose
        return True

    def save(self) -> list[int]:
        """Words for the non-volatile memory: which sample was used last, so that none is used twice."""
        sequence = -1 if self._sequence is None else self._sequence
        taken = -1 if self._taken is None else self._taken
        return [sequence, taken, self._session, int(self.doubtful), self._glucose_last]

    def restore(self, words: Iterator[int]) -> None:
        """Take back what `save` wrote; trends start anew."""
        sequence, taken, self._session = next(words), next(words), next(words)
        self._sequence = None if sequence < 0 else sequence
        self._taken = None if taken < 0 else taken
        self.doubtful = next(words) == 1
        self._glucose_last = next(words)

    @staticmethod
    def _glucose(sample: dict[str, int]) -> int:
        state = sample["CgmState"]
        glucose = sample["GlucoseConc"]
        if sample["CgmSampleSeq"] >= SEQUENCE_MODULUS:
            return -1
        if state == STATE_BELOW_RANGE:
            return BELOW_RANGE_ACTS_AS
        if state == STATE_ABOVE_RANGE:
            return ABOVE_RANGE_ACTS_AS
        if state == STATE_OK and GLUCOSE_LOW <= glucose <= GLUCOSE_HIGH:
            return glucose
        return -1
