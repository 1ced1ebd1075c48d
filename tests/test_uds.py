"""Diagnostics: what a service tool can read and ask for, with udsoncan as the tool, and that it can never dose."""

import random
import subprocess
import sys
import time
from collections import deque
from pathlib import Path

import can
import isotp
import pytest
import udsoncan
from bench import S2, Bench
from conftest import ROOT
from hypothesis import given, settings
from hypothesis import strategies as st
from pair import Pair
from test_restart import DEADLINE, wait_for
from udsoncan import DidCodec, MemoryLocation, services
from udsoncan.client import Client
from udsoncan.connections import BaseConnection
from udsoncan.exceptions import NegativeResponseException

import dbc
from can_bus.codec import message
from can_bus.frame import Frame
from can_bus.lockstep import Done
from firmware_sim import selftest
from firmware_sim.alarms import Code
from firmware_sim.firmware import NVM_BYTES, Firmware
from firmware_sim.nvm import RamMemory
from firmware_sim.selftest import Failure
from firmware_sim.uds import AVAILABLE, DIDS_AT_MOST, dtc

REQUEST, RESPONSE = message("UDS_Request").can_id, message("UDS_Response").can_id
ADDRESS = isotp.Address(rxid=RESPONSE, txid=REQUEST)


class Raw(DidCodec):
    """Bytes as they come."""

    def decode(self, string_bin: bytes) -> bytes:
        return string_bin

    def __len__(self) -> int:
        raise DidCodec.ReadAllRemainingData


CONFIG = {"data_identifiers": {"default": Raw}, "request_timeout": 5, "p2_timeout": 5}


class Line(BaseConnection):
    """udsoncan on can-isotp, straight to a device in this process."""

    def __init__(self, device: Firmware) -> None:
        super().__init__("line")
        self._device = device
        self._answers = deque[bytes]()
        self._layer = isotp.TransportLayerLogic(rxfn=self._fetch, txfn=self._deliver, address=ADDRESS)

    def _deliver(self, frame: isotp.CanMessage) -> None:
        for answer in self._device.receive(Frame(REQUEST, bytes(frame.data))):
            assert answer.can_id == RESPONSE and len(answer.data) == 8
            self._answers.append(answer.data)

    def _fetch(self, _timeout: float) -> isotp.CanMessage | None:
        return isotp.CanMessage(arbitration_id=RESPONSE, data=self._answers.popleft()) if self._answers else None

    def specific_send(self, payload: bytes, timeout: float | None = None) -> None:
        self._layer.send(payload)
        for _ in range(50):
            self._layer.process()

    def specific_wait_frame(self, timeout: float | None = 2) -> bytes | None:
        for _ in range(200):
            self._layer.process()
            if self._layer.available():
                return bytes(self._layer.recv())
        raise udsoncan.exceptions.TimeoutException("no answer")

    def open(self) -> "Line":
        return self

    def close(self) -> None:
        self._layer.reset()

    def empty_rxqueue(self) -> None:
        self._answers.clear()

    def is_open(self) -> bool:
        return True


def new_memory() -> RamMemory:
    return RamMemory(NVM_BYTES)


class Station:
    """A firmware on the bench and a tester beside it."""

    def __init__(self, memory: RamMemory | None = None) -> None:
        self.firmware = Firmware(memory)
        self.bench = Bench(mode=S2, firmware=self.firmware)
        self.bench.run(9)
        self.tool = Client(Line(self.firmware), config=CONFIG)

    def ask(self, request: str) -> str:
        """A raw request and its raw answer, in hexadecimal."""
        self.tool.conn.send(bytes.fromhex(request))
        return self.tool.conn.wait_frame(exception=True).hex()

    def statuses(self, mask: int = 0xFF) -> dict[int, int]:
        """DTC -> status byte."""
        found = self.tool.get_dtc_by_status_mask(mask).service_data.dtcs
        return {code.id: code.status.get_byte_as_int() for code in found}


@pytest.fixture
def station() -> Station:
    return Station(new_memory())


# ---- reading


def test_identification(station: Station) -> None:
    read = station.tool.read_data_by_identifier_first
    assert len(read(0xF190)) == 17
    assert read(0xF18C).decode("ascii") == "REFERENCE-0001"
    assert read(0xF195) == b"0.2"
    assert read(0x0100) == bytes(dbc.protocol_version())
    assert read(0x0101) == dbc.crc32().to_bytes(4, "big")
    assert read(0x0103) == (8).to_bytes(4, "big")
    assert read(0xF186) == b"\x01"
    station.tool.change_session(3)
    assert read(0xF186) == b"\x03"


def test_counters_are_those_of_the_bus(station: Station) -> None:
    bench = station.bench
    for k in range(3):
        frame = bench.sample()
        bench.step(cgm=[Frame(frame.can_id, frame.data[:7] + bytes([frame.data[7] ^ 1 << k]))])
    diag = bench.step().diag
    for did, name in ((0x0110, "E2eErrorCount"), (0x0111, "LostFrameCount"), (0x0112, "SequenceErrorCount")):
        assert int.from_bytes(station.tool.read_data_by_identifier_first(did), "big") == diag[name], name
    assert diag["E2eErrorCount"] == 3


def test_a_device_without_a_bench_answers_too() -> None:
    tool = Client(Line(Firmware()), config=CONFIG)
    assert tool.read_data_by_identifier_first(0x0103) == (1048575).to_bytes(4, "big")


def test_several_identifiers_at_once(station: Station) -> None:
    assert station.ask("22 F195 0100 ABCD") == f"62f195{b'0.2'.hex()}0100{bytes(dbc.protocol_version()).hex()}"


# ---- what is refused, and how


@pytest.mark.parametrize(
    ("session", "request_", "answer"),
    [
        ("01", "10", "7f1013"),
        ("01", "10 02", "7f1012"),
        ("01", "10 01 00", "7f1013"),
        ("01", "10 01", "5001003201f4"),
        ("01", "10 03", "5003003201f4"),
        ("01", "3E", "7f3e13"),
        ("01", "3E 01", "7f3e12"),
        ("01", "3E 00", "7e00"),
        ("01", "22", "7f2213"),
        ("01", "22 F1", "7f2213"),
        ("01", "22 F1 95 01", "7f2213"),
        ("01", "22 AB CD", "7f2231"),
        ("01", "22" + "F195" * (DIDS_AT_MOST + 1), "7f2213"),
        ("01", "19", "7f1913"),
        ("01", "19 03", "7f1912"),
        ("01", "19 01", "7f1913"),
        ("01", "19 0A FF", "7f1913"),
        ("01", "14", "7f1413"),
        ("01", "14 FF FF FF 00", "7f1413"),
        ("01", "14 12 34 56", "7f1431"),
        ("01", "14 FF FF FF", "54"),
        ("01", "11 01", "7f117f"),
        ("01", "31 01 02 00", "7f317f"),
        ("03", "11", "7f1113"),
        ("03", "11 02", "7f1112"),
        ("03", "11 01 01", "7f1113"),
        ("03", "31 02 02 00", "7f3112"),
        ("03", "31 01 02", "7f3113"),
        ("03", "31 01 02 03", "7f3131"),
        ("01", "31 01 02 01 01 00 05", "7f317f"),
        ("03", "31 01 02 01", "7f3113"),
        ("03", "31 03 02 01 01 00 05", "7f3112"),
        ("03", "31 01 02 01 07 00 05", "7f3131"),
        ("03", "31 01 02 01 06 00 05", "71010201"),
        ("03", "31 03 02 00", "7f3124"),
        ("03", "27 01", "7f2711"),  # no security access,
        ("03", "2E F1 90 00", "7f2e11"),  # no writing,
        ("03", "2F 01 00 03", "7f2f11"),  # no outputs,
        ("03", "34 00 44", "7f3411"),  # no download
        ("03", "3D 11 00 00", "7f3d11"),
        ("03", "00", "7f0011"),
        ("03", "7F 10 11", "7f7f11"),
    ],
)
def test_answers(station: Station, session: str, request_: str, answer: str) -> None:
    station.ask(f"10{session}")
    assert station.ask(request_) == answer


@pytest.mark.parametrize("request_", ["3E 80", "10 83", "19 81 FF", "19 8A"])
def test_an_answer_that_is_not_wanted_is_not_sent(station: Station, request_: str) -> None:
    data = bytes.fromhex(request_)
    assert list(station.firmware.receive(Frame(REQUEST, bytes([len(data)]) + data))) == []
    # a refusal is sent all the same
    assert station.ask("3E 81") == "7f3e12"


@pytest.mark.parametrize(("load", "least", "most"), [("03E8", 1001, 1020), ("FFFF", 65533, 65533)])
def test_a_load_makes_its_task_late_for_one_step(station: Station, load: str, least: int, most: int) -> None:
    """What SYNC_Done cannot hold, it tells as the most it can."""
    station.ask("1003")
    request = bytes.fromhex(f"0731810201 01 {load}")  # task 1, the sensor's
    assert list(station.firmware.receive(Frame(REQUEST, request))) == []
    turn = station.bench.step()
    assert turn.done["DoneStatus"] == Done.OVERRUN and turn.alarms(Code.WATCHDOG)
    assert least <= turn.done["ExecTime"] <= most
    assert station.bench.step().done["DoneStatus"] == Done.OK


def test_the_tool_gets_exceptions_it_understands(station: Station) -> None:
    with pytest.raises(NegativeResponseException, match="ServiceNotSupported"):
        station.tool.read_memory_by_address(MemoryLocation(0x20000000, 4))


# ---- trouble codes


def test_a_lost_sensor_is_a_trouble_code(station: Station) -> None:
    lost = dtc(Code.CGM_LOST)
    station.tool.clear_dtc()  # of the start
    assert station.statuses() == {}
    supported = station.tool.get_supported_dtc().service_data.dtcs
    assert {code.id for code in supported} == {0xF00000 | code << 8 for code in Code}
    for _ in range(5):
        station.bench.step(drop=True)
    assert station.statuses() == {lost: 0x2B}
    assert station.tool.get_number_of_dtc_by_status_mask(0x01).service_data.dtc_count == 1
    assert station.tool.get_number_of_dtc_by_status_mask(0xFF & ~AVAILABLE).service_data.dtc_count == 0
    # clearing takes back no alarm
    before = station.bench.step(drop=True).alarms(Code.CGM_LOST)
    station.tool.clear_dtc()
    assert station.statuses()[lost] == 0x01
    assert station.bench.step(drop=True).alarms(Code.CGM_LOST)[0]["CtrlAlarmInstance"] == before[0]["CtrlAlarmInstance"]
    assert station.statuses() == {lost: 0x2B}  # the cause still holds
    station.bench.run(12)
    assert station.statuses() == {lost: 0x2A}
    station.tool.clear_dtc(dtc(Code.PUMP_LOST))
    assert station.statuses() == {lost: 0x2A}
    station.tool.clear_dtc(lost)
    assert station.statuses() == {}


def test_the_history_outlives_a_reset() -> None:
    memory = new_memory()
    station = Station(memory)
    for _ in range(5):
        station.bench.step(drop=True)
    station.bench.run(12)
    reborn = Client(Line(Firmware(memory)), config=CONFIG)
    codes = reborn.get_dtc_by_status_mask(0xFF).service_data.dtcs
    history = {code.id: code.status.get_byte_as_int() for code in codes}
    assert history == {dtc(Code.CGM_LOST): 0x28, dtc(Code.STATE_CHANGE): 0x28}


# ---- sessions, self test, reset


def test_an_extended_session_ends_with_a_whole_silent_step(station: Station) -> None:
    station.tool.change_session(3)
    for _ in range(3):
        station.bench.step()
        station.tool.tester_present()
    assert station.ask("31 01 02 00").startswith("71")
    station.bench.step()
    assert station.ask("22 F1 86") == "62f18603"
    station.bench.run(2)
    assert station.ask("22 F1 86") == "62f18601"


def test_the_self_test_is_that_of_the_boot(station: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    station.tool.change_session(3)
    before = list(station.firmware._state)
    assert station.tool.start_routine(0x0200).service_data.routine_status_record == b"\x00"
    assert station.tool.get_routine_result(0x0200).service_data.routine_status_record == b"\x00"
    assert station.firmware._state == before
    station.firmware._calibration.parameters[3] += 1
    monkeypatch.setattr(selftest, "PROGRAM_CRC", 1)
    expected = Failure.PARAMETERS | Failure.PROGRAM
    assert station.tool.start_routine(0x0200).service_data.routine_status_record == bytes([expected])
    turn = station.bench.step()
    assert not turn.all("PUMP_BasalCmd"), "a device that has failed its test commands nothing"
    assert turn.alarms(Code.SELF_TEST)[0]["CtrlAlarmAux"] == expected


def test_the_self_test_looks_at_the_memory() -> None:
    memory = new_memory()
    station = Station(memory)
    station.tool.change_session(3)
    for bit in range(0, memory.size * 8, 64):
        memory.flip(bit)
    assert station.tool.start_routine(0x0200).service_data.routine_status_record == bytes([Failure.MEMORY])


@pytest.mark.parametrize("kind", [1, 3])
def test_a_reset_is_asked_for(station: Station, kind: int) -> None:
    station.tool.change_session(3)
    station.tool.ecu_reset(kind)
    assert station.firmware.reset_requested


def test_without_a_memory_there_is_no_reset() -> None:
    station = Station()
    station.tool.change_session(3)
    assert station.ask("11 01") == "7f1122"
    assert not station.firmware.reset_requested


def test_no_reset_while_a_bolus_is_under_way() -> None:
    pair = Pair("ma", meals=[(10, 60.0)], steps=24)
    refused: list[int] = []
    tool = Client(Line(pair.firmware), config=CONFIG)

    def ask(name: str, values: dict[str, int], _frame: Frame) -> None:
        if name == "SYNC_Step" and values["SyncPhase"] in (1, 5):
            tool.conn.send(b"\x10\x03")
            tool.conn.wait_frame()
            tool.conn.send(b"\x11\x01")
            if tool.conn.wait_frame() == b"\x7f\x11\x22":
                refused.append(pair.plant.step)

    pair.to_device = ask  # type: ignore[assignment]
    pair.play()
    assert refused and set(refused) <= {10, 11}
    assert len(pair.commits(1)) == 1


# ---- it cannot dose


REQUESTS = [
    b"\x02\x10\x03", b"\x02\x11\x01", b"\x04\x14\xff\xff\xff", b"\x02\x19\x0a", b"\x03\x19\x02\xff",
    b"\x03\x22\xf1\x90", b"\x04\x31\x01\x02\x00", b"\x02\x3e\x00", b"\x30\x00\x00", b"\x10\x14abcdef",
    b"\x21ghijklm", b"",
]  # fmt: skip


@settings(max_examples=15, deadline=None)
@given(
    strategy=st.sampled_from(["s2", "s3", "s4"]),
    seed=st.integers(0, 1 << 30),
    frames=st.lists(st.one_of(st.binary(max_size=8), st.sampled_from(REQUESTS)), min_size=1, max_size=40),
)
def test_no_request_changes_a_frame(strategy: str, seed: int, frames: list[bytes]) -> None:
    """Anything on the tester's id, anywhere in a run with meals and lost samples: the run is the same bit by bit."""
    said: list[list[Frame]] = []
    for tested in (False, True):
        generator = random.Random(seed)
        pair = Pair(strategy, meals=[(8, 70.0), (20, 30.0)], steps=30)
        pair.to_device = lambda name, values, _: [] if name == "CGM_Reading" and values["CgmSampleSeq"] > 24 else None
        heard: list[Frame] = []

        def watch(arrived: list[Frame], heard: list[Frame] = heard) -> None:
            heard += arrived

        give = pair.give

        def disturbed(frame: Frame, give=give, pair=pair, generator=generator) -> list[Frame]:  # type: ignore[no-untyped-def]
            for _ in range(generator.randrange(4)):
                answers = pair.firmware.receive(Frame(REQUEST, generator.choice(frames)))
                assert all(answer.can_id == RESPONSE and len(answer.data) == 8 for answer in answers)
            return give(frame)

        pair.watch = watch  # type: ignore[assignment]
        if tested:
            pair.give = disturbed  # type: ignore[method-assign]
        pair.play()
        said.append(heard)
    assert said[0] == said[1]
    assert not any(frame.can_id == RESPONSE for frame in said[1])


def test_a_flood_is_no_work_of_the_control_loop(station: Station) -> None:
    usual = station.bench.step().done
    for _ in range(2000):
        station.firmware.receive(Frame(REQUEST, b"\x02\x3e\x80"))
    assert station.bench.step().done["ExecTime"] == usual["ExecTime"]


@pytest.mark.parametrize("can_id", [REQUEST | 0x80000000, REQUEST | 0x40000000, REQUEST | 0x20000000, 0x7DF])
def test_frames_of_other_kinds_are_nobodys(station: Station, can_id: int) -> None:
    assert list(station.firmware.receive(Frame(can_id, b"\x02\x3e\x00"))) == []
    assert station.bench.step().diag["E2eErrorCount"] == (can_id >> 29 == 1)  # an error frame is told of


# ---- over a bus, in the midst of a run


def test_with_udsoncan_over_the_hub_and_a_reset_in_the_middle(tmp_path: Path) -> None:
    url, nvm = f"unix:{tmp_path / 'bus'}", tmp_path / "nvm"
    options = ["--bus", url, "--host", "--strategy", "s3", "--scenario", "camerlingo", "--days", "60"]
    plant = subprocess.Popen([sys.executable, "-m", "pumpbench", "plant", *options])
    firmware = None
    try:
        wait_for(tmp_path / "bus")
        firmware = subprocess.Popen([sys.executable, "-m", "firmware_sim", "--bus", url, "--nvm", str(nvm)])
        wait_for(nvm, filled=True)
        example = [sys.executable, str(ROOT / "examples" / "uds_read.py"), "hilbus", url]
        shown = subprocess.run(example, capture_output=True, text=True, timeout=DEADLINE, check=True).stdout
        assert "device          PUMPBENCHCTRL0001\n" in shown
        assert "boots           0\n" in shown
        with can.Bus(interface="hilbus", channel=url) as bus:
            connection = udsoncan.connections.PythonIsoTpConnection(isotp.CanStack(bus, address=ADDRESS))
            with Client(connection, config=CONFIG) as tool:
                end = time.monotonic() + DEADLINE
                while True:  # a meal's bolus may be under way
                    tool.change_session(services.DiagnosticSessionControl.Session.extendedDiagnosticSession)
                    try:
                        tool.ecu_reset(services.ECUReset.ResetType.hardReset)
                        break
                    except NegativeResponseException:
                        assert time.monotonic() < end
                while tool.read_data_by_identifier_first(0x0116) != b"\x00\x01":
                    assert time.monotonic() < end
                step = tool.read_data_by_identifier_first(0x0103)
                while tool.read_data_by_identifier_first(0x0103) == step:  # the run goes on
                    assert time.monotonic() < end
        plant.kill()
        assert firmware.wait(DEADLINE) == 3
    finally:
        for process in (firmware, plant):
            if process is not None:
                process.kill()
                process.wait()


def test_the_example_says_what_it_needs() -> None:
    hide = "import sys; sys.modules['isotp'] = None; sys.argv = ['x']; import runpy; runpy.run_path(sys.argv.pop())"
    example = str(ROOT / "examples" / "uds_read.py")
    code = hide.replace("['x']", repr(["x", example]))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr == "isotp is missing: pip install 'pumpbench[diagnostics]'\n"
    done = subprocess.run([sys.executable, example], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr.startswith("usage: ")) == (2, True)
