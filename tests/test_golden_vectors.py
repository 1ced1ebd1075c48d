"""The golden vectors: the firmware still answers every recorded frame as recorded, and a difference is named."""

import importlib.util
import shutil
from pathlib import Path
from types import ModuleType

import can
import pytest
from pumpbench.calibration import MODES

ROOT = Path(__file__).resolve().parents[1]
VECTORS = ROOT / "examples" / "golden_vectors"


@pytest.fixture(scope="module")
def tool() -> ModuleType:
    spec = importlib.util.spec_from_file_location("golden_vectors", ROOT / "tools" / "golden_vectors.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_firmware_answers_as_recorded(tool: ModuleType) -> None:
    """If a change of the firmware is meant: `python tools/golden_vectors.py --write examples/golden_vectors`."""
    assert sorted(path.stem for path in VECTORS.glob("*.log")) == sorted(MODES)
    assert tool.main(["--check", str(VECTORS)]) == 0


def test_the_files_are_candump_logs_of_a_day(tool: ModuleType) -> None:
    for mode in MODES:
        frames = list(can.CanutilsLogReader(VECTORS / f"{mode}.log"))
        assert len(frames) > 288 * 15
        assert {frame.is_rx for frame in frames} == {True, False}
        assert 0x600 not in {frame.arbitration_id for frame in frames}


def test_boluses_and_pramlintide_are_in_the_vectors_of_the_modes_that_have_them(tool: ModuleType) -> None:
    with_bolus = {mode for mode in MODES if " can0 201#" in (VECTORS / f"{mode}.log").read_text(encoding="ascii")}
    assert {"ma", "sma", "s3", "s4"} <= with_bolus <= {"ma", "sma", "s1", "s3", "s4"}


@pytest.mark.parametrize(("direction", "message"), [("T", "expected 200#"), ("R", "the firmware")])
def test_one_changed_frame_is_found(
    tool: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str], direction: str, message: str
) -> None:
    shutil.copytree(VECTORS, tmp_path / "v")
    path = tmp_path / "v" / "s2.log"
    lines = path.read_text(encoding="ascii").splitlines()
    wanted = " 200#" if direction == "T" else " 100#"
    number = next(i for i, line in enumerate(lines) if wanted in line and i > 2000)
    lines[number] = lines[number][:-3] + ("0" if lines[number][-3] != "0" else "1") + lines[number][-2:]
    path.write_text("\n".join(lines) + "\n", encoding="ascii")
    assert tool.main(["--check", str(tmp_path / "v")]) == 1
    assert message in capsys.readouterr().out


@pytest.mark.parametrize(
    "line", ["", "(0.0) can0 123", "(0.0) can0 XYZ#00 R", "(0.0) can0 123#00 Q", "(0.0) can0 123#0 R"]
)
def test_a_broken_file_is_named_with_its_line(
    tool: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str], line: str
) -> None:
    shutil.copytree(VECTORS, tmp_path / "v")
    (tmp_path / "v" / "nma.log").write_text(f"{line}\n", encoding="ascii")
    assert tool.main(["--check", str(tmp_path / "v")]) == 2
    assert "nma.log:1: expected '(time) can0 ID#DATA R'" in capsys.readouterr().err


def test_a_missing_file_is_an_error(tool: ModuleType, tmp_path: Path) -> None:
    assert tool.main(["--check", str(tmp_path)]) == 2
