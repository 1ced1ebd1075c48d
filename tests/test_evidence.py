"""The evidence page says what the frames say, what was changed is red, and nothing breaks out of its text."""

import itertools
import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from conformance_devices import Changed, Values, check_all
from conftest import ROOT, Pumpbench
from html_page import Page
from pumpbench import bench, hazards, rig
from pumpbench.capture import Capture
from pumpbench.conformance import report as reports
from pumpbench.evidence import conformance, page
from pumpbench.evidence.page import Material
from pumpbench.evidence.run import Evidence, Level, load
from pumpbench.faults import drop, occlusion
from pumpbench.identity import firmware_sha256
from pumpbench.runfolder import RunFolder, RunFolderError

from can_bus.yaml_file import FileError
from plant_server.server import PlantServer


def rendered(*runs: Evidence, **more: Any) -> Page:
    shown = Page(page.render(Material(runs, **more)))
    assert not shown.mute
    return shown


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three runs that differ in nothing but their faults."""
    place = tmp_path_factory.mktemp("runs")
    for name, faults in (
        ("clean", []),
        ("dropped", [drop("CGM_Reading", start="02:00", end="03:00")]),
        ("occluded", [occlusion(start="01:00", end="05:30")]),
    ):
        bench.run(strategy="s2", hours=6, faults=faults, out=place / name)
    return place


@pytest.fixture(scope="module")
def harmful(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of a firmware that asks for 35 U/h in every fiftieth step."""

    def greedy(name: str, values: Values) -> Values:
        return (
            values | {"InsulinRate": 7000} if name == "PUMP_BasalCmd" and values["BasalCmdSeq"] % 50 == 49 else values
        )

    out = tmp_path_factory.mktemp("harm") / "harmful"
    prepared = rig.prepare(rig.Request(patient="adult#001", out=out, strategy="s2", steps=120, bus="inproc"))
    capture = Capture()
    rig.Wires(PlantServer(prepared.run), Changed(says=greedy), None, capture).run(lambda _step: None)
    bench.Outcome.of(capture.finish(), prepared.info).write(out)
    return out


@pytest.fixture
def copy(folders: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(folders / "dropped", tmp_path / "copy"))


def edit(file: Path, change: Callable[[dict[str, Any]], None]) -> None:
    content = json.loads(file.read_text())
    change(content)
    file.write_text(json.dumps(content))


def results(tmp_path: Path, changed: Changed | None = None, name: str = "report.json", **about: Any) -> Path:
    """A result file of a few requirements."""
    report = check_all(changed or Changed(), ["SEN-01", "SEN-04", "E2E-01", "STA-02"])
    known = {"bus": "inproc", "firmware": "reference", "firmware_sha256": firmware_sha256(None), "long": False}
    file = tmp_path / name
    file.write_text(reports.as_json(report, known | about))
    return file


# ---- a run


def test_the_numbers_are_those_of_metrics_json(folders: Path) -> None:
    run = load(folders / "dropped")
    assert run.doubts == ()
    assert run.metrics == RunFolder.load(folders / "dropped").metrics
    shown = rendered(run)
    outcome = {row[0]: row[1] for row in shown.table("metric", "value")}
    assert len(outcome) == len(page.METRICS)
    for metric in page.METRICS:
        assert outcome[metric.name] == f"{run.metrics[metric.key]:.{metric.digits}f} {metric.unit}"
    counters = {row[0]: row[1] for row in shown.table("counter", "value")}
    for name in page.COUNTERS:
        assert counters[name] == str(run.safety[name])
    ledger = {row[0]: row[1:] for row in shown.table("drug", "commanded")}
    for drug, parts in run.safety["ledger"].items():
        numbers = [str(parts[part]) for part in ("commanded", "delivered", "pending", "lost")]
        assert ledger[drug] == [*numbers, "✓ yes"]
    assert [row[:2] for row in shown.table("", "counted")] == [[f"H{n}", "0"] for n in range(1, 9)]
    assert ["d0 02:15", "d0 03:15", "CTRL", "CgmLost", "Medium"] in shown.table("raised", "over")
    assert ["d0 02:00", "fault", "Drop CGM_Reading for 60 min"] in shown.table("when", "kind")
    assert run.verdict == (Level.GOOD, "no hazard counted; both ledgers close; 2 alarms; no delivery uncertain")


def test_where_it_comes_from(folders: Path) -> None:
    run = load(folders / "dropped")
    shown = rendered(run)
    info = json.loads((folders / "dropped" / "run.json").read_text())
    for digest in (info["trace_sha256"], *info["parameters"].values(), *info["firmware_sha256"].values()):
        assert digest in shown.text
    assert "version 0.2, build 0, for protocol 1.3 (CTRL_Info)" in shown.text
    assert f"pumpbench.dbc {info['dbc_crc32']}" in shown.text
    for name, version in info["packages"].items():
        assert f"{name} {version}" in shown.text
    (fault,) = shown.table("fault", "what it does")
    assert fault[0].startswith("{kind: drop, start: '02:00', end: '03:00', message: CGM_Reading")
    assert fault[1:] == ["The frame is lost.", "H3 H4 H7"]
    assert [file.name for file in run.files] == [row[0] for row in shown.table("file", "bytes")]


def test_pictures_are_the_run_and_its_close_ups(folders: Path) -> None:
    shown = rendered(load(folders / "clean"), load(folders / "dropped"))
    assert len(shown.images) == 3
    assert all(str(image["src"]).startswith("data:image/png;base64,iVBOR") and image["alt"] for image in shown.images)
    assert str(shown.images[2]["alt"]).startswith("Close-up from d0 01:00 to")
    assert "Drop CGM_Reading" in str(shown.images[2]["alt"])


def test_a_delivery_that_stays_uncertain_is_to_be_looked_at(folders: Path) -> None:
    level, text = load(folders / "occluded").verdict
    assert level == Level.OPEN
    assert re.search(r"delivery uncertain \(alarm at d0 01:\d\d\), still so at the end", text)


def test_a_hazard_is_red(harmful: Path) -> None:
    run = load(harmful)
    assert run.counted == run.hazards["H2"] == 2
    assert run.verdict.level == Level.BAD
    assert run.verdict.text.startswith("hazards counted: H2 × 2, the first (H2) at d0 04:05; both ledgers close")
    shown = rendered(run)
    assert shown.table("", "counted")[1] == ["H2", "✗ 2", hazards.NAMES["H2"]]
    assert ["d0 04:05", "hazard", f"H2: {hazards.NAMES['H2']}"] in shown.table("when", "kind")
    assert "wrong" in shown.text


def test_what_was_not_judged_is_not_called_safe(folders: Path) -> None:
    run = load(folders / "clean")
    safety = {**run.safety, "hazards": dict.fromkeys(run.hazards)}
    free = replace(run, metrics={**run.metrics, "safety": safety})
    assert free.counted is None
    assert free.verdict.level == Level.OPEN
    assert free.verdict.text.startswith("not judged: H1, H2, H3, H4, H5, H6, H7, H8; both ledgers close")
    assert rendered(free).table("", "counted")[0][1] == "not judged"


def test_a_ledger_that_does_not_close_is_red(folders: Path) -> None:
    run = load(folders / "clean")
    ledger = {**run.safety["ledger"], "insulin": {**run.safety["ledger"]["insulin"], "closes": False}}
    open_ = replace(run, metrics={**run.metrics, "safety": {**run.safety, "ledger": ledger}})
    assert open_.verdict.level == Level.BAD
    assert "the ledger of insulin does not close" in open_.verdict.text


def test_the_hazards_are_those_of_the_design() -> None:
    design = (ROOT / "docs" / "design.md").read_text(encoding="utf-8")
    assert dict(re.findall(r"^\| (H\d) \| (.*) \|$", design, re.MULTILINE)) == hazards.NAMES


def test_a_run_that_was_only_listened_to(folders: Path, tmp_path: Path) -> None:
    """`pumpbench record` beside firmware and plant of others knows neither patient nor seed."""
    whole = RunFolder.load(folders / "clean")
    bench.Outcome.of(whole.frames, {}).write(tmp_path / "heard")
    run = load(tmp_path / "heard")
    assert run.verdict.level == Level.GOOD
    shown = rendered(run)
    assert ["patient", "not recorded"] in shown.captions["Run"][0]
    assert ["SHA-256", "none: no file of it was named"] in shown.captions["Firmware"][0]
    assert (2, "Run 1: heard") in shown.headings


# ---- what was changed, and what is missing


def test_a_changed_log_is_red_and_its_frames_are_not_shown(copy: Path) -> None:
    lines = (copy / "bus.log").read_text().splitlines(keepends=True)
    (copy / "bus.log").write_text("".join(lines[:500] + lines[501:]))
    run = load(copy)
    assert run.verdict.level == Level.BAD
    assert run.verdict.text.startswith("not as it was recorded: bus.log was changed: its frames have trace_sha256 ")
    shown = rendered(run)
    assert shown.images == []
    assert "the frames in bus.log have another" in shown.text
    assert not any(rows and rows[0][:2] == ["metric", "value"] for rows in shown.tables)


def test_changed_metrics_are_red_and_not_what_is_shown(copy: Path) -> None:
    edit(copy / "metrics.json", lambda metrics: metrics.update(tir_70_180=99.9))
    edit(copy / "metrics.json", lambda metrics: metrics["safety"].update(alarms=0))
    run = load(copy)
    assert run.verdict.level == Level.BAD
    assert "metrics.json does not agree with bus.log in tir_70_180, safety.alarms: it was changed" in run.verdict.text
    assert run.metrics["tir_70_180"] != 99.9
    assert "99.9" not in rendered(run).text


def test_a_changed_trace_is_red(copy: Path) -> None:
    table = pq.read_table(copy / "trace.parquet")
    where = table.column_names.index("TruthGlucose")
    column = table.column(where).to_numpy().copy()
    column[7] += 0.1
    changed = table.set_column(where, table.schema.field(where), [column])
    pq.write_table(changed, copy / "trace.parquet")
    assert "trace.parquet does not agree with bus.log in TruthGlucose: it was changed" in load(copy).verdict.text


def test_another_seed_in_run_json_is_red(copy: Path) -> None:
    edit(copy / "run.json", lambda info: info.update(seed=2))
    assert "trace.parquet does not agree with bus.log in run.json.seed" in load(copy).verdict.text


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda copy: (copy / "metrics.json").unlink(), r"copy is not a complete run folder: metrics\.json missing"),
        (lambda copy: (copy / "bus.log").write_text("gibberish\n"), r"bus\.log:1: not a line of a candump log"),
        (
            lambda copy: edit(copy / "run.json", lambda info: info.update(complete=False)),
            r"run\.json: complete: .*True",
        ),
        (lambda copy: edit(copy / "run.json", lambda info: info.update(faults="x")), r"run\.json: faults: .*'x'"),
        (
            lambda copy: edit(copy / "run.json", lambda info: info.update(dbc_crc32="0badcafe")),
            r"another pumpbench\.dbc: CRC-32 0badcafe, this one \w+; take the pumpbench that recorded it \(0\.1\.0\)",
        ),
    ],
)
def test_a_damaged_folder_is_refused(copy: Path, change: Callable[[Path], None], text: str) -> None:
    change(copy)
    with pytest.raises(RunFolderError, match=text):
        load(copy)


def test_folders_left_out_are_named_on_the_page(folders: Path, tmp_path: Path) -> None:
    missing = tmp_path / "gone"
    with pytest.raises(RunFolderError, match="there is no run folder"):
        page.collect([folders / "clean", missing])
    material = page.collect([folders / "clean", missing], keep_going=True)
    assert [why for _, why in material.at(Level.BAD)] == [f"left out: there is no run folder {missing}"]
    assert f"left out: there is no run folder {missing}" in Page(page.render(material)).text


# ---- several runs


def test_an_overview_with_links_and_a_comparison(folders: Path, harmful: Path) -> None:
    runs = [load(folders / "occluded"), load(folders / "clean"), load(folders / "dropped"), load(harmful)]
    shown = rendered(*runs)
    overview = shown.table("run", "verdict")
    assert [row[:4] for row in overview] == [
        ["Run 1", "? to be looked at", "0", "3"],
        ["Run 2", "✓ in order", "0", "1"],
        ["Run 3", "✓ in order", "0", "2"],
        ["Run 4", "✗ wrong", "✗ 2", "1"],
    ]
    (rows,) = shown.captions["adult#001, validation-14d, seed 1, 72 steps"]
    assert [row[0] for row in rows[1:]] == ["Run 2", "Run 1", "Run 3"]  # the one without faults is the measure
    assert [row[2] for row in rows[1:]] == ["none", "occlusion", "drop"]
    mean = rows[0].index("mean glucosemg/dL")
    clean, occluded = runs[1].metrics["mean_glucose"], runs[0].metrics["mean_glucose"]
    assert rows[1][mean] == f"{clean:.1f}"
    assert rows[2][mean] == f"{occluded:.1f} (+{occluded - clean:.1f})"
    assert {link[1:] for link in shown.links} <= set(shown.ids)
    assert len(shown.ids) == len(set(shown.ids))


def test_strategies_are_compared_and_seeds_are_not(folders: Path, tmp_path: Path) -> None:
    for name, how in (("seed", {"seed": 2}), ("strategy", {"strategy": "nma"})):
        bench.run(**{"strategy": "s2", "hours": 6, "out": tmp_path / name} | how)
    assert "#compared" not in rendered(load(folders / "clean"), load(tmp_path / "seed")).links
    shown = rendered(load(folders / "clean"), load(tmp_path / "strategy"))
    (rows,) = shown.captions["adult#001, validation-14d, seed 1, 72 steps"]
    assert [row[1] for row in rows[1:]] == ["s2", "nma"]


def test_runs_are_compared_by_the_hashes_of_their_parameters(folders: Path) -> None:
    """Not by names alone: a file of patients may have changed between two runs."""
    clean, dropped = load(folders / "clean"), load(folders / "dropped")

    def with_other(name: str) -> Evidence:
        parameters = {**dropped.info.parameters, name: "0" * 64}
        return replace(dropped, info=dropped.info.model_copy(update={"parameters": parameters}))

    assert "#compared" not in rendered(clean, with_other("patient_sha256")).links
    assert "#compared" in rendered(clean, with_other("calibration_sha256")).links  # it follows from the strategy


def test_headings_are_in_order(folders: Path) -> None:
    levels = [level for level, _ in rendered(load(folders / "clean"), load(folders / "dropped")).headings]
    assert levels[0] == 1
    assert levels.count(1) == 1
    assert all(after - before <= 1 for before, after in itertools.pairwise(levels))


@pytest.mark.nightly
def test_the_same_folders_give_the_same_bytes(folders: Path) -> None:
    texts = [page.render(page.collect([folders / "clean", folders / "dropped"])) for _ in range(2)]
    assert texts[0] == texts[1]


# ---- requirements


def test_requirements_and_their_results(folders: Path, tmp_path: Path) -> None:
    result = conformance.load(results(tmp_path))
    shown = rendered(load(folders / "clean"), results=[result])
    rows = {row[0]: row for row in shown.table("", "requirement", "hazards")}
    assert list(rows) == [
        "Sensor input",
        "SEN-01",
        "SEN-04",
        "E2E and sequence",
        "E2E-01",
        "Start-up and self test",
        "STA-02",
    ]
    assert rows["SEN-01"][1].startswith("A sample may raise insulin above the schedule only at age 0..3")
    assert rows["SEN-01"][2] == "H3 H4"
    assert rows["SEN-01"][4].startswith("Samples come with their age growing")
    assert rows["SEN-01"][5] == "✓ passed"
    assert rows["STA-02"][5].startswith("tested elsewhere")
    assert "report.json: 3 passed, 1 tested elsewhere; 4 of 90 requirements were asked about" in shown.text
    assert "asked about; it is of the firmware and bench of run 1" in shown.text
    assert result.sha256 in shown.text
    controls = {row[0]: row[-1] for row in shown.table("", "hazard")}
    assert "✓ SEN-01" in controls["H3"]
    assert "– STA-02" in controls["H7"]


def test_a_failed_requirement_is_red(folders: Path, tmp_path: Path) -> None:
    high = Changed(lambda name, values: values | {"GlucoseConc": 2500} if name == "CGM_Reading" else values)
    good, bad = results(tmp_path), results(tmp_path, high, "bad.json")
    edit(good, lambda result: result["requirements"].pop(0))
    material = page.collect([folders / "clean"], [good, bad])
    assert [name for name, _ in material.at(Level.BAD)] == ["bad.json"]
    shown = Page(page.render(material))
    assert {"SEN-01", "SEN-04"} < {link[1:] for link in shown.links} <= set(shown.ids)
    assert len(shown.ids) == len(set(shown.ids))
    failed = [row for rows in shown.tables for row in rows if row[0] == "SEN-04" and len(row) == 6]
    assert [row[5].split(":")[0] for row in failed] == ["✓ passed", "✗ failed"]
    assert "expected" in failed[1][5]
    assert "✗ SEN-04" in {row[0]: row[-1] for row in shown.table("", "hazard")}["H3"]


@pytest.mark.parametrize(
    ("about", "text"),
    [
        ({"firmware_sha256": {"firmware": "0" * 64}}, "; it is of another firmware or another bench than run 1"),
        ({"dbc_crc32": "0badcafe"}, "; it is of another firmware or another bench than run 1"),
        ({"firmware_sha256": {}}, "; it may be of another firmware than run 1: there are no hashes to compare"),
    ],
)
def test_a_result_of_another_firmware_is_told_apart(
    folders: Path, tmp_path: Path, about: dict[str, Any], text: str
) -> None:
    result = conformance.load(results(tmp_path, **about))
    assert text in rendered(load(folders / "clean"), results=[result]).text


def test_without_results_requirements_are_only_named(folders: Path) -> None:
    shown = rendered(load(folders / "clean"))
    controls = {row[0]: row[-1] for row in shown.table("", "hazard")}
    assert "SEN-01" in controls["H3"]
    assert not set(shown.text) & {"✗"}
    assert "give the result of `pumpbench conformance`" in shown.text


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", r"bad\.json:1: not YAML"),
        ("[]", r"bad\.json:1: top level: expected a mapping"),
        ('{"pumpbench": "0.1.0"}', r"bad\.json:1: protocol: this key is missing"),
    ],
)
def test_a_file_that_is_no_result(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "bad.json").write_text(text)
    with pytest.raises(FileError, match=message):
        conformance.load(tmp_path / "bad.json")


def test_a_result_that_contradicts_itself_is_refused(tmp_path: Path) -> None:
    file = results(tmp_path)
    edit(file, lambda result: result["requirements"][0].update(verdict="failed"))
    with pytest.raises(FileError, match=r"report\.json: holds is true, but the verdicts say otherwise"):
        conformance.load(file)


# ---- texts of others


EVIL = '<script>alert("x")</script><img src=x onerror=alert(1)>'


def test_names_are_text(folders: Path, tmp_path: Path) -> None:
    whole = RunFolder.load(folders / "clean")
    info = {**whole.info, "patient": EVIL, "firmware": EVIL, "scenario": EVIL, "packages": {EVIL: EVIL}}
    info["faults"] = [{"kind": EVIL, "message": EVIL}]
    bench.Outcome.of(whole.frames, info).write(tmp_path / EVIL.replace("/", "_"))
    file = results(tmp_path, firmware=EVIL)
    edit(file, lambda result: result["requirements"][0].update(text=EVIL, requirement=EVIL, group=EVIL))
    text = page.render(page.collect([tmp_path / EVIL.replace("/", "_"), tmp_path / EVIL], [file], keep_going=True))
    shown = Page(text)
    assert "script" not in shown.tags
    assert all(str(image["src"]).startswith("data:") for image in shown.images)
    assert shown.text.count(EVIL) > 8


# ---- the command


def test_the_command_writes_the_page_whole_or_not_at_all(pumpbench: Pumpbench, folders: Path, runs: Path) -> None:
    done = pumpbench(
        "report", folders / "clean", folders / "dropped", "--conformance", results(runs), "--out", "a/b.html"
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == "report: a/b.html\n"
    assert Page((runs / "a" / "b.html").read_text(encoding="utf-8")).headings[0] == (1, "Evidence from the bench")
    assert [path.name for path in (runs / "a").iterdir()] == ["b.html"]
    done = pumpbench("report", folders / "clean", folders / "missing")
    assert done.returncode == 2
    assert done.stderr == f"pumpbench: there is no run folder {folders / 'missing'}\n"
    assert not (runs / "report.html").exists()
    done = pumpbench("report", folders / "clean", "--out", folders)
    assert done.returncode == 2
    assert done.stderr == f"pumpbench: {folders} is a folder; give the name of the page to write\n"


def test_red_is_exit_status_1_and_the_page_is_there(
    pumpbench: Pumpbench, folders: Path, harmful: Path, runs: Path
) -> None:
    done = pumpbench("report", folders / "clean", harmful)
    assert done.returncode == 1
    assert done.stderr.startswith(f"pumpbench: {harmful}: hazards counted: H2 × 2")
    assert (runs / "report.html").exists()
    done = pumpbench("report", folders / "clean", "unfinished", "--keep-going", "--out", "going.html")
    assert done.returncode == 1
    assert done.stderr == "pumpbench: left out: there is no run folder unfinished\n"
    assert "left out: there is no run folder unfinished" in (runs / "going.html").read_text(encoding="utf-8")
