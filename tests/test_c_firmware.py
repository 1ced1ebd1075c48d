"""The firmware in C: the doses, states and alarms of the reference firmware, and no crash whatever it hears."""

import contextlib
import json
import random
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest
from bench import calibration
from conftest import ROOT, Pumpbench
from pumpbench.runfolder import RunFolder
from test_transports import announced, need_vcan, serve

from can_bus import codec, hub_wire
from can_bus.codec import Transmitter, message, protect
from can_bus.frame import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_RTR_FLAG, Frame, pack, unpack
from can_bus.lockstep import Phase
from firmware_sim.calibration import LOWEST, NEEDED, SET_CRC_INDEX, UNSET, set_crc
from firmware_sim.firmware import Firmware
from firmware_sim.ladder import State
from firmware_sim.wire import CYCLIC, own_messages, subscriptions

SOURCE = ROOT / "examples" / "c_firmware"
VECTOR = ROOT / "examples" / "golden_vectors" / "nma.log"

TOKEN, DONE, BASAL_CMD, ALARM = (
    message(name).can_id for name in ("SYNC_Step", "SYNC_Done", "PUMP_BasalCmd", "CTRL_Alarm")
)
READING, CFG_PARAM, MODE_CMD = (message(name).can_id for name in ("CGM_Reading", "CFG_Param", "MODE_Cmd"))
NOT_COMPARED = {message(name).can_id for name in ("CTRL_Diag", "CTRL_Info", "UDS_Response")}
"""Counters, version and diagnostics are every firmware's own."""

EXEC_TIME_AND_CHECKSUM = 0xFFFF << 36 | 0xFF
"""Of SYNC_Done: as a device counts it."""

INFO = message("CTRL_Info").can_id

CORE = ("controller", "calibration", "alarms", "supervisor", "protocol")

ENDED, BUS_LOST = 0, 3
"""Exit status."""

DAY = ("--patient", "adult#001", "--strategy", "nma", "--days", "1", "--seed", "1")
DROPPED = "faults:\n  - {kind: drop, message: CGM_Reading, start: '02:00', end: '03:00'}\n"


@pytest.fixture(scope="session")
def build() -> Path:
    """Where the firmware and its sanitized twin are, built as the README says.

    The place outlives the tests: in the guest with the vcan, whose processor is slow, make finds everything up to date.
    """
    if shutil.which("gcc") is None or shutil.which("make") is None:
        pytest.fail("gcc and make are needed to build examples/c_firmware")
    folder = ROOT / "build" / "c_firmware"
    folder.mkdir(parents=True, exist_ok=True)
    options = [f"BUILD={folder}", f"PYTHON={sys.executable}", "CC=gcc", "CFLAGS=-O2 -g -Wconversion"]
    done = subprocess.run(
        ["make", "all", "sanitize", *options], cwd=SOURCE, capture_output=True, text=True, timeout=240, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


def token(counter: int, phase: int, step: int, time: int = 0) -> Frame:
    word = message("SYNC_Step").pack({"SyncPhase": phase, "StepIndex": step, "SimTime": time})
    return Frame(TOKEN, protect(message("SYNC_Step"), word, counter))


def vector() -> tuple[list[Frame], list[Frame]]:
    """The day of the golden vectors: what the device hears, with a roll call before it, and what it answers."""
    heard: list[Frame] = [token(0, Phase.INIT, 1)]
    said: list[Frame] = []
    for line in VECTOR.read_text(encoding="ascii").splitlines():
        _, _, body, direction = line.split()
        can_id, _, data = body.partition("#")
        (heard if direction == "R" else said).append(Frame(int(can_id, 16), bytes.fromhex(data)))
    return heard, said


def answers(program: Path, records: bytes, *statuses: int) -> list[Frame]:
    """What the C firmware says to these records on its stdin."""
    done = subprocess.run([program, "stdio:"], input=records, capture_output=True, timeout=60, check=False)
    assert done.returncode in (statuses or (ENDED,)), (done.returncode, done.stderr.decode())
    assert b"runtime error" not in done.stderr and b"Sanitizer" not in done.stderr
    return unpack(done.stdout)


def of_reference(heard: Sequence[Frame]) -> list[Frame]:
    """What the reference firmware says to the same frames."""
    firmware = Firmware()
    said = list(firmware.start())
    for frame in heard:
        if not firmware.finished:
            said += firmware.receive(frame)
    return said


def comparable(frames: Sequence[Frame]) -> list[Frame]:
    """Everything but what is a firmware's own."""
    kept = []
    for frame in frames:
        if frame.can_id == DONE:
            word = int.from_bytes(frame.data, "little") & ~EXEC_TIME_AND_CHECKSUM
            kept.append(Frame(DONE, word.to_bytes(8, "little")))
        elif frame.can_id not in NOT_COMPARED:
            kept.append(frame)
    return kept


def select(frames: Sequence[Frame], *can_ids: int) -> list[Frame]:
    return [frame for frame in frames if frame.can_id in can_ids]


def slcan_text(frames: Sequence[Frame]) -> bytes:
    """The frames as lines of slcan."""
    lines = []
    for frame in frames:
        letter = "tTrR"[frame.is_extended + 2 * frame.is_remote]
        data = "" if frame.is_remote else frame.data.hex().upper()
        lines.append(f"{letter}{frame.identifier:0{8 if frame.is_extended else 3}X}{len(frame.data)}{data}\r")
    return "".join(lines).encode()


def slcan_frames(text: bytes) -> list[Frame]:
    """The frames in lines of slcan; CTRL sends data frames of 11 bits only."""
    lines = [line.decode() for line in text.split(b"\r") if line.startswith(b"t")]
    assert all(len(line) == 5 + 2 * int(line[4]) for line in lines)
    return [Frame(int(line[1:4], 16), bytes.fromhex(line[5:])) for line in lines]


# ---- the golden vectors


@pytest.mark.parametrize("program", ["firmware", "firmware_sanitize"])
def test_the_golden_vectors(build: Path, program: str) -> None:
    heard, said = vector()
    found = answers(build / program, pack(heard))[4:]  # HB_CTRL of the start; HB_CTRL, CTRL_Info, SYNC_Done
    assert len(select(said, BASAL_CMD)) == 288
    assert select(found, BASAL_CMD) == select(said, BASAL_CMD)
    assert comparable(found) == comparable(said)
    same = sum(one == other for one, other in zip(found, said, strict=True))
    print(f"\n{len(select(said, BASAL_CMD))} set-points; {same} of {len(said)} frames with every byte")


def test_an_unknown_version_is_told_and_a_second_roll_call_begins_anew(build: Path) -> None:
    heard, said = vector()
    info = Transmitter().frame("PLANT_Info", PlantProtocolMajor=2, PlantProtocolMinor=0, PlantDbcCrc=1)
    refused = answers(build / "firmware", pack([info, heard[0]]), BUS_LOST)[-1]
    assert message("SYNC_Done").unpack(refused.data)["DoneStatus"] == 2
    tokens = [place for place, frame in enumerate(heard) if frame.can_id == TOKEN]
    begun = heard[: tokens[100] + 1]
    again = token((begun[-1].data[1] + 1) & 15, Phase.INIT, 2)
    found = answers(build / "firmware_sanitize", pack([*begun, again, *heard[1:]]))
    assert comparable(found[-len(said) :]) == comparable(said)


# ---- whatever comes in


def disturbed(heard: Sequence[Frame], seed: int) -> list[Frame]:
    """The day with frames lost, doubled, late, damaged, forged with a good CRC, and others that do not belong there."""
    generator = random.Random(seed)
    forgeable = [name for name in subscriptions() if name not in ("SYNC_Step", "UDS_Request", "MEAL_Announce")]
    result: list[Frame] = []
    late: list[Frame] = []
    step = 0
    for place, frame in enumerate(heard):
        if place < 50:  # the calibration; a test of its own is below
            result.append(frame)
            continue
        what = generator.random()
        if what < 0.03:
            continue
        if what < 0.05:
            result += [frame, frame]
        elif what < 0.07:
            late.append(frame)
        elif what < 0.10:
            result.append(damaged(frame, generator))
        else:
            result.append(frame)
        if what > 0.93:
            result.append(forged(generator.choice(forgeable), step, generator))
        elif what > 0.91:
            result.append(Frame(message(generator.choice(own_messages())).can_id, generator.randbytes(8)))
        elif what > 0.89:
            flag = generator.choice((CAN_EFF_FLAG, CAN_RTR_FLAG, CAN_ERR_FLAG))
            result.append(Frame(frame.can_id | flag, bytes(8) if flag == CAN_RTR_FLAG else frame.data))
        elif what > 0.88:
            result.append(Frame(frame.can_id, frame.data[: generator.randrange(8)]))
        elif what > 0.875:
            time = generator.choice((step * 300, step * 300 + 3600, 268435455))
            result.append(token(generator.randrange(16), generator.choice((1, 1, 2, 3, 5, 6, 9)), step + 1, time))
        if late and generator.random() < 0.2:
            result.append(late.pop())
        if frame.can_id == TOKEN:
            step = message("SYNC_Step").unpack(frame.data)["StepIndex"]
    return result


def damaged(frame: Frame, generator: random.Random) -> Frame:
    data = bytearray(frame.data)
    for _ in range(generator.choice((1, 1, 2, 3, 20))):
        data[generator.randrange(len(data))] ^= 1 << generator.randrange(8)
    return Frame(frame.can_id, bytes(data))


def forged(name: str, step: int, generator: random.Random) -> Frame:
    """A frame that only its content tells from a true one."""
    kind = message(name)
    word = generator.getrandbits(8 * kind.length)
    if kind.data_ids is not None:
        word &= ~0xFFF
    for signal, value in {
        "CgmSampleStep": (step + 1 - generator.choice((0, 0, 0, 1, 2, 5))) % 256,
        "CgmState": generator.choice((1, 1, 1, 4, 5, 6)),
        "ModeRequest": generator.choice((0, 1, 2, 2, 2, 2, 9, 15)),  # the modes that both have, and that none has
        "ModeCmdSeq": generator.randrange(4),
        "AckId": step % 1023,
        "InsulinTotal": step * 200 + generator.randrange(1000),
        "PumpBootCount": generator.choice((0, 0, 0, 0, 1)),
        "AlarmAckInstance": generator.randrange(8),
        "AlarmAckNode": 1,
    }.items():
        if (signal in kind.fields and generator.random() < 0.9) or (signal == "ModeRequest" and name == "MODE_Cmd"):
            field = kind.fields[signal]
            word = word & ~(field.mask << field.shift) | value << field.shift
    return Frame(kind.can_id, protect(kind, word, generator.randrange(16)))


@pytest.mark.parametrize("seed", range(40))
def test_a_disturbed_day_ends_as_with_the_reference(build: Path, seed: int) -> None:
    heard = disturbed(vector()[0], seed)
    found = answers(build / "firmware_sanitize", pack(heard), ENDED, BUS_LOST)
    assert comparable(found) == comparable(of_reference(heard))


def in_bursts(heard: Sequence[Frame], seed: int) -> list[Frame]:
    """The day with bursts of damaged, lost, repeated and good frames of the messages that come in every step."""
    generator = random.Random(seed)
    ids = {message(name).can_id: heard[0] for name in (*CYCLIC, "HB_PUMP", "HB_CGM")}  # and the newest frame
    bursts = dict.fromkeys(ids, 0)
    result: list[Frame] = []
    for place, frame in enumerate(heard):
        if frame.can_id not in ids or place < 50:
            result.append(frame)
            continue
        bursts[frame.can_id] = max(bursts[frame.can_id] - 1, 0) or generator.choice((0, 0, 0, 4, 9))
        fate = generator.choice("gggcccr-") if bursts[frame.can_id] else "g"
        if fate == "r":
            result.append(ids[frame.can_id])
        elif fate == "c":
            result.append(Frame(frame.can_id, bytes([frame.data[0] ^ 1, *frame.data[1:]])))
        elif fate == "g":
            result.append(frame)
            ids[frame.can_id] = frame
    return result


@pytest.mark.parametrize("seed", range(20))
def test_bursts_of_errors_end_as_with_the_reference(build: Path, seed: int) -> None:
    heard = in_bursts(vector()[0], seed)
    found = answers(build / "firmware_sanitize", pack(heard))
    assert comparable(found) == comparable(of_reference(heard))


def test_the_disturbed_days_reach_every_state_and_alarm_but_one() -> None:
    """What the comparison above is worth: it has been everywhere but in Fault, which a test of its own reaches."""
    states, codes = set(), set()
    for seed in range(40):
        for frame in of_reference(disturbed(vector()[0], seed)):
            if frame.can_id == message("CTRL_Status").can_id:
                states.add(State(message("CTRL_Status").unpack(frame.data)["CtrlState"]))
            elif frame.can_id == ALARM:
                codes.add(message("CTRL_Alarm").unpack(frame.data)["CtrlAlarmCode"])
    assert states == set(State) - {State.FAULT}
    labels = {codec.choice("CTRL_Alarm", "CtrlAlarmCode", name): name for name in ALARMS}
    assert set(labels) - codes == set(), {labels[code] for code in set(labels) - codes}


ALARMS = (
    "CgmLost", "CgmImplausible", "PumpLost", "DeliveryUncertain", "DoseLimited", "DoseRejected", "E2EFault",
    "UrgentLow", "ClockJump", "StateChange",
)  # fmt: skip


def flashed(heard: Sequence[Frame], values: dict[int, int]) -> list[Frame]:
    """The same day with another calibration."""
    kind = message("CFG_Param")
    frames = [
        Frame(CFG_PARAM, protect(kind, kind.pack({"CfgIndex": index, kind.pages[index][0].name: raw}), place % 16))
        for place, (index, raw) in enumerate(values.items())
    ]
    first = next(place for place, frame in enumerate(heard) if frame.can_id == CFG_PARAM)
    rest = [frame for frame in heard[first:] if frame.can_id != CFG_PARAM]
    return [*heard[:first], *frames, *rest]


def any_calibration(generator: random.Random) -> dict[int, int]:
    """Each parameter as it was or near it; in half of the cases anywhere in its range, at its end, or not flashed."""
    values = {}
    wild = generator.random() < 0.5
    for index, raw in calibration().items():
        field = message("CFG_Param").pages[index][0]
        low = max(field.low, LOWEST.get(field.name, field.low))
        kind = generator.random()
        if index == SET_CRC_INDEX or (wild and kind < 0.1 and field.name in UNSET and index not in NEEDED):
            continue
        if not wild:
            near = round(raw * generator.uniform(0.8, 1.2)) if kind < 0.5 else raw
            values[index] = min(max(near, low), field.high)
        elif kind < 0.4:
            values[index] = raw
        elif kind < 0.8:
            values[index] = generator.randint(low, field.high)
        else:
            values[index] = generator.choice((low, field.high, max(raw // 2, low), min(raw * 2, field.high)))
    values[SET_CRC_INDEX] = set_crc(values)
    return values


@pytest.mark.parametrize("seed", range(40))
def test_any_calibration_gives_the_echoes_and_the_doses_of_the_reference(build: Path, seed: int) -> None:
    """Products of 2^31 and coefficients at their limits: saturation and rounding agree, and nothing overflows."""
    heard = flashed(vector()[0], any_calibration(random.Random(seed)))
    found = answers(build / "firmware_sanitize", pack(heard))
    assert select(found, BASAL_CMD)
    assert comparable(found) == comparable(of_reference(heard))
    ours, theirs = (
        [message("CTRL_Diag").unpack(frame.data) for frame in select(frames, message("CTRL_Diag").can_id)][-1]
        for frames in (found, of_reference(heard))
    )
    assert ours["SaturationCount"] == theirs["SaturationCount"]


def test_implausible_parameters_are_refused_and_an_incomplete_set_is_not_active(build: Path) -> None:
    for change in ({0: 0}, {2: 599}, {10: 9999}, {1: 99}, {1: 20001}, {4: None}, {9: None}, {11: None}, {16: None}):
        values = calibration()
        for index, raw in change.items():
            values.pop(index) if raw is None else values.update({index: raw})
        del values[SET_CRC_INDEX]
        values[SET_CRC_INDEX] = set_crc({index: raw for index, raw in values.items() if change.get(index) is None})
        kind = message("CFG_Param")
        heard = vector()[0]
        frames = []
        for place, (index, raw) in enumerate(values.items()):
            field = kind.pages[index][0]
            word = index << kind.fields["CfgIndex"].shift | (raw & field.mask) << field.shift
            frames.append(Frame(CFG_PARAM, protect(kind, word, place % 16)))
        first = next(place for place, frame in enumerate(heard) if frame.can_id == CFG_PARAM)
        heard = [*heard[:first], *frames, *(frame for frame in heard[first:] if frame.can_id != CFG_PARAM)]
        found = answers(build / "firmware_sanitize", pack(heard))
        assert not select(found, BASAL_CMD), change
        assert comparable(found) == comparable(of_reference(heard)), change


def test_a_flood_is_an_overrun_and_three_in_a_row_are_a_fault(build: Path) -> None:
    heard, _ = vector()
    tokens = [place for place, frame in enumerate(heard) if frame.can_id == TOKEN]
    flood = [Frame(message("HB_PUMP").can_id, bytes(2))] * 600
    for floods in (1, 2, 4):
        day = list(heard)
        for place in reversed(tokens[20 : 20 + floods]):
            day[place:place] = flood
        found = answers(build / "firmware_sanitize", pack(day))
        assert comparable(found) == comparable(of_reference(day))
        assert len(select(found, BASAL_CMD)) == (288 if floods < 4 else 21)


@pytest.mark.parametrize("seed", range(10))
def test_frames_that_pass_no_check_cause_no_dose(build: Path, seed: int) -> None:
    heard, said = vector()
    generator = random.Random(seed)
    ids = [message(name).can_id for name in (*subscriptions(), *own_messages())]
    day: list[Frame] = []
    for frame in heard:
        for _ in range(generator.choice((0, 0, 1, 5))):
            name = generator.choice(ids) if generator.random() < 0.7 else generator.getrandbits(32)
            noise = Frame(name, generator.randbytes(generator.randint(0, 8)))
            kind = codec.messages_by_id().get(name)
            if kind is None or len(noise.data) != kind.length or not passes(noise):
                day.append(noise)
        day.append(frame)
    found = answers(build / "firmware_sanitize", pack(day))
    assert len(day) > len(heard) + 1000
    assert select(found, BASAL_CMD) == select(said, BASAL_CMD)


def passes(frame: Frame) -> bool:
    kind = codec.messages_by_id()[frame.can_id]
    return (
        kind.data_ids is None
        or protect(kind, int.from_bytes(frame.data, "little") & ~0xFFF, frame.data[1] & 15)[0] == frame.data[0]
    )


@pytest.mark.parametrize("seed", range(10))
def test_any_bytes_end_the_run_without_a_dose_and_without_a_crash(build: Path, seed: int) -> None:
    noise = random.Random(seed).randbytes(100_000)
    assert not select(answers(build / "firmware_sanitize", noise, BUS_LOST), BASAL_CMD)
    records = b"".join(
        noise[i : i + 4] + bytes([noise[i + 4] % 9]) + noise[i + 5 : i + 16] for i in range(0, 99_984, 16)
    )
    assert not select(answers(build / "firmware_sanitize", records, BUS_LOST), BASAL_CMD)


def slcan_answers(program: Path, text: bytes, *statuses: int) -> bytes:
    """What the C firmware says to this text on its stdin, taken for the serial line of a USB-CAN adapter."""
    done = subprocess.run([program, "slcan:"], input=text, capture_output=True, timeout=60, check=False)
    assert done.returncode in statuses, (done.returncode, done.stderr.decode())
    assert done.stderr == b""
    return done.stdout


def test_slcan_gives_the_same_answers(build: Path) -> None:
    heard, said = vector()
    found = slcan_answers(build / "firmware_sanitize", b"C\rS6\r\rO\r" + slcan_text(heard), ENDED)
    assert found.startswith(b"\r\r\r\rt701")
    assert slcan_frames(found)[4:] == said


def test_slcan_has_the_frames_that_the_hub_has_but_error_frames(build: Path) -> None:
    heard = [frame for frame in disturbed(vector()[0], 3) if not frame.is_error]
    assert {frame.is_extended for frame in heard} == {frame.is_remote for frame in heard} == {True, False}
    found = slcan_answers(build / "firmware_sanitize", b"O\r" + slcan_text(heard), ENDED, BUS_LOST)
    assert slcan_frames(found) == answers(build / "firmware_sanitize", pack(heard), ENDED, BUS_LOST)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (b"t1230\r", b"\a"),  # the channel is closed
        (b"V\rS6\rs031C\r\rC\r", b"V0101\r\r\r\r\r"),
        (b"X\rL\r" + b"O" * 300 + b"\r", b"\a\a\a"),
        (b"O\rC\r", b"\rt70120000\r\r"),
        (b"O\rO\rV\r", b"\rt70120000\r\rV0101\r"),  # python-can opens twice
        (b"O\rt1230\rO\rV\r", b"\rt70120000\r\r"),  # another bench: a process does one run, and its bus is lost
        *[
            (b"O\r" + line + b"\r", b"\rt70120000\r\a")
            for line in (
                b"t", b"t12", b"t123", b"t1239", b"t12310", b"t1231000", b"t123100 ", b"t1231G0", b"t8000",
                b"t12390011223344556677",
                b"T1234567", b"T200000000", b"r123100", b"R1FFFFFFF9", b"T0000012380011223344556677889",
            )
        ],
    ],
)  # fmt: skip
def test_lines_of_slcan(build: Path, text: bytes, said: bytes) -> None:
    assert slcan_answers(build / "firmware_sanitize", text, BUS_LOST) == said


@pytest.mark.parametrize("seed", range(10))
def test_any_text_ends_the_run_without_a_dose_and_without_a_crash(build: Path, seed: int) -> None:
    generator = random.Random(seed)
    alphabet = b"\r\r\rtTrRCOSV0123456789ABCDEFabcdef\a\0\xff" if seed % 2 else bytes(range(256))
    noise = bytes(generator.choices(alphabet, k=100_000))
    found = slcan_answers(build / "firmware_sanitize", b"O\r" + noise, BUS_LOST)
    assert not select(slcan_frames(found), BASAL_CMD)


def test_what_came_before_a_goodbye_is_heard_once(build: Path) -> None:
    heard = vector()[0]
    for cut in (60, 64, 65, 500):
        goodbye = hub_wire.goodbye(hub_wire.Reason.CLOSED)
        found = answers(build / "firmware_sanitize", pack(heard[:cut]) + goodbye + pack(heard[cut:]), BUS_LOST)
        assert found == [frame if frame.can_id != INFO else found[2] for frame in of_reference(heard[:cut])]


# ---- what a microcontroller can take


def test_the_core_calls_no_operating_system(build: Path) -> None:
    objects = [build / "plain" / f"{name}.o" for name in (*CORE, "pumpbench")]
    command = ["nm", "--format=posix", *map(str, objects)]
    lines = subprocess.run(command, check=True, capture_output=True, text=True, timeout=20).stdout.splitlines()
    symbols = [line.split() for line in lines if len(line.split()) > 1]
    known = {name for name, kind, *_ in symbols if kind != "U"}
    wanted = {name for name, kind, *_ in symbols if kind == "U"}
    assert wanted - known <= {"memcpy", "memset", "memcmp", "memmove", "_GLOBAL_OFFSET_TABLE_", "__stack_chk_fail"}


def test_the_core_is_integers_without_a_heap() -> None:
    for name in CORE:
        for path in (SOURCE / f"{name}.c", SOURCE / f"{name}.h"):
            words = set(re.findall(r"\w+", re.sub(r"/\*.*?\*/", "", path.read_text(), flags=re.S)))
            assert not words & {"float", "double", "malloc", "calloc", "realloc", "alloca", "free"}, path


# ---- on a bus


def run(pumpbench: Pumpbench, *arguments: str | Path, out: Path, program: Path | None = None) -> RunFolder:
    firmware = () if program is None else ("--firmware", f"{program} {{bus}}")
    done = pumpbench("run", *DAY, *arguments, *firmware, "--out", out, timeout=240.0)
    assert done.returncode == 0, done.stderr + done.stdout
    return RunFolder.load(out)


def assert_same(found: RunFolder, reference: RunFolder) -> None:
    """Doses bit by bit, states and alarms; no hazard, and every stroke accounted for."""
    ours, theirs = found.frames.frames(), reference.frames.frames()
    assert len(select(ours, BASAL_CMD)) == 288
    assert comparable(ours) == comparable(theirs)
    assert list(found.trace.get("CtrlState")[:288]) == list(reference.trace.get("CtrlState")[:288])
    safety = found.metrics["safety"]
    assert set(safety["hazards"].values()) == {0}
    assert all(drug["closes"] for drug in safety["ledger"].values())
    same = sum(one == other for one, other in zip(ours, theirs, strict=True))
    print(f"\n{len(select(ours, BASAL_CMD))} set-points; {same} of {len(theirs)} frames of the bus with every byte")


@pytest.fixture(scope="module")
def reference_day(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    out = tmp_path_factory.mktemp("reference") / "run"
    command = [sys.executable, "-m", "pumpbench", "run", *DAY, "--bus", "inproc", "--out", str(out)]
    subprocess.run(command, check=True, capture_output=True, timeout=240)
    return RunFolder.load(out)


def test_a_day_on_the_hub(build: Path, pumpbench: Pumpbench, runs: Path, reference_day: RunFolder) -> None:
    found = run(pumpbench, "--bus", "hub", out=runs / "c", program=build / "firmware_sanitize")
    assert_same(found, reference_day)


def test_an_hour_without_samples(build: Path, pumpbench: Pumpbench, runs: Path) -> None:
    (runs / "drop.yaml").write_text(DROPPED)
    faults = ("--faults", runs / "drop.yaml")
    found = run(pumpbench, *faults, "--bus", "hub", out=runs / "c", program=build / "firmware_sanitize")
    assert_same(found, run(pumpbench, *faults, "--bus", "inproc", out=runs / "reference"))
    assert {State.AUTO, State.DEGRADED, State.SAFE_BASAL} <= {State(int(x)) for x in found.trace.get("CtrlState")[:288]}


def test_a_hub_on_tcp(build: Path, pumpbench: Pumpbench, runs: Path, reference_day: RunFolder) -> None:
    with contextlib.ExitStack() as stack:
        (url,) = announced(serve(stack, "tcp:127.0.0.1:0"))
        found = run(pumpbench, "--bus", url, out=runs / "c", program=build / "firmware")
    assert_same(found, reference_day)


@pytest.mark.vcan
def test_a_day_on_vcan(build: Path, pumpbench: Pumpbench, runs: Path, reference_day: RunFolder) -> None:
    need_vcan()
    found = run(pumpbench, "--bus", "socketcan:vcan0", out=runs / "c", program=build / "firmware")
    assert_same(found, reference_day)


# ---- conformance


def conformance(pumpbench: Pumpbench, program: Path, bus: str, *options: str) -> dict[str, str]:
    """The verdicts that are neither "passed" nor about what this firmware does not offer."""
    command = f"{program} {{bus}}"
    done = pumpbench("conformance", "--bus", bus, "--firmware", command, "--json", "-", *options, timeout=400.0)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told["offers"] == ["nma", "restart"]
    verdicts = {each["id"]: each["verdict"] for each in told["requirements"]}
    assert sum(verdict == "passed" for verdict in verdicts.values()) >= len(verdicts) * 2 // 3
    return {name: verdict for name, verdict in verdicts.items() if verdict not in ("passed", "not applicable")}


def test_it_conforms(build: Path, pumpbench: Pumpbench) -> None:
    """Under sanitizers, which end it at the first mistake."""
    left = conformance(pumpbench, build / "firmware_sanitize", "hub")
    assert set(left.values()) <= {"tested elsewhere", "not checked"}


@pytest.mark.vcan
def test_it_conforms_on_vcan(build: Path, pumpbench: Pumpbench) -> None:
    need_vcan()
    left = conformance(pumpbench, build / "firmware", "socketcan:vcan0")
    assert set(left.values()) <= {"tested elsewhere", "not checked"}


@pytest.mark.parametrize(
    ("arguments", "status", "text"),
    [
        ([], 2, "usage"),
        (["a", "b"], 2, "usage"),
        (["serial:/dev/ttyS0"], 2, "expected unix:/path"),
        (["unix:/nonexistent/hub"], 3, "unix:/nonexistent/hub: No such file"),
        (["unix:" + "x" * 200], 3, "at most 107 bytes"),
        (["tcp:192.0.2.1:80"], 3, "expected tcp:127.0.0.1:port"),
        (["tcp:127.0.0.1:http"], 3, "expected tcp:127.0.0.1:port"),
        (["socketcan:nosuchcan0"], 3, "no such CAN interface"),
    ],
)
def test_a_bus_that_cannot_be_joined(build: Path, arguments: list[str], status: int, text: str) -> None:
    done = subprocess.run(
        [build / "firmware_sanitize", *arguments], env={}, capture_output=True, text=True, timeout=20, check=False
    )
    assert done.returncode == status
    assert text in done.stderr and done.stderr.count("\n") == 1


def test_the_variable_names_the_bus(build: Path) -> None:
    environment = {"PUMPBENCH_BUS": "unix:/nonexistent/hub"}
    done = subprocess.run(
        [build / "firmware_sanitize"], env=environment, capture_output=True, text=True, timeout=20, check=False
    )
    assert done.returncode == BUS_LOST
    assert "unix:/nonexistent/hub: No such file" in done.stderr


def test_its_record_is_answered_alike_by_both_firmwares(build: Path, runs: Path, pumpbench: Pumpbench) -> None:
    firmware = f"{build / 'firmware'} {{bus}}"
    done = pumpbench("run", *DAY, "--firmware", firmware, "--out", "recorded")
    assert done.returncode == 0, done.stderr
    for options in (("--firmware", firmware), ("--ignore", "own")):
        done = pumpbench("replay", "recorded", *options)
        assert done.returncode == 0, done.stdout + done.stderr
