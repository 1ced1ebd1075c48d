"""Numbers (NUM): what is received may be anything, what is commanded is in range, and nothing is lost in rounding."""

import random
from typing import Final

from can_bus import codec
from can_bus.codec import Field
from can_bus.frame import Frame
from can_bus.lockstep import STEPS_PER_DAY
from pumpbench.calibration import MODES
from pumpbench.conformance.boluses import carbs_mode
from pumpbench.conformance.driver import GLUCOSE, HEARD_BY_CTRL, NMA, Bench, Op, Turn, calibration, expect
from pumpbench.conformance.registry import Dut, check
from pumpbench.conformance.situations import idle_boluses, whole_batch

RATE_MAX: Final = 8000
"""Raw, of either drug's rate; what is above is reserved."""

BOLUS_MAX: Final = 4000
"""Raw, of either drug's bolus."""

TOTAL: Final = codec.message("PUMP_Delivered").fields["InsulinTotal"]
TOTAL_SNA: Final = codec.choice("PUMP_Delivered", "InsulinTotal", "SNA")

IOB_MAX: Final = 4090
IOB_SNA: Final = 4095

BOUNDARIES: Final = (199, 200, 255, 256, 1199, 1200, 1270, 1271, RATE_MAX)
"""Raw rates at the ends of bytes, and at 6 and 6.35 U/h, where other pumps have erred."""

SWEPT: Final = tuple(each.name for each in HEARD_BY_CTRL if each.name not in ("SYNC_Step", "PLANT_Info", "CFG_Param"))
"""What is heard in a run; time and calibration are other groups' business."""

REGULAR: Final = frozenset(("CGM_Reading", "PUMP_Status", "PUMP_Delivered", "PUMP_BolusState", "HB_PUMP", "HB_CGM"))


@check("NUM-01")
def any_value(dut: Dut) -> None:
    """Every field of what CTRL hears with values from all of its range, CRC right: no dose above the limits, no wrap.

    Totals run into their end at 24 bits. The long form takes more values.
    """
    strategy = carbs_mode(dut)
    mode = MODES[strategy or "nma"]
    limits = {"CfgMaxBasal": calibration()[0] * 5 // 4, "CfgMaxBolus": 300, "CfgMaxIob": 2000}
    rng = random.Random(1)
    for name in SWEPT:
        fields = list(codec.message(name).fields.values())
        # a total is believed for good, so that one field of it would hide what the next one does
        for together in [[field] for field in fields] if name == "PUMP_Delivered" else [fields]:
            bench = dut.bench(mode=mode, flash=calibration("adult#001", **limits))
            for _ in range(4):
                bench.instant(*_batch(bench))
            for field in together:
                for raw in _values(field, rng, 40 if dut.long else 3):
                    turn = bench.instant(*_batch(bench, (name, field.name, raw)))
                    _expect_within(turn, limits, f"with {name}.{field.name} {raw}")
                    while turn.all("PUMP_BolusCmd"):  # nobody answers it: it has to expire before the next one
                        turn = bench.instant(*_batch(bench))
                        _expect_within(turn, limits, f"after {name}.{field.name} {raw}")
    _totals_at_their_end(dut)


Forged = tuple[str, str, int]
"""Message, field and raw value."""


def _values(field: Field, rng: random.Random, most: int) -> list[int]:
    """Some ends of the range and of the field, some reserved codes, and others at random."""
    ends = {0, field.mask, field.low & field.mask, field.high & field.mask, (field.high + 1) & field.mask}
    likely = sorted(ends | {code & field.mask for code in field.reserved})
    return rng.sample(likely, min(most, len(likely))) + [rng.randint(0, field.mask) for _ in range(-(-most // 4))]


def _batch(bench: Bench, forged: Forged | None = None) -> list[Frame]:
    """What comes in a step, with one field changed; glucose rises, so that more than the limit is asked for."""
    glucose = min(GLUCOSE + 150 * bench.k, 3500) + 10 * (bench.k % 5)
    frames = [bench.sample(glucose), bench.status(), bench.delivered(), *whole_batch(bench)]
    if forged is None:
        return frames
    name, field, raw = forged
    if name not in REGULAR:
        frames.append(bench.frame(name, **_usual(bench, name)))
    can_id = codec.message(name).can_id
    return [bench.forge(frame, **{field: raw}) if frame.can_id == can_id else frame for frame in frames]


def _usual(bench: Bench, name: str) -> dict[str, int]:
    number = bench.k % 200
    usual: dict[str, dict[str, int]] = {
        "CGM_Status": {"CgmFaultBits": 0, "CgmSessionId": 1, "CgmSensorAge": 10, "CgmNoise": 0, "CgmDropCount": 0},
        "PUMP_Ack": {"AckFor": 1, "AckResult": 0, "AckId": number, "AckEchoRaw": 300, "AckLimitRaw": RATE_MAX},
        "PUMP_Alarm": {"PumpAlarmState": 1, "PumpAlarmPriority": 1, "PumpAlarmCode": 6, "PumpAlarmInstance": number},
        "MEAL_Announce": {"MealKind": 1, "MealId": number, "CarbsEst": 120, "MealOffset": 0},
        "UI_AlarmAck": {"AlarmAckNode": 1, "AlarmAckAction": 1, "AlarmAckInstance": number},
        "MODE_Cmd": {"ModeRequest": NMA, "ModeCmdSeq": number, "SuspendRequest": 0},
    }
    return usual[name]


def _expect_within(turn: Turn, limits: dict[str, int], what: str) -> None:
    """No dose above the limits, and no number that cannot be."""
    for command in turn.all("PUMP_BasalCmd"):
        rate, most = command["InsulinRate"], limits["CfgMaxBasal"] // 5
        expect(command["BasalOp"] != Op.SET_RATE or rate <= most, f"at most {most} of insulin {what}; {rate} came")
    for command in turn.all("PUMP_BolusCmd"):
        dose, most = command.get("InsulinBolus", 0), limits["CfgMaxBolus"]
        expect(dose <= most, f"a bolus of at most {most} {what}; {dose} came")
    for status in turn.all("CTRL_Status"):
        iob = status["InsulinOnBoard"]
        expect(iob <= IOB_MAX or iob == IOB_SNA, f"InsulinOnBoard of at most {IOB_MAX} or SNA {what}; {iob} came")


def _totals_at_their_end(dut: Dut) -> None:
    """The pump's total reaches its largest value, then is not available, and then begins anew."""
    bench = dut.bench()
    bench.total = 12 * TOTAL.high - 8 * bench.basal
    board = []
    for _ in range(12):
        total = bench.total // 12
        totals = bench.delivered(InsulinTotal=total if total <= TOTAL.high else TOTAL_SNA)
        board.append(bench.step(totals=totals).iob)
    bench.boot_count, bench.total = 1, bench.basal
    board += [bench.step().iob for _ in range(3)]
    most = max(board)
    expect(most <= 50, f"no insulin on board at the end of the pump's total and beyond; {most} came")


def _loose(**raws: int) -> dict[int, int]:
    """A calibration with its limits out of the way, and a sensor that may stand still."""
    return calibration("adult#001", **{"CfgMaxBasal": 60000, "CfgInsulinTdd": 16000, "CfgStuckSamples": 0} | raws)


@check("NUM-02")
def the_schedule_as_oracle(dut: Dut) -> None:
    """A glucose that stays at the target asks for the schedule: flashed at and beside all boundaries, to one LSB."""
    for raw in BOUNDARIES:
        bench = dut.bench(flash=_loose(CfgBasal=5 * raw))
        bench.run(3)
        for _ in range(5):
            rate = bench.commanded(bench.step())
            expect(abs(rate - raw) <= 1, f"the schedule of {raw} at {GLUCOSE / 10:g} mg/dL, to one LSB; {rate:g} came")


@check("NUM-03")
def what_rounding_leaves(dut: Dut) -> None:
    """A schedule between two raw values for hours, in the long form a day: rounded down, the rest carried on."""
    steps = STEPS_PER_DAY if dut.long else 72
    for basal in (1003, 1001):
        bench = dut.bench(flash=_loose(CfgBasal=basal))
        bench.run(4)
        rates = [bench.commanded(bench.step()) for _ in range(steps)]
        exact = steps * basal / 5
        expect(max(rates) <= basal // 5 + 1, f"rates of {basal // 5} or one more; {max(rates):g} came")
        expect(
            -1 - exact / 1000 <= sum(rates) - exact <= 1,
            f"{steps} rates that come to {exact:g} raw, at most 0.1 % less; {sum(rates):g} came",
        )


@check("NUM-04")
def extreme_inputs(dut: Dut) -> None:
    """The largest schedule, ratio and meals, then a low: commands without reserved codes, nothing negative.

    What a field cannot hold is told, by LimiterBits or SaturationCount.
    """
    largest = _loose(
        CfgBasal=60000, CfgMaxBolus=BOLUS_MAX, CfgMaxIob=4000, CfgCarbRatio=100, CfgPramRatio=4000, CfgPramTdd=16000
    )
    for name in ("nma", "ma", "s2"):
        if name not in dut.offers:
            continue
        bench = dut.bench(mode=MODES[name], flash=largest)
        counts = [0]
        for k in range(16):
            meal = bench.frame("MEAL_Announce", MealKind=1, MealId=k, CarbsEst=300, MealOffset=0)
            turn = bench.step(4000 if k > 8 else 1200 + 400 * k, also=[meal, *idle_boluses(bench)])
            _expect_no_codes(turn)
            counts += [diag["SaturationCount"] for diag in turn.all("CTRL_Diag")]
            cut = [command for command in turn.all("PUMP_BasalCmd") if command["InsulinRate"] == RATE_MAX]
            for status in turn.all("CTRL_Status") if cut else []:
                bits = status["LimiterBits"]
                expect(
                    bits & 1 == 1 or counts[-1] > 0,
                    f"bit 0 of LimiterBits or a SaturationCount where 60 U/h are cut to 40; {bits} and 0 came",
                )
        expect(counts == sorted(counts), f"a SaturationCount that never falls; {counts} came")
    bench = dut.bench()
    bench.run(6)
    for k in range(6):
        turn = bench.step(GLUCOSE - 130 * (k + 1))
        _expect_no_codes(turn)
    rate = bench.commanded(turn)
    expect(
        rate == 0, f"no insulin in a fall to {GLUCOSE / 10 - 78:g} mg/dL, where the demand is negative; {rate:g} came"
    )


def _expect_no_codes(turn: Turn) -> None:
    for command in turn.all("PUMP_BasalCmd"):
        if command["BasalOp"] == Op.SET_RATE:
            rates = command["InsulinRate"], command["PramlintideRate"]
            expect(max(rates) <= RATE_MAX, f"rates of at most {RATE_MAX}, what is above is reserved; {rates} came")
    for command in turn.all("PUMP_BolusCmd"):
        dose = command.get("InsulinBolus", command.get("PramlintideBolus", 0))
        expect(0 < dose <= BOLUS_MAX, f"boluses from 1 to {BOLUS_MAX}, what is above is reserved; {dose} came")
