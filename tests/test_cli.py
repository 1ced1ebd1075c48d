"""The command line as a whole: its commands, how it starts, how it ends."""

import importlib
import re
import subprocess
import sys

from conftest import ROOT
from pumpbench.calibration import MODES
from pumpbench.cli import COMMANDS, NODES
from pumpbench.cli.options import Strategy
from pumpbench.cli.statuses import STATUS_OF


def test_the_page_lists_every_command() -> None:
    page = (ROOT / "docs" / "design.md").read_text(encoding="utf-8")
    listed = re.search(r"`pumpbench (.+?)`", page.split("## Commands and exit status")[1], re.DOTALL)
    assert listed is not None
    commands = [command.__name__.replace("_", "-") for command in (*COMMANDS, *NODES)]
    assert sorted(listed[1].split()[::2]) == sorted(commands)
    assert set(listed[1].split()[1::2]) == {"|"}


def test_help_waits_for_no_library_that_it_does_not_need() -> None:
    """A run needs seconds to import what it works with; who asks for help does not."""
    code = "import sys, pumpbench.cli; print(*sorted({name.split('.')[0] for name in sys.modules}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    heavy = {
        "can",
        "can_bus",
        "cantools",
        "matplotlib",
        "numba",
        "numpy",
        "plant_server",
        "pyarrow",
        "pydantic",
        "rerun",
    }
    assert heavy & set(done.stdout.split()) == set()


def test_the_modes_to_choose_of_are_those_that_can_be_calibrated() -> None:
    """They are written twice, for calibration takes long to import; a case of a hunt depends on their order."""
    assert list(Strategy) == list(MODES)


def test_every_error_with_an_exit_status_is_a_class_there_is() -> None:
    """They are named, not imported: a class that moves must not end in a traceback."""
    for name in STATUS_OF:
        module, _, kind = name.rpartition(".")
        assert issubclass(getattr(importlib.import_module(module), kind), Exception), name
