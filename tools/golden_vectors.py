"""Golden vectors: what the reference controller commands, in plain files that any implementation can run against.

    python tools/golden_vectors.py --write DIR     write one file per mode
    python tools/golden_vectors.py --check DIR     run the firmware against files written before; 1 if one frame differs

A file is a log in candump format, `(time) can0 ID#DATA R` towards the device and `T` from it, from the calibration to
the end of one day of the validation scenario: what stands between two SYNC_Step is one turn. Feed the R frames to an
implementation and compare what it sends with the T frames, byte by byte; only ExecTime of SYNC_Done, and with it that
frame's CHECKSUM, is every implementation's own. `python-can`'s CanutilsLogReader reads it.
"""

import argparse
import sys
from collections import deque
from pathlib import Path

from pumpbench.calibration import MODES, calibrate, tuning_for

from can_bus.codec import message
from can_bus.frame import Frame
from can_bus.lockstep import STEP_SECONDS, STEPS_PER_DAY
from firmware_sim.firmware import Firmware
from plant_server.physiology import load_patient
from plant_server.scenario import load_scenario
from plant_server.server import PlantServer, Run

PATIENT, SEED = "adult#001", 1
TO_DEVICE, FROM_DEVICE = "R", "T"
UNHEARD = frozenset(message(name).can_id for name in ("PLANT_Truth", "FAULT_Inject"))
"""What a device must not react to is no part of a vector."""

FRAME_SECONDS = 0.00025


def record(mode: str) -> list[str]:
    """The lines of one mode's day."""
    patient = load_patient(PATIENT)
    run = Run(
        patient,
        load_scenario("validation-14d"),
        STEPS_PER_DAY,
        SEED,
        MODES[mode],
        calibrate(patient, tuning_for(mode)),
    )
    plant, firmware = PlantServer(run), Firmware()
    lines: list[str] = []
    answers: list[Frame] = []
    for frame in plant.call_roll():
        answers += firmware.receive(frame)  # the roll call is no part of the record
    queue: deque[Frame] = deque()
    for answer in answers:
        queue += plant.receive(answer)
    place = 0
    while queue:
        batch = list(queue)
        queue.clear()
        answers = []
        for frame in batch:
            if frame.can_id not in UNHEARD:
                lines.append(line(plant.step, place, frame, TO_DEVICE))
                place += 1
            answers += firmware.receive(frame)
        before = plant.step
        for frame in answers:
            lines.append(line(before, place, frame, FROM_DEVICE))
            place += 1
            queue += plant.receive(frame)
        place = 0 if plant.step != before else place
    return lines


def line(step: int, place: int, frame: Frame, direction: str) -> str:
    """One line of candump's log format, simulated time."""
    time = step * STEP_SECONDS + place * FRAME_SECONDS
    return f"({time:.6f}) can0 {frame.can_id:03X}#{frame.data.hex().upper()} {direction}"


def parse(text: str, where: str) -> tuple[Frame, str]:
    """A frame and its direction.

    Raises:
        ValueError: the line is none of such a file; the text names it.
    """
    try:
        _, _, body, direction = text.split()
        can_id, _, data = body.partition("#")
        if direction not in (TO_DEVICE, FROM_DEVICE):
            raise ValueError
        return Frame(int(can_id, 16), bytes.fromhex(data)), direction
    except ValueError:
        raise ValueError(f"{where}: expected '(time) can0 ID#DATA R' or T, found {text!r}") from None


def replay(path: Path) -> str | None:
    """Feed a file to a new firmware.

    Returns:
        The first difference in words, None if there is none.

    Raises:
        ValueError: the file is no vector.
    """
    firmware = Firmware()
    answers: deque[Frame] = deque()
    for number, text in enumerate(path.read_text(encoding="ascii").splitlines(), 1):
        where = f"{path.name}:{number}"
        frame, direction = parse(text, where)
        if direction == TO_DEVICE:
            if answers:
                return f"{where}: the firmware also sends {answers[0].can_id:03X}#{answers[0].data.hex().upper()}"
            answers += firmware.receive(frame)
            continue
        found = answers.popleft() if answers else None
        if found != frame:
            shown = "nothing" if found is None else f"{found.can_id:03X}#{found.data.hex().upper()}"
            return f"{where}: expected {text.split()[2]}, the firmware sends {shown}"
    return None if not answers else f"{path.name}: the firmware sends more than the file has"


def main(arguments: list[str] | None = None) -> int:
    """Command line; 0 done, 1 a frame differs, 2 wrong usage or file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--write", type=Path, metavar="DIR")
    what.add_argument("--check", type=Path, metavar="DIR")
    options = parser.parse_args(arguments)
    if options.write is not None:
        options.write.mkdir(parents=True, exist_ok=True)
        for mode in MODES:
            (options.write / f"{mode}.log").write_text("\n".join(record(mode)) + "\n", encoding="ascii")
        return 0
    try:
        differences = [difference for mode in MODES if (difference := replay(options.check / f"{mode}.log"))]
    except (OSError, ValueError) as error:
        print(f"golden_vectors: {error}", file=sys.stderr)
        return 2
    for difference in differences:
        print(difference)
    return 1 if differences else 0


if __name__ == "__main__":
    sys.exit(main())
