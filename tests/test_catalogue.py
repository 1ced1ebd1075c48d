"""The catalogue of faults: whole, true to its word on the reference firmware, and printed as it is written."""

import os
import re
from pathlib import Path

import pytest
from conftest import Pumpbench
from pumpbench import catalogue, matrix, probe
from pumpbench.bench import Outcome
from pumpbench.calibration import MODES
from pumpbench.catalogue import Entry, entries
from pumpbench.faults import KINDS, drop, load
from pumpbench.parallel import cpus, in_parallel
from pumpbench.probe import Probe, Verdict, judge
from pumpbench.signals import labels
from pydantic import ValidationError

MATRIX_MODES = tuple(MODES) if os.environ.get("PUMPBENCH_NIGHTLY") else ("nma", "s2", "s3", "s4")
SEEDS = 20 if os.environ.get("PUMPBENCH_NIGHTLY") else 2
"""By day a part: more runs of an entry than `matrix.RUNS_TO_TELL`, and what one seed shows another need not."""

ALARMS = {f"CTRL.{name}" for name in labels("CTRL_Alarm", "CtrlAlarmCode").values()} | {
    f"PUMP.{name}" for name in labels("PUMP_Alarm", "PumpAlarmCode").values()
}


def test_every_kind_has_an_entry_and_every_entry_a_place() -> None:
    assert {entry.fault.kind for entry in entries()} == set(KINDS)
    names = [entry.name for entry in entries()]
    assert len(set(names)) == len(names) >= 80
    for entry in entries():
        assert set(entry.seen_by) <= ALARMS | set(probe.SIGNS.values()), entry.name
        assert entry.fault.start < 6 * 3600
    assert {hazard for entry in entries() for hazard in entry.hazards} == {f"H{number}" for number in range(1, 9)}


def test_every_code_of_the_wire_is_one_kinds() -> None:
    codes = set(labels("FAULT_Inject", "FaultKind").values()) - {"None", "SNA"}
    used = {labels("FAULT_Inject", "FaultKind")[kind.CODE] for kind in KINDS.values()}
    assert codes - used == {"CorruptFixCrc", "BrownOut", "NodeMemoryLost"} - used  # by a key of another kind


def test_the_matrix_of_the_reference_firmware() -> None:
    """Every entry in every mode (by day four): no hazard, no broken run, and what should be seen is seen."""
    cells = matrix.run(SEEDS, MATRIX_MODES, jobs=cpus())
    assert len(cells) == len(entries()) * len(MATRIX_MODES) * SEEDS
    assert [f"{cell.entry.name}, {cell.mode}, {cell.seed}: {cell.wrong}" for cell in cells if cell.wrong] == []
    assert matrix.outdated(cells) == {}
    for entry in entries():
        assert any(cell.verdict.injected for cell in cells if cell.entry is entry), f"{entry.name} never acted"
    text = matrix.page(cells)
    assert text.count("\n| ") == len(entries()) + 1 and "of which 0 were wrong" in text


# ---- what would be wrong


def cell(**verdict: object) -> matrix.Cell:
    entry = next(entry for entry in entries() if entry.seen_by == ("LostFrameCount",))
    whole = {"hazards": {}, "first": None, "signs": frozenset({"LostFrameCount"}), "injected": 1}
    return matrix.Cell(entry, "nma", 1, Verdict(**(whole | verdict)))  # type: ignore[arg-type]


def test_what_is_wrong_with_a_run_is_said() -> None:
    assert cell().wrong == ""
    assert cell(signs=frozenset(), injected=0).wrong == ""  # it did not act: there was nothing to see
    assert cell(signs=frozenset({"CTRL.CgmLost"})).wrong == "not seen: LostFrameCount; found CTRL.CgmLost"
    assert cell(signs=frozenset()).wrong == "not seen: LostFrameCount; found nothing"
    assert cell(hazards={"H3": 2}, first=(7, "H3")).wrong == "hazards {'H3': 2}, the first in step 7"
    assert cell(error="NodeDied: silent").wrong == "NodeDied: silent"
    row = matrix.table([cell(), cell(hazards={"H3": 2}), cell(error="x"), cell(injected=0)]).splitlines()[-1]
    assert "| 3 of 4 | 3 | LostFrameCount all |" in row


def test_a_reason_that_is_none_any_more_is_found() -> None:
    entry = next(entry for entry in entries() if entry.unseen)
    seen = [matrix.Cell(entry, "nma", seed, cell().verdict) for seed in range(1, 8)]
    assert matrix.outdated(seen[:6]) == {}  # too few to tell
    assert matrix.outdated(seen) == {entry.name: {"LostFrameCount"}}
    assert matrix.outdated([*seen, matrix.Cell(entry, "nma", 8, cell(signs=frozenset()).verdict)]) == {}


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"seen_by": ()}, "give either seen_by, or unseen with the reason"),
        ({"unseen": "why"}, "give either seen_by, or unseen with the reason"),
        ({"modes": ("s9",)}, "modes are of nma, ma"),
        ({"hazards": ("H9",)}, "hazards"),
        ({"hazards": ()}, "hazards"),
    ],
)
def test_an_entry_that_is_none(change: dict[str, object], expected: str) -> None:
    good = {"name": "x", "fault": {"kind": "bus_off"}, "hazards": ("H7",), "seen_by": ("CTRL.CgmLost",)}
    Entry.model_validate(good)
    with pytest.raises(ValidationError, match=expected):
        Entry.model_validate(good | change)


# ---- verdicts


def test_a_verdict_is_against_the_same_run_without_faults() -> None:
    entry = next(entry for entry in entries() if entry.name == "samples lost for 40 min")
    verdict = judge(Probe(faults=(entry.fault,)))
    assert not verdict.failed and verdict.injected == 8
    assert verdict.signs == {"CTRL.CgmLost", "LostFrameCount", "SequenceErrorCount"}
    assert judge(Probe()) == Verdict({}, None, frozenset(), 0)


@pytest.mark.parametrize(("mode", "seed"), [("sma", 3), ("s2", 4)])
def test_the_compiled_twin_is_the_twin(mode: str, seed: int) -> None:
    for scenario, hours in (("six-hours", 6.0), ("camerlingo", 24.0), ("validation-14d", 11.5)):
        probe = Probe("adult#008", mode, seed, scenario, hours, (drop("CGM_Reading", start="01:00", end="05:00"),))
        slow, quick = judge(probe), judge(probe, signs=False)
        assert quick == slow._replace(signs=frozenset())


def test_a_run_that_breaks_off_is_a_verdict(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(_probe: Probe) -> Outcome:
        raise RuntimeError("the firmware went silent")

    monkeypatch.setattr(probe, "run", broken)
    verdict = judge(Probe())
    assert verdict.failed and verdict.error == "RuntimeError: the firmware went silent"


def test_answers_come_in_the_order_of_the_questions_from_one_process_or_two() -> None:
    told: list[int] = []
    assert list(in_parallel(abs, [-3, 2, -1], 1, told.append)) == [3, 2, 1] and told == [1, 2, 3]
    assert list(in_parallel(abs, list(range(-20, 0)), 2)) == list(range(20, 0, -1))


# ---- on the command line


def test_the_list_and_a_kind_on_the_command_line(pumpbench: Pumpbench, runs: Path) -> None:
    listed = pumpbench("faults")
    assert listed.returncode == 0
    for kind in KINDS:
        assert re.search(rf"^ {kind} +\S", listed.stdout, re.M), kind
    shown = pumpbench("faults", "set_value").stdout
    assert "  repair_crc   true or false; default true" in shown and "  signal       text\n" in shown
    assert "  start        time; default the beginning" in shown
    examples = re.findall(r"^faults:\n(?:  - .*\n)+", shown, re.M)
    assert len(examples) == len(catalogue.examples("set_value"))
    (runs / "faults.yaml").write_text(examples[0])
    assert load(runs / "faults.yaml").wire == (catalogue.examples("set_value")[0].fault,)
    wrong = pumpbench("faults", "drip")
    assert (wrong.returncode, wrong.stderr.count("\n")) == (2, 1) and "did you mean drop" in wrong.stderr


@pytest.mark.nightly
def test_the_matrix_on_the_command_line(pumpbench: Pumpbench, runs: Path) -> None:
    done = pumpbench("matrix", "--seeds", "1", "--modes", "nma", "--markdown", runs / "page.md", "--jobs", "1")
    assert done.returncode == 0, done.stderr
    assert done.stdout == f"{len(entries())} runs, 0 of them wrong\n"
    assert (runs / "page.md").read_text().startswith("# The matrix of faults\n")
    wrong = pumpbench("matrix", "--modes", "nma,s9")
    assert wrong.returncode == 2 and "there is no mode 's9'" in wrong.stderr
