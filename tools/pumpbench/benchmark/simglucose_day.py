"""One simulated day of simglucose, alone: run by the Python of simglucose's own environment, never by ours.

Reads {"patient", "carbs_g", "insulin_u"} as JSON, one entry per minute of the day; writes {"seconds", "state",
"plasma", "subcutaneous"}: the time of the steps alone, the initial state, and glucose (mg/dL) each 5 min from minute 0.
"""

import json
import sys
import time

from simglucose.patient.t1dpatient import Action, T1DPatient  # type: ignore[import-not-found]

EACH_MINUTES = 5


def main() -> None:
    """Do the day."""
    asked = json.load(sys.stdin)
    patient = T1DPatient.withName(asked["patient"])
    actions = [
        Action(CHO=carbs, insulin=insulin) for carbs, insulin in zip(asked["carbs_g"], asked["insulin_u"], strict=True)
    ]
    states = [[float(value) for value in patient.state]]
    seconds = 0.0
    for first in range(0, len(actions), EACH_MINUTES):
        started = time.perf_counter()
        for action in actions[first : first + EACH_MINUTES]:
            patient.step(action)
        seconds += time.perf_counter() - started
        states.append([float(value) for value in patient.state])
    volume = float(patient._params.Vg)
    answer = {
        "seconds": seconds,
        "state": states[0],
        "plasma": [state[3] / volume for state in states],
        "subcutaneous": [state[12] / volume for state in states],
    }
    json.dump(answer, sys.stdout)


if __name__ == "__main__":
    main()
