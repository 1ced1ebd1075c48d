"""The conventions of pumpbench.dbc, its agreement with the code, and what other people's tools make of it."""

import importlib.util
import itertools
import os
import random
import re
import shutil
import subprocess
import sys
from collections.abc import Iterable
from enum import IntEnum
from pathlib import Path
from types import ModuleType
from typing import Any, get_args

import cantools
import pytest
from cantools.database.can.c_source import camel_to_snake_case
from pumpbench.calibration import MODES

import dbc
import firmware_sim.alarms
import firmware_sim.calibration
import firmware_sim.cgm
import firmware_sim.ladder
import firmware_sim.pump
import plant_server.bolus
import plant_server.pump
import plant_server.sensor
import plant_server.set_point
from can_bus import codec, faults, lockstep
from firmware_sim import caution, firmware, user
from firmware_sim.control import core, layout

MESSAGES = sorted(dbc.load().messages, key=lambda message: message.frame_id)
SIGNALS = [(message, signal) for message in MESSAGES for signal in message.signals]
HEARTBEATS = [message for message in MESSAGES if 0x700 <= message.frame_id < 0x780]
DIAGNOSTICS = [message for message in MESSAGES if message.frame_id >= 0x7E0]
PROTECTED = [message for message in MESSAGES if codec.message(message.name).data_ids]
RESERVED = ("SNA", "Error")
NEUTRAL = ("None", "No", "NoRequest")

each_message = pytest.mark.parametrize("message", MESSAGES, ids=lambda message: message.name)
each_signal = pytest.mark.parametrize(
    ("message", "signal"), SIGNALS, ids=[f"{message.name}.{signal.name}" for message, signal in SIGNALS]
)


def attribute(thing: Any, name: str) -> Any:
    """An attribute as the file states it, None if it leaves it to the default."""
    found = thing.dbc.attributes.get(name)
    return None if found is None else found.value


def codes(signal: Any) -> dict[int, str]:
    return {int(code): str(text) for code, text in (signal.choices or {}).items()}


def is_enumeration(signal: Any) -> bool:
    """Whether its raw values are codes and not numbers."""
    return any(text not in RESERVED for text in codes(signal).values())


def raw_limits(signal: Any) -> tuple[int, int]:
    """What its bits can hold."""
    return (
        (-(1 << signal.length - 1), (1 << signal.length - 1) - 1) if signal.is_signed else (0, (1 << signal.length) - 1)
    )


def raw_range(signal: Any) -> tuple[float, float]:
    return (signal.minimum - signal.offset) / signal.scale, (signal.maximum - signal.offset) / signal.scale


def named(prefix: str) -> list[Any]:
    return [message for message in MESSAGES if message.name.startswith(prefix)]


# ---- the file


def test_loads_strictly_and_survives_a_round_trip_through_cantools() -> None:
    database = dbc.load()
    again = cantools.database.load_string(database.as_dbc_string(), "dbc", strict=True)
    assert [node.name for node in again.nodes] == [node.name for node in database.nodes]
    assert {message.frame_id for message in again.messages} == {message.frame_id for message in MESSAGES}
    for message in MESSAGES:
        other = again.get_message_by_frame_id(message.frame_id)
        assert (other.name, other.length, other.senders, other.receivers, other.comment) == (
            message.name,
            message.length,
            message.senders,
            message.receivers,
            message.comment,
        )
        for signal in message.signals:
            twin = other.get_signal_by_name(signal.name)
            for what in ("start", "length", "is_signed", "scale", "offset", "minimum", "maximum", "unit", "comment"):
                assert getattr(twin, what) == getattr(signal, what), (signal.name, what)
            assert codes(twin) == codes(signal)
            assert twin.multiplexer_ids == signal.multiplexer_ids
            assert {name: found.value for name, found in twin.dbc.attributes.items()} == {
                name: found.value for name, found in signal.dbc.attributes.items()
            }


def test_sections_stand_in_the_order_of_the_grammar() -> None:
    order = ["VERSION", "NS_", "BS_", "BU_", "BO_", "CM_", "BA_DEF_", "BA_DEF_DEF_", "BA_", "VAL_", "SG_MUL_VAL_"]
    found = [
        keyword
        for keyword, _ in itertools.groupby(
            match[1] for match in re.finditer(r"^([A-Z][A-Z_]*)\b", dbc.DBC_PATH.read_text(encoding="ascii"), re.M)
        )
    ]
    assert found == order


def test_version_of_the_file_and_of_the_protocol_agree() -> None:
    assert dbc.load().version.split(".")[:2] == [str(part) for part in dbc.protocol_version()]


def test_both_notations_of_a_page_agree() -> None:
    text = dbc.DBC_PATH.read_text(encoding="ascii")
    extended = {
        (int(message), name): int(low)
        for message, name, low, high in re.findall(r"^SG_MUL_VAL_ (\d+) (\w+) \w+ (\d+)-(\d+);$", text, re.M)
        if low == high
    }
    simple = {}
    for block in re.split(r"^BO_ ", text, flags=re.M)[1:]:
        for name, page in re.findall(r"^ SG_ (\w+) m(\d+) :", block, re.M):
            simple[int(block.split()[0]), name] = int(page)
    assert extended == simple


def test_names_and_ids_are_unique() -> None:
    names = [signal.name for _, signal in SIGNALS if signal.name not in ("CHECKSUM", "COUNTER")]
    assert len(names) == len(set(names))
    assert len({message.frame_id for message in MESSAGES}) == len(MESSAGES)
    assert len({message.name for message in MESSAGES}) == len(MESSAGES)


@each_message
def test_every_message_is_classic_has_one_sender_receivers_and_a_comment(message: Any) -> None:
    assert not message.is_extended_frame
    assert not message.is_fd
    assert message.length <= 8
    assert len(message.senders) == 1
    assert message.receivers
    assert message.senders[0] not in message.receivers
    assert message.comment
    assert len({tuple(signal.receivers) for signal in message.signals}) == 1


def test_every_node_has_a_comment_and_takes_part() -> None:
    for node in dbc.load().nodes:
        assert node.comment, node.name
        assert any(node.name in (message.senders[0], *message.receivers) for message in MESSAGES), node.name
    assert [node.name for node in dbc.load().nodes if attribute(node, "LockstepMember") in (1, "Yes")] == ["CTRL"]


# ---- identifiers by priority


@pytest.mark.parametrize(
    ("names", "ids"),
    [
        (("SYNC_Step", "SYNC_Done", "PLANT_Info"), range(0x010, 0x020)),
        (("CTRL_Alarm", "PUMP_Alarm"), range(0x080, 0x090)),
        (("CGM_Reading", "CGM_Status", "MEAL_Announce", "UI_AlarmAck"), range(0x100, 0x200)),
        (
            ("PUMP_BasalCmd", "PUMP_BolusCmd", "PUMP_Ack", "PUMP_Status", "PUMP_Delivered", "PUMP_BolusState"),
            range(0x200, 0x300),
        ),
        (
            ("CTRL_Status", "CTRL_Diag", "CTRL_Info", "MODE_Cmd", "CFG_Param", "CFG_ParamEcho"),
            range(0x300, 0x400),
        ),
        (("PLANT_Truth",), range(0x600, 0x601)),
        (("FAULT_Inject",), range(0x6F0, 0x6F1)),
        (("HB_CTRL", "HB_PUMP", "HB_CGM"), range(0x701, 0x780)),
        (("UDS_Request", "UDS_Response"), range(0x7E0, 0x7F0)),
    ],
    ids=lambda value: f"{value.start:03X}" if isinstance(value, range) else None,
)
def test_identifiers_lie_in_the_range_of_their_priority(names: tuple[str, ...], ids: range) -> None:
    assert {message.name for message in MESSAGES if message.frame_id in ids} == set(names)


def test_heartbeats_have_the_id_of_their_node() -> None:
    for message in named("HB_"):
        sender = next(node for node in dbc.load().nodes if node.name == message.senders[0])
        assert message.frame_id == 0x700 + attribute(sender, "NodeId")
        assert message.name == f"HB_{sender.name}"
    assert named("HB_") == HEARTBEATS


# ---- protection


def test_what_dosing_nodes_say_and_hear_is_protected() -> None:
    dosing = {"CTRL", "PUMP", "CGM"}
    needs = {message.name for message in MESSAGES if dosing & {message.senders[0], *message.receivers}}
    assert {message.name for message in PROTECTED} == needs - {message.name for message in HEARTBEATS + DIAGNOSTICS}


@each_message
def test_protected_messages_begin_with_checksum_and_counter(message: Any) -> None:
    names = {signal.name: (signal.start, signal.length, signal.is_signed) for signal in message.signals}
    ids = attribute(message, "E2EDataIdList")
    if attribute(message, "E2EProfile") is None:
        assert ids is None
        assert not {"CHECKSUM", "COUNTER"} & set(names)
        return
    assert attribute(message, "E2EProfile") in (1, "P02")
    assert dbc.load().dbc.attribute_definitions["E2EProfile"].choices[1] == "P02"
    assert names["CHECKSUM"] == (0, 8, False)
    assert names["COUNTER"] == (8, 4, False)
    assert message.length == 8
    assert re.fullmatch("[0-9a-f]{32}", ids)


def test_data_ids_tell_messages_apart_at_every_counter() -> None:
    lists = [codec.message(message.name).data_ids for message in PROTECTED]
    assert len(lists) == 21
    for ids in lists:
        assert len(set(ids)) == 16
    for column in zip(*lists, strict=True):
        assert len(set(column)) == len(lists)


DOSING = {"CGM_Reading", "PUMP_BasalCmd", "PUMP_BolusCmd"}


def test_dosing_messages_are_numbered_and_tell_their_step() -> None:
    """What CTRL tells the pump, and the cyclic samples that CTRL doses on."""
    to_pump = {m.name for m in MESSAGES if m.senders == ["CTRL"] and "PUMP" in m.receivers}
    samples = {m.name for m in named("CGM_") if attribute(m, "MsgTimeoutTime") is not None}
    assert to_pump | samples - {"HB_CGM"} == DOSING | {"HB_CTRL"}
    for name in DOSING:
        fields = codec.message(name).fields
        number = [field for field in fields if re.search(r"(Seq|Id)$", field)]
        step = [field for field in fields if re.search(r"(UntilStep|SampleStep)$", field)]
        assert len(number) == len(step) == 1, name
        assert "StepIndex modulo" in dbc.load().get_message_by_name(name).get_signal_by_name(step[0]).comment
        assert fields[step[0]].high == fields[step[0]].mask  # every code is a step


def test_requests_of_the_user_and_answers_of_the_pump_are_numbered() -> None:
    for message in MESSAGES:
        if message.senders == ["UI"] or message.name in ("PUMP_Ack", "PUMP_Status", "PUMP_BolusState"):
            assert any(re.search(r"(Seq|Id|Instance)$", s.name) for s in message.signals), message.name


# ---- signals


@each_signal
def test_every_signal_says_what_it_is(message: Any, signal: Any) -> None:
    assert signal.comment
    assert signal.unit
    assert signal.unit == signal.unit.strip()
    assert signal.byte_order == "little_endian"
    assert not signal.is_float
    assert signal.offset == 0
    assert signal.scale > 0


@each_signal
def test_every_range_fits_the_bits_the_scale_and_the_codes(message: Any, signal: Any) -> None:
    low, high = raw_range(signal)
    assert low < high
    assert low == pytest.approx(round(low), abs=0.01), "the least value is no multiple of the scale"
    assert high == pytest.approx(round(high), abs=0.01), "the largest value is no multiple of the scale"
    least, most = raw_limits(signal)
    assert least <= round(low) <= round(high) <= most
    for code, text in codes(signal).items():
        assert least <= code <= most, text
        if is_enumeration(signal):
            assert round(low) <= code <= round(high), text
        else:
            assert not round(low) <= code <= round(high), text
    if is_enumeration(signal):
        assert (round(low), round(high)) == (least, most)
        assert signal.unit == "-"
        assert signal.scale == 1
    assert len(set(codes(signal).values())) == len(codes(signal)), "two codes of the same name"


@each_signal
def test_every_signal_states_its_invalid_code(message: Any, signal: Any) -> None:
    invalid = attribute(signal, "SigInvalidRaw")
    assert invalid is not None
    not_available = [code for code, text in codes(signal).items() if text == "SNA"]
    assert invalid == (not_available[0] if not_available else -1)
    if invalid != -1:
        least, most = raw_limits(signal)
        assert least <= invalid <= most


@each_signal
def test_what_a_sender_leaves_out_says_nothing(message: Any, signal: Any) -> None:
    stated = attribute(signal, "GenSigStartValue")
    start = 0 if stated is None else stated
    known = codes(signal)
    if "SNA" not in known.values():
        assert start == 0
    elif known.get(start) != "SNA":
        assert is_enumeration(signal)
        assert known.get(start) in NEUTRAL


# ---- timing


def test_cyclic_messages_state_their_cycle() -> None:
    choices = dbc.load().dbc.attribute_definitions["GenMsgSendType"].choices
    for message in MESSAGES:
        kind = attribute(message, "GenMsgSendType")
        cycle = attribute(message, "GenMsgCycleTime")
        assert kind is not None, message.name
        if choices[int(kind)].startswith("Cyclic"):
            assert cycle is not None, message.name
            assert cycle % (lockstep.STEP_SECONDS * 1000) == 0, message.name
        else:
            assert cycle is None, message.name


def test_what_ctrl_monitors_has_a_timeout() -> None:
    """Cyclic messages CTRL hears once per step, but not the token: it is the clock the others are measured with."""
    step = lockstep.STEP_SECONDS * 1000
    monitored = {
        message.name
        for message in MESSAGES
        if "CTRL" in message.receivers and attribute(message, "GenMsgCycleTime") == step and message.name != "SYNC_Step"
    }
    assert monitored == {"CGM_Reading", "PUMP_Status", "PUMP_Delivered", "PUMP_BolusState", "HB_PUMP", "HB_CGM"}
    timeouts = {message.name: attribute(message, "MsgTimeoutTime") for message in MESSAGES}
    assert all(timeouts[name] is not None for name in monitored)
    for name, timeout in timeouts.items():
        if timeout is not None:  # one frame may be lost, the second one not
            cycle = attribute(dbc.load().get_message_by_name(name), "GenMsgCycleTime")
            assert 2 * cycle < timeout < 3 * cycle, name


# ---- agreement with the code


def labels(message: str, signal: str) -> dict[int, str]:
    return codes(dbc.load().get_message_by_name(message).get_signal_by_name(signal))


def plain(name: str) -> str:
    return name.replace("_", "").lower()


def assert_same_codes(members: Iterable[IntEnum], message: str, signal: str, *, all_of_them: bool) -> None:
    ours = {int(member): plain(member.name) for member in members}
    theirs = {code: plain(text) for code, text in labels(message, signal).items() if text not in RESERVED}
    assert ours.items() <= theirs.items(), (ours, theirs)
    if all_of_them:
        assert ours == theirs


@pytest.mark.parametrize(
    ("members", "message", "signal", "all_of_them"),
    [
        (lockstep.Phase, "SYNC_Step", "SyncPhase", True),
        (lockstep.Done, "SYNC_Done", "DoneStatus", True),
        (firmware_sim.alarms.Code, "CTRL_Alarm", "CtrlAlarmCode", False),
        (firmware_sim.alarms.Code, "PUMP_Alarm", "PumpAlarmCode", False),
        (firmware_sim.alarms.State, "CTRL_Alarm", "CtrlAlarmState", True),
        (firmware_sim.alarms.State, "PUMP_Alarm", "PumpAlarmState", True),
        (firmware_sim.alarms.Priority, "CTRL_Alarm", "CtrlAlarmPriority", True),
        (firmware_sim.alarms.Priority, "PUMP_Alarm", "PumpAlarmPriority", True),
        (firmware_sim.ladder.State, "CTRL_Status", "CtrlState", True),
        (firmware_sim.pump.Op, "PUMP_BasalCmd", "BasalOp", False),
        (plant_server.set_point.Op, "PUMP_BasalCmd", "BasalOp", False),
        (plant_server.pump.AckFor, "PUMP_Ack", "AckFor", False),
        (plant_server.bolus.AckResult, "PUMP_Ack", "AckResult", False),
        (plant_server.pump.PumpState, "PUMP_Status", "PumpState", False),
    ],
)
def test_enums_repeat_the_codes_of_the_dbc(
    members: type[IntEnum], message: str, signal: str, all_of_them: bool
) -> None:
    assert_same_codes(members, message, signal, all_of_them=all_of_them)


def test_modes() -> None:
    modes = labels("CTRL_Status", "CtrlMode")
    assert labels("MODE_Cmd", "ModeRequest") == modes
    for name, code in vars(core).items():
        if name.startswith("MODE_"):
            short = plain(name.removeprefix("MODE_"))
            assert plain(modes[code]) == short or plain(modes[code]).startswith((f"insulin{short}", f"pram{short}"))
    for name, code in MODES.items():
        assert getattr(core, f"MODE_{name.upper()}") == code
    assert set(user.SUPPORTED_MODES) <= set(modes)


def test_limiter_bits() -> None:
    comment = dbc.load().get_message_by_name("CTRL_Status").get_signal_by_name("LimiterBits").comment
    bits = {text: int(bit) for bit, text in re.findall(r"(\d) ([^,\d][^,]*)", comment.replace("bit0", "0"))}
    assert sorted(bits.values()) == list(range(8))
    expected = {
        "MAX_IOB": "max IOB",
        "LOW_GLUCOSE": "low-glucose suspend",
        "STALE_CGM": "stale CGM",
        "LOCKOUT": "lockout time",
        "DAY": "max per 24 h",
        "RISE": "rate of change",
    }
    limiters = {
        name.removeprefix("LIMITER_"): value for name, value in vars(layout).items() if name.startswith("LIMITER_")
    }
    for name, value in limiters.items():
        words = expected.get(name, name.lower().replace("_", " "))
        assert value == 1 << bits[words], name
    assert set(expected) <= set(limiters)


def test_faults() -> None:
    kinds = {plain(text): code for code, text in labels("FAULT_Inject", "FaultKind").items()}
    for fault in get_args(faults.WireFaults):
        assert fault.CODE in kinds.values(), fault
    targets = labels("FAULT_Inject", "FaultTarget")
    assert set(faults.TARGETS) == {node.name for node in dbc.load().nodes}
    for node, target in faults.TARGETS.items():
        assert targets[target] == (node if node in targets.values() else "Bus")


def high(message: str, signal: str) -> int:
    return codec.message(message).fields[signal].high


@pytest.mark.parametrize(
    ("ours", "of_the_dbc"),
    [
        (core.RATE_MAX, high("PUMP_BasalCmd", "InsulinRate")),
        (core.RATE_MAX, high("PUMP_BasalCmd", "PramlintideRate")),
        (plant_server.set_point.RATE_RESERVED, high("PUMP_BasalCmd", "InsulinRate")),
        (core.IOB_MAX, high("CTRL_Status", "InsulinOnBoard")),
        (firmware_sim.pump.SEQUENCES, high("PUMP_BasalCmd", "BasalCmdSeq") + 1),
        (plant_server.set_point.SEQUENCES, high("PUMP_BasalCmd", "BasalCmdSeq") + 1),
        (firmware_sim.pump.TOTAL_MODULUS, codec.choice("PUMP_Delivered", "InsulinTotal", "Error")),
        (firmware_sim.alarms.INSTANCES, high("CTRL_Alarm", "CtrlAlarmInstance") + 1),
        (firmware_sim.cgm.SEQUENCE_MODULUS, high("CGM_Reading", "CgmSampleSeq") + 1),
        (firmware_sim.cgm.GLUCOSE_HIGH, high("CGM_Reading", "GlucoseConc")),
        (firmware_sim.cgm.STATE_OK, codec.choice("CGM_Reading", "CgmState", "Ok")),
        (firmware_sim.cgm.STATE_BELOW_RANGE, codec.choice("CGM_Reading", "CgmState", "BelowRange")),
        (firmware_sim.cgm.STATE_ABOVE_RANGE, codec.choice("CGM_Reading", "CgmState", "AboveRange")),
        (plant_server.sensor.STATE_OK, codec.choice("CGM_Reading", "CgmState", "Ok")),
        (plant_server.sensor.STATE_BELOW_RANGE, codec.choice("CGM_Reading", "CgmState", "BelowRange")),
        (plant_server.sensor.STATE_ABOVE_RANGE, codec.choice("CGM_Reading", "CgmState", "AboveRange")),
        (firmware.STEP_SNA, codec.choice("SYNC_Step", "StepIndex", "SNA")),
        (firmware.ACK_NODE_CTRL, codec.choice("UI_AlarmAck", "AlarmAckNode", "CTRL")),
        (firmware.ACK_CONFIRM, codec.choice("UI_AlarmAck", "AlarmAckAction", "Confirm")),
        (firmware.ACK_SNOOZE, codec.choice("UI_AlarmAck", "AlarmAckAction", "Snooze")),
        (caution.SIM_TIME_SNA, codec.choice("SYNC_Step", "SimTime", "SNA")),
        (user.SEQUENCES, high("MODE_Cmd", "ModeCmdSeq") + 1),
        (user.REQUEST_SUSPEND, codec.choice("MODE_Cmd", "SuspendRequest", "Suspend")),
        (user.REQUEST_RESUME, codec.choice("MODE_Cmd", "SuspendRequest", "Resume")),
        (firmware.NMT_BOOT_UP, codec.choice("HB_CTRL", "NmtCtrl", "BootUp")),
        (firmware.NMT_OPERATIONAL, codec.choice("HB_CTRL", "NmtCtrl", "Operational")),
        (firmware.NMT_PRE_OPERATIONAL, codec.choice("HB_CTRL", "NmtCtrl", "PreOperational")),
        (firmware_sim.calibration.SET_CRC_INDEX, codec.choice("CFG_Param", "CfgIndex", "CfgSetCrc")),
    ],
)
def test_numbers_the_code_repeats(ours: int, of_the_dbc: int) -> None:
    assert ours == of_the_dbc


def test_pages_of_the_calibration_carry_their_index() -> None:
    names = labels("CFG_Param", "CfgIndex")
    assert {index: fields[0].name for index, fields in codec.message("CFG_Param").pages.items()} == names
    assert all(len(fields) == 1 for fields in codec.message("CFG_Param").pages.values())


def test_calibration_and_control_core_use_the_same_units() -> None:
    table = dbc.load().get_message_by_name("CFG_Param")
    words = {word.name: word for word in layout.PARAMETERS}
    for name, signal_name in firmware_sim.calibration.CORE.items():
        word, signal = words[name], table.get_signal_by_name(signal_name)
        factor, _, unit = word.unit.rpartition(" ")
        assert unit == signal.unit, name
        assert signal.scale == pytest.approx(float(factor or 1) / (1 << word.q), rel=1e-12), name
        field = codec.message("CFG_Param").fields[signal_name]
        assert word.high == field.high, name
        assert word.low in (field.low, 1), name


# ---- the generated pages


@pytest.fixture(scope="module")
def generator() -> ModuleType:
    path = Path(__file__).resolve().parents[1] / "tools" / "generate_docs.py"
    spec = importlib.util.spec_from_file_location("generate_docs", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_generated_pages_are_up_to_date(generator: ModuleType) -> None:
    assert generator.main(["--check"]) == 0


def test_the_page_names_every_message_and_signal_with_its_id(generator: ModuleType) -> None:
    text = generator.protocol()
    for message in MESSAGES:
        section = text.split(f"\n### {message.name}\n")[1].split("\n### ")[0]
        assert section.count(f"0x{message.frame_id:03X};") == 1
        for signal in message.signals:
            if signal.name not in ("CHECKSUM", "COUNTER"):
                assert f"| {signal.name} |" in section


def test_a_stale_page_is_named_and_written_anew(
    generator: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(generator, "ROOT", tmp_path)
    monkeypatch.setattr(generator, "PAGES", {"one.md": lambda: "one\n", "two.md": lambda: "two\n"})
    (tmp_path / "one.md").write_text("one\n")
    (tmp_path / "two.md").write_text("old\n")
    assert generator.main(["--check"]) == 1
    assert capsys.readouterr().err == "two.md is not up to date: run `make docs`\n"
    assert (tmp_path / "two.md").read_text() == "old\n"
    assert generator.main([]) == 0
    assert generator.main(["--check"]) == 0
    (tmp_path / "one.md").unlink()
    assert generator.main(["--check"]) == 1


def test_a_word_without_a_value_is_an_error(
    generator: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(generator, "ROOT", tmp_path)
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "page.md").write_text("a {{word}}\n")
    assert generator.fill("page.md", {"word": "value"}) == "a value"
    for values in ({}, {"word": "value", "other": "value"}):
        with pytest.raises(KeyError, match=r"docs/page\.md"):
            generator.fill("page.md", values)


# ---- C

GCC = ["gcc", "-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror"]


@pytest.fixture
def gcc() -> list[str]:
    if shutil.which("gcc") is None:
        if os.environ.get("CI"):
            pytest.fail("gcc is missing")
        pytest.skip("gcc is missing")
    return GCC


def generate_c(directory: Path, *options: str) -> None:
    command = [sys.executable, "-m", "cantools", "generate_c_source", "--database-name", "pumpbench", *options]
    subprocess.run([*command, str(dbc.DBC_PATH)], cwd=directory, check=True, capture_output=True, timeout=60)


def test_generated_c_for_the_device_compiles_without_a_warning(gcc: list[str], tmp_path: Path) -> None:
    generate_c(tmp_path, "--node", "CTRL", "--no-floating-point-numbers")
    subprocess.run([*gcc, "-c", "pumpbench.c"], cwd=tmp_path, check=True, timeout=60)
    header = (tmp_path / "pumpbench.h").read_text()
    for message in MESSAGES:
        base = f"int pumpbench_{camel_to_snake_case(message.name)}"
        assert (f"{base}_pack(" in header) == (message.senders == ["CTRL"]), message.name
        assert (f"{base}_unpack(" in header) == ("CTRL" in message.receivers), message.name


def e2e_code_of_the_page() -> str:
    page = Path(__file__).resolve().parents[1] / "docs" / "protocol.md"
    return next(block for block in re.findall(r"```c\n(.*?)```", page.read_text(), re.S) if "e2e_checksum" in block)


def c_values(name: str, generator: random.Random) -> dict[str, int]:
    """A legal raw value for every signal of one page."""
    message = codec.message(name)
    page = generator.choice(sorted(message.pages)) if message.pages else None
    values = {}
    for signal in message.fields.values():
        home = next((key for key, fields in message.pages.items() if signal in fields), None)
        if home in (None, page):
            values[signal.name] = generator.randint(signal.low, signal.high)
    if message.selector is not None and page is not None:
        values[message.selector] = page
    return values


def c_block(name: str, values: dict[str, int], counter: int) -> str:
    """C that packs the values with CHECKSUM as the page says, unpacks what it packed, and prints both."""
    message = codec.message(name)
    base = f"pumpbench_{camel_to_snake_case(name)}"
    fields = {signal: camel_to_snake_case(signal) for signal in values}
    fill = "".join(f"m.{fields[signal]} = {raw}; " for signal, raw in values.items())
    protect = ""
    if message.data_ids:
        fill += f"m.counter = {counter}; "
        ids = ", ".join(str(byte) for byte in message.data_ids)
        protect = f"static const uint8_t ids[16] = {{{ids}}}; data[0] = e2e_checksum(data, sizeof data, ids); "
    print_data = f'for (size_t i = 0u; i < {message.length}u; i++) {{ printf("%02x", (unsigned)data[i]); }} '
    print_fields = "".join(f'printf(" %ld", (long)back.{field}); ' for field in fields.values())
    return (
        f"{{ struct {base}_t m; struct {base}_t back; uint8_t data[{message.length}]; {base}_init(&m); {fill}"
        f"if ({base}_pack(data, &m, sizeof data) != {message.length}) return 1; {protect}"
        f"if ({base}_unpack(&back, data, sizeof data) != 0) return 1; {print_data}{print_fields}"
        f'printf("\\n"); }}\n'
    )


def test_generated_c_gives_the_bytes_of_our_codec(gcc: list[str], tmp_path: Path) -> None:
    generator = random.Random(1)
    frames = [(message.name, c_values(message.name, generator), generator.randrange(16)) for message in MESSAGES * 4]
    generate_c(tmp_path)
    main = ['#include <stdio.h>\n#include "pumpbench.h"\n', e2e_code_of_the_page(), "int main(void)\n{\n"]
    main += [c_block(*frame) for frame in frames]
    main.append("return 0;\n}\n")
    (tmp_path / "main.c").write_text("".join(main))
    subprocess.run([*gcc, "main.c", "pumpbench.c", "-o", "main"], cwd=tmp_path, check=True, timeout=60)
    lines = subprocess.run(
        [str(tmp_path / "main")], check=True, capture_output=True, text=True, timeout=60
    ).stdout.splitlines()
    for (name, values, counter), line in zip(frames, lines, strict=True):
        message = codec.message(name)
        data, *back = line.split()
        assert data == codec.protect(message, message.pack(values), counter).hex(), (name, values)
        assert [int(raw) for raw in back] == list(values.values()), (name, values)


@pytest.mark.skipif(sys.platform != "linux", reason="struct can_frame is Linux'")
def test_the_hubs_client_in_the_page_compiles(gcc: list[str], tmp_path: Path) -> None:
    page = (Path(__file__).resolve().parents[1] / "docs" / "protocol.md").read_text()
    blocks = re.findall(r"^ *```c\n(.*?)^ *```", page, re.S | re.M)
    hello = next(block for block in blocks if "struct hello {" in block)
    client = next(block for block in blocks if "struct sockaddr_un" in block)
    includes = ["stdint.h", "unistd.h", "sys/socket.h", "sys/un.h", "linux/can.h"]
    source = "".join(f"#include <{name}>\n" for name in includes)
    source += f"{hello}void handle(const struct can_frame *f);\nvoid client(void);\nvoid client(void)\n{{\n{client}}}\n"
    (tmp_path / "client.c").write_text(source)
    options = ["-std=gnu11", "-Wall", "-Wextra", "-Werror", "-Wno-unused-result", "-c", "client.c"]
    subprocess.run(["gcc", *options], cwd=tmp_path, check=True, timeout=60)
