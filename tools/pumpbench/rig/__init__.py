"""The rig: starts the nodes of one run, joins them, and sees that they all end.

    prepared = rig.prepare(rig.Request("adult#001", Path("runs/mine")))
    folder = rig.execute(prepared)

`hub`, a URL or a python-can interface: firmware and recorder are processes of their own (`on_bus`). `inproc`: the same
nodes in this process, the same frames, no wake-ups (`in_process`).
"""

from pathlib import Path

from pumpbench.capture import Capture
from pumpbench.recorder.writing import write
from pumpbench.rig.in_process import Wires, simulate, wires
from pumpbench.rig.on_bus import firmware_command, run_on_bus
from pumpbench.rig.processes import Child, NodeDied, one_cpu
from pumpbench.rig.request import (
    Change,
    Prepared,
    Progress,
    Request,
    RigError,
    prepare,
    unseen,
    variability_sources,
)
from pumpbench.runfolder import RunFolder

__all__ = [
    "Change",
    "Child",
    "NodeDied",
    "Prepared",
    "Request",
    "RigError",
    "Wires",
    "execute",
    "firmware_command",
    "one_cpu",
    "prepare",
    "simulate",
    "variability_sources",
    "wires",
]


def execute(prepared: Prepared, progress: Progress = unseen) -> Path:
    """Do the run and write its run folder; returns the folder.

    Raises:
        NodeDied, MemberSilent, PlantError, BusLost: the run did not come to its end. No process of it is left.
        RunFolderError, OSError: the folder could not be written.
    """
    request = prepared.request
    folder = RunFolder.create(request.out, overwrite=request.overwrite)
    try:
        if request.bus == "inproc":
            capture = Capture()
            simulate(prepared, capture, progress)
            write(folder, capture, prepared.info, complete=True, origin=request.origin)
        else:
            run_on_bus(prepared, progress)
    finally:
        if folder.partial.is_dir() and not any(folder.partial.iterdir()):
            folder.discard()
    return request.out
