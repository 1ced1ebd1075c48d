"""The exit status of the errors we know."""

from pumpbench.cli.terminal import EXIT_DEAD, EXIT_INTERRUPTED, EXIT_USAGE, Failed

STATUS_OF = {
    "can_bus.address.BusUrlError": EXIT_USAGE,
    "can_bus.codec.CodecError": EXIT_USAGE,
    "can_bus.yaml_file.FileError": EXIT_USAGE,
    "plant_server.physiology.patients.PatientError": EXIT_USAGE,
    "plant_server.scenario.ScenarioError": EXIT_USAGE,
    "plant_server.sensor.SensorError": EXIT_USAGE,
    "pumpbench.calibration.CalibrationError": EXIT_USAGE,
    "pumpbench.campaign.CampaignError": EXIT_USAGE,
    "pumpbench.checkpoint.CheckpointError": EXIT_USAGE,
    "pumpbench.closed_loop.case.CaseError": EXIT_USAGE,
    "pumpbench.comparison.record.RecordError": EXIT_USAGE,
    "pumpbench.controller_model.ControllerModelError": EXIT_USAGE,
    "pumpbench.convert.ConvertError": EXIT_USAGE,
    "pumpbench.fork.ForkError": EXIT_USAGE,
    "pumpbench.hunt.HuntError": EXIT_USAGE,
    "pumpbench.recording.tool.RecordingError": EXIT_USAGE,
    "pumpbench.replay.ReplayError": EXIT_USAGE,
    "pumpbench.rig.request.RigError": EXIT_USAGE,
    "pumpbench.runfolder.RunFolderError": EXIT_USAGE,
    "plant_server.serve.MemberSilent": EXIT_DEAD,
    "plant_server.server.PlantError": EXIT_DEAD,
    "pumpbench.campaign.ClusterError": EXIT_DEAD,
    "pumpbench.closed_loop.result.LoopError": EXIT_DEAD,
    "pumpbench.rewind.Diverged": EXIT_DEAD,
    "pumpbench.rig.processes.NodeDied": EXIT_DEAD,
    "pumpbench.runfolder.NotWritten": EXIT_DEAD,
    "can.exceptions.CanError": EXIT_DEAD,
    "builtins.OSError": EXIT_DEAD,
}
"""Exit status of the errors we know, by the class's name: an import for each would cost every error line seconds."""


class Interrupted(Exception):
    """Ctrl-C or SIGTERM."""


def status_of(error: Exception) -> int | None:
    """The exit status of an error, None for one that is our own mistake and deserves its traceback."""
    if isinstance(error, Failed):
        return error.status
    if isinstance(error, Interrupted):
        return EXIT_INTERRUPTED
    names = (f"{kind.__module__}.{kind.__qualname__}" for kind in type(error).__mro__)
    return next((STATUS_OF[name] for name in names if name in STATUS_OF), None)
