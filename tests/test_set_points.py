"""CMD-09: a pump that does not show the last set-point for two steps is told of; a new one goes out in every step."""

import pytest
from pumpbench import bench as bench_api
from pumpbench import faults
from pumpbench.bench import Outcome

from can_bus import codec
from can_bus.codec import MAX_LOST
from can_bus.lockstep import STEP_SECONDS
from firmware_sim.pump import Op

FIRST = 24
"""Step of the first set-point that is lost: 02:00."""

BASAL_CMD = codec.message("PUMP_BasalCmd")


def without_set_points(count: int) -> Outcome:
    lost = faults.drop("PUMP_BasalCmd", start="02:00", count=count)
    outcome = bench_api.run(strategy="s2", hours=5, faults=[lost])
    outcome.assert_no_hazards()
    return outcome


@pytest.mark.parametrize("count", [1, 2, 3, 6])
def test_the_alarm_comes_with_the_second_step_and_not_with_the_first(count: int) -> None:
    """Lost in step 24, missed in PUMP_Status of 25 and 26."""
    outcome = without_set_points(count)
    told = [event for event in outcome.alarms if (event.node, event.code) == ("CTRL", "DeliveryUncertain")]
    if count == 1:
        assert told == []
        return
    assert (told[0].time_s // STEP_SECONDS, told[0].state, told[0].priority) == (FIRST + 2, "Pending", "High")
    # with three the pump has run its schedule meanwhile: it gave something else than was asked for, which stays told
    assert (told[-1].state == "Inactive") == (count == 2)


@pytest.mark.parametrize("count", [1, 2, 3, 6])
def test_a_new_set_point_is_sent_in_every_step(count: int) -> None:
    outcome = without_set_points(count)
    sent = [BASAL_CMD.unpack(frame.data) for frame in outcome.frames.frames(0) if frame.can_id == BASAL_CMD.can_id]
    assert [values["BasalCmdSeq"] for values in sent] == list(range(60))
    assert {values["BasalOp"] for values in sent[FIRST : FIRST + 12]} == {Op.SET_RATE}
    missed = count + (count > MAX_LOST)  # the pump refuses the next one, too, when the counter has jumped
    shown = [int(number) for number in outcome.trace.get("PumpLastBasalSeq")[FIRST + 1 : FIRST + missed + 3]]
    assert shown == [FIRST - 1] * missed + [FIRST + missed, FIRST + missed + 1]  # the first to get through is in force
