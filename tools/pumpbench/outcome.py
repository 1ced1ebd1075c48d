"""What came of a run: the content of metrics.json, from the recorded frames alone."""

from typing import TYPE_CHECKING, Any

import numpy as np

from can_bus.lockstep import STEPS_PER_DAY
from plant_server.mechanism import INSULIN_STROKE_U, PRAMLINTIDE_STROKE_UG
from plant_server.metrics import glycaemic
from pumpbench.hazards import Monitor

if TYPE_CHECKING:
    from pumpbench.frames import Frames
    from pumpbench.trace import Trace


def _last(column: Any) -> float:
    known = column[np.isfinite(column)]
    return float(known[-1]) if known.size else 0.0


def _ledger(trace: "Trace", drug: str, total: str, stroke: float) -> dict[str, Any]:
    delivered = round(_last(trace.get(total)) / stroke)
    commanded, pending, lost = (
        round(_last(trace.get(f"Truth{drug}{what}"))) for what in ("Commanded", "Pending", "Lost")
    )
    return {
        "commanded": commanded,
        "delivered": delivered,
        "pending": pending,
        "lost": lost,
        "closes": (commanded - delivered - pending - lost) % 65536 == 0,
    }


def measure(trace: "Trace", frames: "Frames") -> dict[str, Any]:
    """The content of metrics.json.

    Args:
        trace: of the run, one row per sampling instant; the final instant is no sample of its own.
        frames: of the run; hazards are judged on the device's bus, the ledger on the pump's.

    Returns:
        Outcome metrics (percent of samples, U and ug per day) and, under `safety`, counters, ledger and hazards.
        Without a single full step the outcome metrics are None. In a free run no hazard is judged (None each): who may
        say what, and of which sample it knows, follows from the turns, which there are none of.
    """
    glucose = trace.get("TruthGlucose")[:-1]
    glucose = glucose[np.isfinite(glucose)]
    days = max(len(trace) - 1, 0) / STEPS_PER_DAY
    outcome: dict[str, Any] = {}
    if glucose.size:
        outcome |= glycaemic(glucose)
        outcome["insulin_u_per_day"] = _last(trace.get("InsulinTotal")) / days
        outcome["pramlintide_ug_per_day"] = _last(trace.get("PramTotal")) / days
    monitor = Monitor()
    monitor.watch(frames.frames(0), frames.frames(1) if (frames.channel == 1).any() else None)
    ledger = {
        "insulin": _ledger(trace, "Insulin", "InsulinTotal", INSULIN_STROKE_U),
        "pramlintide": _ledger(trace, "Pram", "PramTotal", PRAMLINTIDE_STROKE_UG),
    }
    safety = monitor.safety(ledger) | {
        "faults_injected": len(trace.faults),
        "alarms": len({(event.node, event.instance, event.code) for event in trace.alarms}),
    }
    if trace.info.get("free_running"):
        safety |= {"hazards": dict.fromkeys(safety["hazards"]), "first_hazards": []}
    return outcome | {"safety": safety}
