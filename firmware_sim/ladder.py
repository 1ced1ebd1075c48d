"""The fallback ladder Auto -> Degraded -> SafeBasal, with Suspended and DeliveryUncertain beside it.

Down at once, up one rung per step and only after two usable samples in a row (requirements FAL-01 to FAL-05). The
ladder decides how much the control law may do, never how much it doses.
"""

import enum

AGE_DEGRADED = 4
"""Steps: from this age of the newest usable CGM sample on, at most the schedule."""

AGE_SAFE_BASAL = 7
"""Steps: from this age on, exactly the schedule and no pramlintide."""

SAMPLES_UP = 2

PUMP_SILENT = 3
"""Steps without a status or totals of the pump (more than 11 min) after which delivery is uncertain."""


class State(enum.IntEnum):
    """CTRL_Status.CtrlState."""

    INIT = 0
    AUTO = 1
    DEGRADED = 2
    SAFE_BASAL = 3
    SUSPENDED = 4
    FAULT = 5
    DELIVERY_UNCERTAIN = 6


class Ladder:
    """Where the firmware stands on the ladder."""

    def __init__(self) -> None:
        self.state = State.INIT
        self._rung = State.SAFE_BASAL  # what the CGM alone allows, remembered under Suspended and the like

    @property
    def rung(self) -> State:
        """What the CGM alone allows: AUTO, DEGRADED or SAFE_BASAL, whatever stands above it."""
        return self._rung

    def update(
        self,
        *,
        calibrated: bool,
        suspended: bool,
        age: int,
        streak: int,
        pump_age: int,
        uncertain: bool = False,
        held: bool = False,
        sensor_silent: bool = False,
        fault: bool = False,
        age_degraded: int = AGE_DEGRADED,
    ) -> State:
        """One step.

        Args:
            calibrated: a complete, checked calibration is active.
            suspended: the user has suspended delivery.
            age: steps since the newest usable CGM sample was taken.
            streak: steps in a row with a usable sample, this one included.
            pump_age: steps since all that the pump says in every step was heard.
            uncertain: a bolus may or may not have been delivered.
            held: nothing but the schedule until the user resumes (too many resets).
            sensor_silent: the sensor's heartbeats have ceased: at most the schedule, however good its samples look.
            fault: the device has found a fault in itself: nothing is commanded, until it restarts.
            age_degraded: age from which on at most the schedule is given; can only be tightened.
        """
        best = State.DEGRADED if sensor_silent or age >= min(age_degraded, AGE_DEGRADED) else State.AUTO
        self._rung = State.SAFE_BASAL if held else self._next_rung(age, streak, best)
        if fault:
            self.state = State.FAULT
        elif not calibrated:
            self.state = State.INIT
        elif suspended:
            self.state = State.SUSPENDED
        elif pump_age >= PUMP_SILENT or uncertain:
            self.state = State.DELIVERY_UNCERTAIN
        elif held:
            self.state = State.SAFE_BASAL
        elif self.state == State.INIT and streak < SAMPLES_UP and age < AGE_SAFE_BASAL:
            self.state = State.INIT
        elif self.state == State.INIT and streak >= SAMPLES_UP:
            self._rung = best  # the first samples of a run are not a way back up
            self.state = best
        else:
            self.state = self._rung
        return self.state

    def doubt(self) -> None:
        """A bolus turned out uncertain after `update`, for no answer came to its last try: in force at once."""
        if self.state in (State.AUTO, State.DEGRADED, State.SAFE_BASAL):
            self.state = State.DELIVERY_UNCERTAIN

    def _next_rung(self, age: int, streak: int, best: State) -> State:
        if age >= AGE_SAFE_BASAL:
            return State.SAFE_BASAL
        if best >= self._rung:
            return best
        if streak >= SAMPLES_UP:
            return State(self._rung - 1)
        return self._rung
