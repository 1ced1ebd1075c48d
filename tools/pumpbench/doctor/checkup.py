"""What the doctor has heard, as lines: one check each, with what to do where something is wrong."""

import enum
import statistics
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import dbc
from can_bus.lockstep import STEPS_PER_DAY, Done
from plant_server.server import judge_version, stated_version
from pumpbench.doctor import wiring
from pumpbench.doctor.ears import Ears

DBC_CRC_IS = bytes.fromhex("07 62 01 01")
"""The start of a UDS answer with identifier 0101, as a single frame of ISO-TP (docs/diagnostics.md)."""


class Stage(enum.IntEnum):
    """How far a device has come."""

    ROLL_CALL = 0
    CALIBRATION = 1
    STEPS = 2
    END = 3
    OVER = 4


class Mark(enum.StrEnum):
    """What came of a check."""

    PASSED = "ok"
    FAILED = "FAIL"
    WARNED = "warn"
    SKIPPED = "-"


class Check(NamedTuple):
    """One line of the report: `advice` says what to do where something is wrong."""

    name: str
    mark: Mark
    found: str
    advice: str = ""


@dataclass(frozen=True)
class Request:
    """What to look at.

    Attributes:
        bus: `hub` for a private one, or a URL.
        firmware: the command that starts the device; None: the reference firmware on a private hub, anywhere else a
            device that runs by itself.
        host: serve the bus as a hub, from this process.
        strategy: the mode to ask for.
        steps: sampling instants to play.
        timeout: seconds of wall clock for the first answer, and for each one after it.
    """

    bus: str = "hub"
    firmware: str | None = None
    host: bool = False
    strategy: str = "nma"
    steps: int = 20
    timeout: float = 10.0

    @property
    def starts_device(self) -> bool:
        """Whether the device is a process of this check."""
        return self.firmware is not None or self.bus == "hub"


@dataclass(frozen=True)
class Heard:
    """What is known of a device when the doctor has done with it.

    Attributes:
        request: what was looked at.
        ears: what was heard.
        reached: the stage the device is in.
        silent: it did not answer there in time.
        refused: why the plant does not go on with it.
        lost, died: why the bus is gone, and the device's process.
        step: where the plant stands.
        latencies: seconds from the token of a step to its SYNC_Done, further turns included.
        adapter_status, adapter_refusals: of an slcan adapter; None and 0 of anything else.
    """

    request: Request
    ears: Ears
    reached: Stage
    silent: bool
    refused: str | None
    lost: str | None
    died: str | None
    step: int
    latencies: Sequence[float]
    adapter_status: int | None
    adapter_refusals: int


class Latency(NamedTuple):
    """How long a device takes from a token to its SYNC_Done, in seconds."""

    median: float
    worst: float
    patient_day: float  # of 288 steps

    @classmethod
    def of(cls, seconds: Sequence[float]) -> "Latency":
        """Of at least one step."""
        return cls(statistics.median(seconds), max(seconds), statistics.fmean(seconds) * STEPS_PER_DAY)


def judge(heard: Heard) -> list[Check]:
    """All checks that can be made, in the order in which a device gets them right."""
    ears = heard.ears
    found = [_bus(heard), *([_firmware(heard)] if heard.request.starts_device else []), _wire(heard)]
    if heard.died is not None and not ears.frames:
        return found
    found += [_frames_came(heard)]
    if not ears.frames:
        return found
    found += [_node(heard), _ids(ears)]
    if not ears.own:
        return found
    found += [_form(ears), _checksum(ears), _alone(ears)]
    if heard.reached == Stage.ROLL_CALL and ears.answers:
        return found  # no plant gets further with two
    found += [_roll_call(heard)]
    if heard.reached == Stage.ROLL_CALL and heard.refused is None:
        return found
    found += [_version(heard)]
    if heard.reached == Stage.ROLL_CALL:
        return found
    found += [_dbc(ears), _calibration(heard)]
    if heard.reached >= Stage.STEPS:
        found += [_mode(heard), _steps(heard)]
    found += [_order(ears), _tx_count(ears), _counter(ears)]
    if heard.latencies:
        found += [_latency(heard)]
    return found


def _bus(heard: Heard) -> Check:
    if heard.lost is not None:
        return Check("bus", Mark.FAILED, heard.lost, "the lines below tell how far it came")
    bus = heard.request.bus
    return Check("bus", Mark.PASSED, f"{'a private hub' if bus == 'hub' else bus} is open")


def _firmware(heard: Heard) -> Check:
    if heard.died is not None:
        return Check("firmware", Mark.FAILED, heard.died, "run its command by hand, and see what it says")
    return Check("firmware", Mark.PASSED, "its process runs")


def _wire(heard: Heard) -> Check:
    trouble = [f"{heard.ears.errors} error frames of the CAN controller"] if heard.ears.errors else []
    if heard.adapter_status:
        trouble += [f"the adapter reports {wiring.adapter_words(heard.adapter_status)}"]
    if heard.adapter_refusals:
        trouble += [f"the adapter refused {heard.adapter_refusals} commands"]
    advice = "the same bit rate on both sides? CAN_H and CAN_L not swapped, 120 ohm at both ends, the device powered?"
    if trouble:
        return Check("wire", Mark.FAILED, ", ".join(trouble), advice)
    return Check("wire", Mark.PASSED, "no errors of the bus")


def _frames_came(heard: Heard) -> Check:
    ears = heard.ears
    if ears.frames:
        return Check("frames", Mark.PASSED, f"{ears.frames} frames arrived")
    request = heard.request
    advice = wiring.advice_when_silent(request.bus, started=request.starts_device)
    return Check("frames", Mark.FAILED, f"nothing arrived within {request.timeout:g} s", advice)


def _node(heard: Heard) -> Check:
    ears = heard.ears
    if {"HB_CTRL", "CTRL_Info"} & ears.own.keys():
        said = " and ".join(name for name in ("HB_CTRL", "CTRL_Info") if name in ears.own)
        return Check("node", Mark.PASSED, f"CTRL says {said}")
    if ears.own:
        return Check(
            "node", Mark.WARNED, "CTRL says neither HB_CTRL nor CTRL_Info: nobody sees it restart",
            "answer the roll call with HB_CTRL (BootUp), CTRL_Info and SYNC_Done",
        )  # fmt: skip
    return Check(
        "node", Mark.FAILED, f"no frame of CTRL came, but {_foreign(ears)}",
        "the device has to answer SYNC_Step(Init) with frames of CTRL: docs/protocol.md, Turns",
    )  # fmt: skip


def _foreign(ears: Ears) -> str:
    known = [f"{name} ({count})" for name, count in (ears.echoes + ears.others).most_common(3)]
    return ", ".join(known + [f"0x{can_id:X} ({count})" for can_id, count in ears.strangers.most_common(3)])


def _ids(ears: Ears) -> Check:
    if ears.others:
        return Check(
            "ids", Mark.FAILED, f"somebody else sends frames of the bench: {_counted(ears.others)}",
            "the device may send CTRL's frames only; is another bench or tool on this bus?",
        )  # fmt: skip
    if ears.echoes:
        return Check(
            "ids", Mark.FAILED, f"the bench's own frames come back: {_counted(ears.echoes)}",
            "the device or the adapter repeats what it hears: switch its echo or loopback off",
        )  # fmt: skip
    if ears.strangers:
        said = ", ".join(f"0x{can_id:X} ({count})" for can_id, count in ears.strangers.most_common(4))
        return Check("ids", Mark.WARNED, f"ids that the DBC does not have: {said}", "the bench takes no notice of them")
    return Check("ids", Mark.PASSED, "CTRL's and no others")


def _alone(ears: Ears) -> Check:
    if ears.answers:
        return Check(
            "alone", Mark.FAILED, f"{ears.answers} times a second SYNC_Done came for the same token",
            "two devices are on this bus, or the device sends SYNC_Done twice",
        )  # fmt: skip
    return Check("alone", Mark.PASSED, "one device answers")


def _form(ears: Ears) -> Check:
    return _by_message(
        "form", ears.malformed, "data frames with an 11-bit id and the length of the DBC",
        "send each message as a data frame, standard id, the length of docs/protocol.md",
    )  # fmt: skip


def _checksum(ears: Ears) -> Check:
    return _by_message(
        "CHECKSUM", ears.checksums, "right in every frame",
        "docs/protocol.md, Protection of frames, has the sum in C and a worked example",
    )  # fmt: skip


def _counter(ears: Ears) -> Check:
    return _by_message(
        "COUNTER", ears.counters, "from 0 and up by one in every message",
        "count every message for itself, from 0 after the roll call; where it does, frames are lost on their way",
    )  # fmt: skip


def _roll_call(heard: Heard) -> Check:
    ears, name = heard.ears, "roll call"
    if heard.reached > Stage.ROLL_CALL or heard.refused is not None:
        return Check(name, Mark.PASSED, "SYNC_Done to the newest call")
    if ears.wrong_calls:
        asked, told = ears.wrong_calls[-1]
        return Check(
            name, Mark.FAILED, f"call {asked} was answered with DoneStepIndex {told}",
            "repeat StepIndex of the SYNC_Step being answered",
        )  # fmt: skip
    bad = [said for said in (ears.checksums, ears.malformed) if "SYNC_Done" in said]
    advice = "its SYNC_Done cannot be read, see above" if bad else "answer SYNC_Step(Init, n) with SYNC_Done(n)"
    return Check(name, Mark.FAILED, _unanswered(heard, "SYNC_Step(Init)"), advice)


def _version(heard: Heard) -> Check:
    name, info = "version", heard.ears.values.get("CTRL_Info")
    if heard.reached == Stage.ROLL_CALL:
        return Check(name, Mark.FAILED, heard.refused or "", "docs/your-firmware.md, Versions")
    version = None if info is None else stated_version(info)
    warning = judge_version(version, Done.OK)
    if warning is not None:
        return Check(name, Mark.WARNED, warning, "docs/your-firmware.md, Versions")
    if version is None:
        return Check(name, Mark.WARNED, "the device does not say which protocol it was built for", "send CTRL_Info")
    return Check(name, Mark.PASSED, f"both sides speak protocol {version[0]}.{version[1]}")


def _dbc(ears: Ears) -> Check:
    name, said = "DBC", ears.diagnosis
    if said is None or not said.startswith(DBC_CRC_IS):
        return Check(name, Mark.SKIPPED, "the device does not say which DBC it was built with (UDS identifier 0101)")
    theirs, ours = said[len(DBC_CRC_IS) :].hex(), f"{dbc.crc32():08x}"
    if theirs != ours:
        return Check(
            name, Mark.WARNED, f"the device was built with another pumpbench.dbc: CRC-32 {theirs}, the bench's {ours}",
            "compare the files, or rebuild the firmware with this bench's",
        )  # fmt: skip
    return Check(name, Mark.PASSED, "both sides were built with the same file")


def _calibration(heard: Heard) -> Check:
    if heard.reached > Stage.CALIBRATION:
        return Check("calibration", Mark.PASSED, "every parameter came back as it was sent")
    found = heard.refused or _unanswered(heard, "SYNC_Step(Config)")
    return Check("calibration", Mark.FAILED, found, "docs/protocol.md, Calibration")


def _mode(heard: Heard) -> Check:
    if heard.refused is not None and heard.step == 0:
        return Check("mode", Mark.FAILED, heard.refused, "tell CtrlMode in CTRL_Status, ahead of SYNC_Done of step 0")
    if not heard.latencies:
        return Check("mode", Mark.SKIPPED, "no step was answered")
    return Check("mode", Mark.PASSED, f"it takes up {heard.request.strategy}")


def _steps(heard: Heard) -> Check:
    name, ears, request = "steps", heard.ears, heard.request
    done = len(heard.latencies)
    if ears.wrong_steps:
        asked, told = ears.wrong_steps[0]
        found = f"step {asked} was answered with DoneStepIndex {told}; {done} of {request.steps} were right"
        return Check(name, Mark.FAILED, found, "repeat StepIndex of the SYNC_Step being answered")
    if ears.restarts:
        found = f"HB_CTRL said BootUp {ears.restarts} times in {done} steps: the device restarts"
        advice = "its watchdog or supply? HB_CTRL says Operational in a run, BootUp only behind a start"
        return Check(name, Mark.FAILED, found, advice)
    if heard.refused is not None and heard.step == 0:
        return Check(name, Mark.SKIPPED, "the first one was refused")
    if done < request.steps:
        found = heard.refused or _unanswered(heard, f"step {heard.step}")
        return Check(name, Mark.FAILED, found, "close every turn with SYNC_Done")
    if heard.silent:
        return Check(name, Mark.FAILED, _unanswered(heard, "SYNC_Step(End)"), "answer the end of a run, too")
    for status in (Done.FAULT, Done.OVERRUN):
        if ears.statuses[status]:
            return Check(
                name, Mark.WARNED, f"DoneStatus {status.name.capitalize()} in {ears.statuses[status]} turns",
                "the device takes part, and says that something is wrong with it",
            )  # fmt: skip
    return Check(name, Mark.PASSED, f"{done} of {request.steps} answered with the right index")


def _unanswered(heard: Heard, what: str) -> str:
    gone = heard.lost is not None or heard.died is not None
    when = "any more" if gone else f"within {heard.request.timeout:g} s"
    return f"{what} was not answered with SYNC_Done {when}"


def _order(ears: Ears) -> Check:
    if ears.late:
        return Check(
            "order", Mark.FAILED, f"sent behind SYNC_Done: {_counted(ears.late)}",
            "SYNC_Done is the last frame of a turn; be silent until the next SYNC_Step",
        )  # fmt: skip
    return Check("order", Mark.PASSED, "SYNC_Done is the last frame of every turn")


def _tx_count(ears: Ears) -> Check:
    if ears.miscounts:
        told, came = ears.miscounts[0]
        found = f"wrong in {len(ears.miscounts)} of {ears.turns} turns, first: {told} for {came} frames"
        advice = "it counts the frames of a turn, SYNC_Done included; where it is right, frames are lost on their way"
        return Check("TxCount", Mark.FAILED, found, advice)
    return Check("TxCount", Mark.PASSED, f"right in {ears.turns} turns")


def _latency(heard: Heard) -> Check:
    median, worst, day = Latency.of(heard.latencies)
    figures = f"there and back {median * 1e3:.2f} ms median, {worst * 1e3:.2f} ms worst"
    return Check("latency", Mark.PASSED, f"{figures}: a patient-day would take {day:.2f} s")


def _counted(names: Counter[str]) -> str:
    return ", ".join(f"{name} ({count})" for name, count in names.most_common(4))


def _by_message(name: str, wrong: dict[str, str], right: str, advice: str) -> Check:
    if not wrong:
        return Check(name, Mark.PASSED, right)
    first = next(iter(wrong))
    others = f"; so it is with {', '.join(list(wrong)[1:])}" if len(wrong) > 1 else ""
    return Check(name, Mark.FAILED, f"{first}: {wrong[first]}{others}", advice)
