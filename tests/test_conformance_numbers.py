"""The checks of numbers: the reference passes each, and each can fail."""

from collections.abc import Callable

import pytest
from conformance_devices import Change, Changed, Values, expect_failed, expect_passed
from pumpbench.conformance.suite import select

from firmware_sim.pump import Pump


@pytest.mark.parametrize("requirement", [each.id for each in select(["NUM"])])
def test_the_reference_passes(requirement: str) -> None:
    expect_passed(requirement)


def of(message: str, field: str, change: Callable[[int], int]) -> Change:
    """A device that changes a field of what it hears or says."""

    def changed(name: str, values: Values) -> Values:
        return values | {field: change(values[field])} if name == message and field in values else values

    return changed


def test_a_rate_above_its_limit() -> None:
    device = Changed(says=of("PUMP_BasalCmd", "InsulinRate", lambda raw: raw + 1 if raw == 356 else raw))
    expect_failed("NUM-01", "at most 356 of insulin with PUMP_Alarm.PumpAlarmState", device)


def test_a_bolus_above_its_limit() -> None:
    device = Changed(says=of("PUMP_BolusCmd", "InsulinBolus", lambda raw: raw + 1))
    expect_failed("NUM-01", "a bolus of at most 300 with MEAL_Announce.MealKind", device)


def test_insulin_on_board_that_is_a_code() -> None:
    device = Changed(says=of("CTRL_Status", "InsulinOnBoard", lambda raw: 4094 if raw == 4090 else raw))
    expect_failed("NUM-01", "InsulinOnBoard of at most 4090 or SNA with PUMP_Delivered.InsulinTotal", device)


def test_a_total_that_wraps(monkeypatch: pytest.MonkeyPatch) -> None:
    totals: list[int] = []

    def delivered(self: Pump, values: Values | None, step: int, *_: int) -> int:
        if values is None:
            return -1
        self._totals_step = step
        self._confirmed_total = values["InsulinTotal"]
        totals.append(values["InsulinTotal"])
        return abs(totals[-1] - totals[-2]) if len(totals) > 1 else -1

    monkeypatch.setattr(Pump, "delivered", delivered)
    expect_failed("NUM-01", "no insulin on board at the end of the pump's total")


@pytest.mark.parametrize(
    ("change", "boundary"),
    [
        (lambda raw: min(raw, 198), 200),
        (lambda raw: raw & 0xFF, 256),
        (lambda raw: raw - 9 if raw > 1000 else raw, 1199),
        (lambda raw: min(raw, 1269), 1271),
        (lambda raw: min(raw, 6000), 8000),
    ],
)
def test_rates_beyond_a_boundary(change: Callable[[int], int], boundary: int) -> None:
    device = Changed(says=of("PUMP_BasalCmd", "InsulinRate", lambda raw: change(raw) if raw <= 8000 else raw))
    expect_failed("NUM-02", f"the schedule of {boundary} at 120 mg/dL", device)


@pytest.mark.parametrize(
    ("rounded", "text"), [(200, "72 rates that come to 14443.2 raw"), (202, "rates of 200 or one more; 202 came")]
)
def test_what_rounding_leaves(rounded: int, text: str) -> None:
    device = Changed(says=of("PUMP_BasalCmd", "InsulinRate", lambda raw: rounded if raw <= 8000 else raw))
    expect_failed("NUM-03", text, device)


@pytest.mark.parametrize(
    ("says", "text"),
    [
        (of("PUMP_BasalCmd", "InsulinRate", lambda _: 8191), "rates of at most 8000"),
        (of("PUMP_BasalCmd", "PramlintideRate", lambda raw: 8190 if 0 < raw <= 8000 else raw), "rates of at most 8000"),
        (of("PUMP_BolusCmd", "InsulinBolus", lambda _: 4094), "boluses from 1 to 4000"),
        (of("CTRL_Status", "LimiterBits", lambda _: 0), "bit 0 of LimiterBits or a SaturationCount"),
        (of("PUMP_BasalCmd", "InsulinRate", lambda raw: max(raw, 1)), "no insulin in a fall to 42 mg/dL"),
    ],
)
def test_extreme_inputs(says: Change, text: str) -> None:
    expect_failed("NUM-04", text, Changed(says=says))


def test_a_count_that_falls() -> None:
    counts = iter(range(1000, 0, -1))
    device = Changed(says=of("CTRL_Diag", "SaturationCount", lambda _: next(counts)))
    expect_failed("NUM-04", "a SaturationCount that never falls", device)
