"""MEAL_Announce as a device hears it, boluses within one instant, and a device or a pump that starts anew."""

import pytest
from pumpbench.calibration import MODES, calibrate
from test_plant_server import Device

from can_bus.codec import Receiver, Transmitter
from can_bus.lockstep import Done, Phase
from plant_server.physiology import load_patient
from plant_server.scenario import RESCUE, Meal, Scenario, load_scenario
from plant_server.scenarios.announcing import Announcing, Late
from plant_server.scenarios.rescue import Rescue
from plant_server.server import PlantServer, Run
from plant_server.user import PATIENCE, Plan, User

PATIENT = load_patient("adult#001")
ESTIMATED, SIMPLE, SNACK, HYPO = 1, 2, 3, 4


def scenario(*meals: tuple[int, str, float], **changes: object) -> Scenario:
    plain = load_scenario("fasting")
    return plain._replace(meals=tuple(Meal(*meal) for meal in meals), **changes)


class Listener(Device):
    """A device that takes up the mode, and echoes a meal when it is told to."""

    def __init__(self, mode: str, eaten: Scenario, steps: int = 40) -> None:
        run = Run(PATIENT, eaten, steps, 1, MODES[mode], calibrate(PATIENT), "ideal", ())
        super().__init__(PlantServer(run))
        self.mode = MODES[mode]
        self.batch = self.join(mode)

    def step(self, echo: int | None = None) -> list[dict[str, int]]:
        """Answer the instant; the meals announced at the next one."""
        meal = {} if echo is None else {"LastMealId": echo}
        self.say("CTRL_Status", CtrlMode=self.mode, CtrlState=1, **meal)
        self.batch = self.done(self.plant.step)
        return self.told

    @property
    def told(self) -> list[dict[str, int]]:
        return [values for name, values in self.batch if name == "MEAL_Announce"]


def brief(told: list[dict[str, int]]) -> list[tuple[int, int, int, int]]:
    return [(one["MealKind"], one["MealId"], one["CarbsEst"], one["MealOffset"]) for one in told]


# ---- announcing


def test_a_meal_is_told_at_its_instant_and_repeated_until_it_is_echoed() -> None:
    device = Listener("ma", scenario((2, "Lunch", 45.3)))
    assert device.told == device.step() == []
    assert brief(device.step()) == [(ESTIMATED, 0, 91, 0)]  # 45.3 g to the nearest half gram
    assert brief(device.step()) == [(ESTIMATED, 0, 91, -5)]
    assert brief(device.step(echo=7)) == [(ESTIMATED, 0, 91, -10)]  # another meal's echo
    assert device.step(echo=0) == []
    assert device.step() == []


def test_the_announcement_stands_before_the_token() -> None:
    device = Listener("ma", scenario((0, "Lunch", 45.0)))
    names = [name for name, _ in device.batch]
    assert names.index("MEAL_Announce") < names.index("SYNC_Step") == len(names) - 1


def test_the_user_gives_up_after_an_hour_and_goes_on_with_the_next_meal() -> None:
    device = Listener("ma", scenario((1, "Lunch", 45.0), (20, "Dinner", 80.0)))
    told = [brief(device.step()) for _ in range(24)]
    assert [bool(one) for one in told] == [True] * PATIENCE + [False] * 7 + [True] * 5
    assert told[PATIENCE - 1] == [(ESTIMATED, 0, 90, -55)]
    assert told[19] == [(ESTIMATED, 1, 160, 0)]


def test_two_meals_at_once_are_told_one_after_the_other() -> None:
    device = Listener("ma", scenario((1, "Lunch", 45.0), (1, "Snack", 10.0)))
    assert brief(device.step()) == [(ESTIMATED, 0, 90, 0)]
    assert brief(device.step()) == [(ESTIMATED, 0, 90, -5)]
    assert brief(device.step(echo=0)) == [(SNACK, 1, 20, -10)]
    assert brief(device.step(echo=0)) == [(SNACK, 1, 20, -15)]
    assert device.step(echo=1) == []


def test_simplified_announcements_are_the_time_of_main_meals_only() -> None:
    device = Listener("sma", scenario((1, "Snack", 10.0), (2, "Lunch", 45.0)))
    assert device.step() == []
    assert brief(device.step()) == [(SIMPLE, 0, 1023, 0)]


@pytest.mark.parametrize("mode", ["nma", "s1", "s2"])
def test_the_other_modes_are_told_nothing(mode: str) -> None:
    device = Listener(mode, scenario((1, "Lunch", 45.0), rescue=Rescue(announced=True)))
    assert [device.step() for _ in range(8)] == [[]] * 8


def test_a_meal_told_ahead_comes_nearer() -> None:
    device = Listener("ma", scenario((6, "Lunch", 45.0), announcing=Announcing(ahead_minutes=20)))
    assert brief(device.step()) == []
    assert [brief(device.step())[0][3] for _ in range(6)] == [20, 15, 10, 5, 0, -5]


def test_an_offset_is_kept_within_an_hour() -> None:
    late = Announcing(late=Late(probability=1.0, minutes=(50, 50)))
    device = Listener("ma", scenario((0, "Lunch", 45.0), announcing=late))
    offsets = [one["MealOffset"] for _ in range(30) for one in device.step()]
    assert offsets == [-50, -55] + [-60] * 10


def test_sugar_is_told_at_once_behind_what_is_being_told() -> None:
    eaten = scenario((3, "Lunch", 45.0), rescue=Rescue(announced=True))
    user, transmitter, receiver = (
        User([Plan(0, MODES["ma"], eaten)], 1, "adult#001"),
        Transmitter(),
        Receiver(["MEAL_Announce"]),
    )

    def tell(step: int, sugar: bool) -> list[tuple[int, int, int, int]]:
        rescued = Meal(step, RESCUE, 15.0) if sugar else None
        return brief([receiver.receive(frame).values for frame in user.announce(step, rescued, transmitter)])

    assert tell(1, sugar=True) == [(HYPO, 0, 30, 0)]
    user.hear(0)
    assert tell(3, sugar=True) == [(ESTIMATED, 1, 90, 0)]
    user.hear(1)
    assert tell(4, sugar=False) == [(HYPO, 2, 30, -5)]


def test_sugar_that_is_eaten_in_a_run_is_told() -> None:
    device = Listener("ma", scenario(rescue=Rescue(below=100.0, announced=True, samples=1)), steps=150)
    for k in range(140):  # 10 U/h until it is low
        device.say("PUMP_BasalCmd", BasalOp=1, BasalCmdSeq=k, InsulinRate=2000, PramlintideRate=0,
                   BasalUntilStep=(k + 3) % 128)  # fmt: skip
        told = device.step()
        if told:
            break
    assert brief(told) == [(HYPO, 0, 30, 0)]
    assert any(values.get("TruthMealCarbs") == 750 for _, values in device.batch)  # 15 g at this very instant


def test_meal_ids_wrap_below_their_reserved_code() -> None:
    eaten = scenario(*((k, "Lunch", 45.0) for k in range(257)))
    user, transmitter, receiver = (
        User([Plan(0, MODES["ma"], eaten)], 1, "adult#001"),
        Transmitter(),
        Receiver(["MEAL_Announce"]),
    )
    numbers = []
    for step in range(257):
        (frame,) = user.announce(step, None, transmitter)
        numbers.append(receiver.receive(frame).values["MealId"])
        user.hear(numbers[-1])
    assert numbers == [*range(255), 0, 1]


# ---- boluses on the bus


def bolus(device: Device, op: int) -> list[tuple[str, dict[str, int]]]:
    """Send a command and ask for a further turn."""
    device.say("PUMP_BolusCmd", BolusHormone=1, BolusOp=op, BolusId=0, BolusUntilStep=1, InsulinBolus=200)
    return device.done(device.plant.step, Done.CONTINUE)


def test_program_and_commit_within_one_instant() -> None:
    device = Listener("ma", scenario())
    for op, purpose in ((1, 2), (2, 3)):
        turn = bolus(device, op)
        assert [name for name, _ in turn] == ["PUMP_Ack", "SYNC_Step"]
        ack = {"AckFor": purpose, "AckResult": 0, "AckId": 0, "AckEchoRaw": 200, "AckLimitRaw": 3000}
        assert turn[0][1] == ack
        assert turn[1][1]["SyncPhase"] == Phase.CONTINUE
    assert device.plant.step == 0
    device.step()
    (state, _) = [values for name, values in device.batch if name == "PUMP_BolusState"]
    assert state == {
        "BolusStateHormone": 1, "BolusPhase": 3, "BolusStateId": 0, "BolusDeliveredRaw": 200, "BolusProgrammedRaw": 200,
    }  # fmt: skip
    (totals,) = [values for name, values in device.batch if name == "PUMP_Delivered"]
    assert totals["InsulinTotal"] >= 2000


def test_a_command_that_fails_its_check_is_not_answered() -> None:
    device = Listener("ma", scenario())
    frame = device.transmitter.frame(
        "PUMP_BolusCmd", BolusHormone=1, BolusOp=1, BolusId=0, BolusUntilStep=1, InsulinBolus=200
    )
    device.plant.receive(frame._replace(data=frame.data[:-1] + bytes([frame.data[-1] ^ 1])))
    assert [name for name, _ in device.done(0, Done.CONTINUE)] == ["SYNC_Step"]


def test_before_the_first_bolus_its_id_is_not_available() -> None:
    device = Listener("nma", scenario())
    states = [values for name, values in device.batch if name == "PUMP_BolusState"]
    expected = {"BolusPhase": 0, "BolusStateId": 65535, "BolusDeliveredRaw": 0, "BolusProgrammedRaw": 0}
    assert states == [expected | {"BolusStateHormone": drug} for drug in (1, 2)]


# ---- resets


@pytest.mark.parametrize("steps", [5, 18])
def test_a_device_that_starts_anew_in_the_middle_of_a_run_is_heard(steps: int) -> None:
    device = Listener("ma", scenario())
    for _ in range(steps):
        device.step()
    device.transmitter = Transmitter()  # its counters begin at 0 ...
    device.say("SYNC_Done", DoneStatus=0, DoneStepIndex=steps, TxCount=1)
    assert device.plant.step == steps  # ... which looks like lost or repeated frames
    device.transmitter = Transmitter()
    again = device.say("HB_CTRL", NmtCtrl=0, ToggleCtrl=0, ResetCauseCtrl=1, BootCtrl=1)
    assert [(name, values["StepIndex"]) for name, values in again] == [("SYNC_Step", steps)]  # its turn, once more
    device.say("HB_CTRL", NmtCtrl=5, ToggleCtrl=1, ResetCauseCtrl=1, BootCtrl=1)
    device.step()
    assert device.plant.step == steps + 1


def test_a_heartbeat_of_a_device_that_goes_on_resets_nothing() -> None:
    device = Listener("ma", scenario())
    for _ in range(5):
        device.step()
    device.transmitter = Transmitter()
    assert device.say("HB_CTRL", NmtCtrl=5, ToggleCtrl=0, ResetCauseCtrl=1, BootCtrl=1) == []
    assert device.done(5) == []


def test_a_device_that_starts_anew_before_the_last_token_still_ends_the_run() -> None:
    device = Listener("ma", scenario(), steps=3)
    for _ in range(3):
        device.step()
    device.transmitter = Transmitter()
    again = device.say("HB_CTRL", NmtCtrl=0, ToggleCtrl=0, ResetCauseCtrl=1, BootCtrl=1)
    assert again[0][1]["SyncPhase"] == Phase.END
    device.done(3)
    assert device.plant.finished


def test_a_reset_of_the_pump_is_told_in_its_totals_and_heartbeat() -> None:
    device = Listener("nma", scenario())
    device.step()

    def told() -> tuple[dict[str, int], dict[str, int]]:
        values = dict(device.batch)
        return values["PUMP_Delivered"], values["HB_PUMP"]

    delivered, heartbeat = told()
    assert (delivered["PumpBootCount"], heartbeat["NmtPump"], heartbeat["BootPump"]) == (0, 5, 0)
    device.plant.pump.reset()
    device.step()
    delivered, heartbeat = told()
    assert (delivered["PumpBootCount"], heartbeat["NmtPump"], heartbeat["BootPump"]) == (1, 0, 1)
    assert delivered["InsulinTotal"] <= 150
    device.step()
    _, heartbeat = told()
    assert (heartbeat["NmtPump"], heartbeat["BootPump"]) == (5, 1)
