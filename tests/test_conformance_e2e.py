"""The checks of E2E and sequence: the reference passes each, and each can fail."""

from collections.abc import Sequence

import pytest
from conformance_devices import Changed, Values, Wired, expect_failed, expect_passed
from pumpbench.conformance.suite import select

from can_bus import codec
from can_bus.faults.fields import repaired
from can_bus.frame import CAN_SFF_MASK, Frame
from firmware_sim import e2e_window, ladder, wire
from firmware_sim.cgm import Cgm
from firmware_sim.wire import Wire


@pytest.mark.parametrize("requirement", [each.id for each in select(["E2E"])])
def test_the_reference_passes(requirement: str) -> None:
    expect_passed(requirement)


def mended(frame: Frame) -> Sequence[Frame]:
    """What a device hears that does not look at checksums."""
    message = codec.messages_by_id().get(frame.can_id)
    whole = message is not None and len(frame.data) == message.length
    return [frame._replace(data=repaired(message, frame.data))] if message is not None and whole else [frame]


def without_errors(frame: Frame) -> Sequence[Frame]:
    """What a device hears that throws damaged frames away and thinks no more of it."""
    return [frame] if frame == mended(frame)[0] else []


def any_kind(frame: Frame) -> Sequence[Frame]:
    """What a device hears that takes a remote frame and a 29-bit identifier for any other."""
    return [frame._replace(can_id=frame.can_id & CAN_SFF_MASK)]


def any_length(frame: Frame) -> Sequence[Frame]:
    """What a device hears that reads beyond the end of a frame."""
    message = codec.messages_by_id().get(frame.can_id)
    if message is None or len(frame.data) >= message.length:
        return [frame]
    return mended(frame._replace(data=frame.data.ljust(message.length, b"\0")))


def test_checksums_that_nobody_looks_at() -> None:
    expect_failed("E2E-01", "silence out of turn", Wired(mended))


def test_errors_that_nobody_counts() -> None:
    expect_failed(
        "E2E-01", "E2eErrorCount to count frames with one to three wrong bits once each", Wired(without_errors)
    )


def test_an_error_that_does_something(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Wire, "silence", lambda self, *_: 0 if self.e2e_errors == 0 else 9)
    expect_failed("E2E-01", "to change nothing in step")


@pytest.mark.parametrize(
    ("most", "text"), [(3, "a sample 4 ahead by its counter is not used"), (1, "is used; LastCgm")]
)
def test_counter_steps(monkeypatch: pytest.MonkeyPatch, most: int, text: str) -> None:
    monkeypatch.setattr(codec, "MAX_LOST", most)
    expect_failed("E2E-02", text)


def test_lost_frames_that_nobody_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Wire, "lost_frames", 0)
    expect_failed("E2E-02", "LostFrameCount to grow by 1 with")


def test_commands_whose_counter_nobody_looks_at() -> None:
    counters: list[int] = []

    def in_order(frame: Frame) -> Sequence[Frame]:
        if frame.can_id != codec.message("MODE_Cmd").can_id:
            return [frame]
        counters.append(len(counters) % 16)
        return [frame._replace(data=repaired(codec.message("MODE_Cmd"), frame.data, counters[-1]))]

    expect_failed("E2E-02", "a MODE_Cmd 4 ahead by its counter is not obeyed", Wired(in_order))


def test_errors_that_no_window_sees() -> None:
    expect_failed("E2E-03", "good sample 1 after 2 wrong ones in a row is not used", Wired(without_errors))


@pytest.mark.parametrize(
    ("most", "text"),
    [(0, "good sample 1 after 1 wrong ones in a row is used"), (2, "good sample 1 after 2 wrong ones in a row is not")],
)
def test_windows_for_more_or_fewer_errors(monkeypatch: pytest.MonkeyPatch, most: int, text: str) -> None:
    monkeypatch.setattr(e2e_window, "ERRORS_AT_MOST", most)
    expect_failed("E2E-03", text)


def test_a_message_without_a_window(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wire, "CYCLIC", ("CGM_Reading", "PUMP_Status"))
    expect_failed("E2E-03", "PUMP_Delivered with 3 U more, good frame 1 after 2 wrong ones in a row, is not used")


def test_sixteen_lost_that_nobody_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Wire, "lost_frames", property(lambda self: self._receiver.lost))
    expect_failed("E2E-04", "LostFrameCount to grow by 16")


def test_sixteen_lost_that_nobody_is_told_of() -> None:
    def quiet(name: str, values: Values) -> Values:
        return values | {"CtrlAlarmCode": 2} if name == "CTRL_Alarm" else values

    expect_failed("E2E-04", "the alarm CgmLost", Changed(says=quiet))


def test_a_counter_that_has_come_round(monkeypatch: pytest.MonkeyPatch) -> None:
    as_given = Cgm.judge
    monkeypatch.setattr(
        Cgm,
        "judge",
        lambda self, samples, step: as_given(
            self, [sample | {"CgmSampleSeq": step, "CgmSampleStep": step % 256} for sample in samples], step
        ),
    )
    expect_failed("E2E-04", "a sample that is 16 frames old is not used")


def test_masquerade_by_checksum() -> None:
    expect_failed("E2E-05", "frames of another message to change nothing in step 5", Wired(mended))


def test_masquerade_that_nobody_tells_of(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Wire, "e2e_errors", property(lambda self: self._receiver.crc_errors + self._receiver.malformed))
    expect_failed("E2E-05", "the alarm E2EFault for a SYNC_Done")


def test_boluses_beside_an_impostor(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Wire, "alone", lambda *_: True)
    expect_failed("E2E-05", "no bolus in the step in which somebody else")


@pytest.mark.parametrize(("hears", "text"), [(any_kind, "silence out of turn"), (any_length, "to change nothing")])
def test_malformed_frames(hears: object, text: str) -> None:
    expect_failed("E2E-06", text, Wired(hears))  # type: ignore[arg-type]


def test_malformed_frames_that_nobody_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Wire, "e2e_errors", property(lambda self: self._receiver.crc_errors))
    expect_failed("E2E-06", "E2eErrorCount to count frames of another length or kind")


@pytest.mark.parametrize(
    ("limit", "text"),
    [(9, "another state than Auto 4 steps after the last PUMP_Status"), (2, "Auto 2 steps after the last PUMP_Status")],
)
def test_silence(monkeypatch: pytest.MonkeyPatch, limit: int, text: str) -> None:
    monkeypatch.setattr(ladder, "PUMP_SILENT", limit)
    expect_failed("E2E-07", text)


@pytest.mark.parametrize("name", ["HB_PUMP", "HB_CGM"])
def test_a_heartbeat_that_nobody_misses(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    as_it_is = Wire.silence
    monkeypatch.setattr(Wire, "silence", lambda self, of, step: 0 if of == name else as_it_is(self, of, step))
    expect_failed("E2E-07", f"another state than Auto 4 steps after the last {name}")


def foreign(frame: Frame) -> Sequence[Frame]:
    """A frame of the pump beside each alarm."""
    alarm = frame.can_id == codec.message("CTRL_Alarm").can_id
    return [Frame(codec.message("PUMP_Alarm").can_id, bytes(8)), frame] if alarm else [frame]


def short(frame: Frame) -> Sequence[Frame]:
    """Heartbeats that are too short."""
    return [frame._replace(data=frame.data[:1]) if frame.can_id == codec.message("HB_CTRL").can_id else frame]


def stale_counter(frame: Frame) -> Sequence[Frame]:
    """Set-points whose counter stands still."""
    command = codec.message("PUMP_BasalCmd")
    return [frame._replace(data=repaired(command, frame.data, 0)) if frame.can_id == command.can_id else frame]


@pytest.mark.parametrize(
    ("says", "text"), [(foreign, "PUMP_Alarm"), (short, "MALFORMED"), (stale_counter, "PUMP_BasalCmd")]
)
def test_what_ctrl_sends(says: object, text: str) -> None:
    expect_failed("E2E-08", text, Wired(says=says))  # type: ignore[arg-type]
