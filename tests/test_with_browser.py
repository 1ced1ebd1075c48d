"""tools/with_browser: a command gets a Chromium that runs and a Vulkan driver that draws, or hears what is missing."""

import os
import subprocess
from pathlib import Path

import pytest
from conftest import ROOT

WITH_BROWSER = ROOT / "tools" / "with_browser"
NOT_TO_BE_HAD = 125


@pytest.mark.parametrize(
    ("arguments", "bare", "text"),
    [
        ([], False, "usage"),
        (["--what"], False, "usage"),
        (["true"], True, "no apt-get to fetch chromium"),
    ],
)
def test_it_says_what_is_missing(arguments: list[str], bare: bool, text: str, tmp_path: Path) -> None:
    done = subprocess.run(
        ["/bin/bash", WITH_BROWSER, *arguments],
        env={"PATH": str(tmp_path), "HOME": str(tmp_path)} if bare else None,
        capture_output=True,
        text=True,
        timeout=20,
        check=False,
    )
    assert done.returncode == NOT_TO_BE_HAD
    assert text in done.stderr


def test_the_command_gets_a_browser_and_a_driver() -> None:
    script = '"$PUMPBENCH_BROWSER" --version; exit 7'
    done = subprocess.run(
        [WITH_BROWSER, "--", "sh", "-c", script], capture_output=True, text=True, timeout=280, check=False
    )
    if done.returncode == NOT_TO_BE_HAD and not os.environ.get("CI"):
        pytest.skip(done.stderr.strip())
    assert done.returncode == 7, done.stderr
    assert "Chrom" in done.stdout
