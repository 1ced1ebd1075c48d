"""What varies, which equations, which pramlintide: from the command line into the plant and into run.json."""

import json
from pathlib import Path

import pytest
from conftest import Pumpbench
from pumpbench import rig

from plant_server.physiology import SOURCES, PatientError, load_patient
from plant_server.physiology import parameters as par

SHORT = 24  # steps


def request(out: Path, **changes: object) -> rig.Request:
    return rig.Request(**{"patient": "adult#001", "out": out, "steps": SHORT, "bus": "inproc"} | changes)


@pytest.mark.parametrize(
    ("text", "sources"),
    [
        ("all", tuple(SOURCES)),
        ("none", ()),
        ("f", ("f",)),
        ("circadian, k_abs", ("k_abs", "circadian")),
        ("k_abs,f,insulin_pk,circadian,f", tuple(SOURCES)),
    ],
)
def test_what_varies_is_a_word_or_a_list(text: str, sources: tuple[str, ...]) -> None:
    assert rig.variability_sources(text) == sources


@pytest.mark.parametrize("text", ["", "kabs", "f,", "f,none", "all,f", "ALL", "f k_abs"])
def test_what_cannot_vary_is_told_what_can(text: str) -> None:
    with pytest.raises(rig.RigError, match="choose all, none, or a comma list of k_abs, f, insulin_pk, circadian"):
        rig.variability_sources(text)


def test_the_plant_gets_what_was_asked_for(tmp_path: Path) -> None:
    usual = rig.prepare(request(tmp_path))
    assert usual.run.variability == tuple(SOURCES)
    assert usual.info["variability"] == list(SOURCES)
    assert (usual.info["physiology"], usual.info["pramlintide"]) == ("S2008", "P2")

    changed = rig.prepare(request(tmp_path, physiology="S2013", pramlintide="P4+type1", variability=("f",)))
    assert changed.run.variability == ("f",)
    assert changed.run.patient.params.tobytes() == (
        load_patient("adult#001", physiology="S2013", pramlintide="P4+type1").params.tobytes()
    )
    assert changed.run.patient.params[par.S2013] == 1.0
    assert changed.info["variability"] == ["f"]
    assert (changed.info["physiology"], changed.info["pramlintide"]) == ("S2013", "P4+type1")
    assert changed.info["parameters"]["patient_sha256"] != usual.info["parameters"]["patient_sha256"]

    with pytest.raises(rig.RigError, match="'weather'"):
        rig.prepare(request(tmp_path, variability=("weather",)))
    with pytest.raises(PatientError, match="S2008, S2013"):
        rig.prepare(request(tmp_path, physiology="S2017"))
    with pytest.raises(PatientError, match="P2, P4, moderate, conservative, strong"):
        rig.prepare(request(tmp_path, pramlintide="weak"))


def test_each_option_changes_the_run_and_its_absence_does_not(tmp_path: Path) -> None:
    def trace(name: str, **changes: object) -> str:
        folder = rig.execute(rig.prepare(request(tmp_path / name, strategy="s2", steps=144, **changes)))
        found: str = json.loads((folder / "run.json").read_text())["trace_sha256"]
        return found

    default = trace("default")
    assert trace("spelt-out", physiology="S2008", pramlintide="P2", variability=tuple(SOURCES)) == default
    others = [
        trace("steady", variability=()),
        trace("f", variability=("f",)),
        trace("circadian", variability=("circadian",)),
        trace("pramlintide", pramlintide="moderate"),
        trace("s2013", physiology="S2013"),
    ]
    assert len({default, *others}) == 6


def test_on_the_command_line(pumpbench: Pumpbench, runs: Path) -> None:
    options = ("--variability", "circadian,f", "--physiology", "S2013", "--pramlintide", "strong+type1")
    done = pumpbench("run", "--days", "0.05", "--bus", "inproc", *options, "--out", runs / "run")
    assert done.returncode == 0, done.stderr
    info = json.loads((runs / "run" / "run.json").read_text())
    assert info["variability"] == ["f", "circadian"]
    assert (info["physiology"], info["pramlintide"]) == ("S2013", "strong+type1")


@pytest.mark.parametrize(
    ("option", "value", "words"),
    [
        ("--variability", "kabs,f", ["'kabs'", "k_abs, f, insulin_pk, circadian"]),
        ("--physiology", "S2017", ["'S2017'", "S2008, S2013"]),
        ("--pramlintide", "P3", ["'P3'", "P2, P4, moderate, conservative, strong"]),
    ],
)
def test_a_wrong_name_is_a_usage_error(
    pumpbench: Pumpbench, runs: Path, option: str, value: str, words: list[str]
) -> None:
    done = pumpbench("run", "--bus", "inproc", option, value, "--out", runs / "run")
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert all(word in done.stderr for word in words)
    assert not (runs / "run").exists()


def test_a_patient_of_an_own_file_is_not_given_somebody_elses_controller(pumpbench: Pumpbench, runs: Path) -> None:
    from plant_server.physiology import patients

    own = runs / "own.csv"
    own.write_text(Path(patients.__file__).with_name("data").joinpath("adults.csv").read_text())
    done = pumpbench("run", "--patient", f"{own}#adult#001", "--bus", "inproc", "--out", runs / "out")
    assert done.returncode == 2
    assert "pumpbench identify-controller" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


@pytest.mark.nightly
def test_patients_of_an_own_file_run_with_models_identified_from_them(pumpbench: Pumpbench, runs: Path) -> None:
    """A cohort of two, whose time constants differ from those of the ten: from the file to the closed loop."""
    from plant_server.physiology import patients

    shipped = Path(patients.__file__).with_name("data").joinpath("adults.csv").read_text()
    lines = [line for line in shipped.splitlines() if not line.startswith("#")]
    own, models = runs / "own.csv", runs / "models.csv"
    own.write_text("\n".join([lines[0], lines[3], lines[7]]) + "\n")
    done = pumpbench("identify-controller", own, "--out", models)
    assert done.returncode == 0, done.stderr
    assert [line.split()[0] for line in done.stdout.splitlines()] == ["patient", "adult#003", "adult#007"]
    again = pumpbench("identify-controller", own, "--out", models)
    assert again.returncode == 2 and "--overwrite" in again.stderr
    arguments = ("--controller", models, "--days", "0.5", "--bus", "inproc", "--out", runs / "out")
    done = pumpbench("run", "--patient", own, *arguments)
    assert done.returncode == 0, done.stderr
    info = json.loads((runs / "out" / f"{own}-adult-003".replace("/", "_") / "run.json").read_text())
    assert info["patient"] == f"{own}#adult#003"
    wrong = pumpbench("run", "--patient", "adult#001", *arguments)
    assert wrong.returncode == 2
    assert "no model of patient 'adult#001'; it has adult#003, adult#007" in wrong.stderr
