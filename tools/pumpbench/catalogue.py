"""The catalogue of faults: what each puts to the test, and who notices it.

An entry is a typical fault of a kind, at work in the first six hours of a run. What it is seen by was found by running
it on the reference firmware; the matrix (`pumpbench.matrix`) holds every entry to it, in all modes.
"""

from typing import Any, NamedTuple

from pumpbench import faults as make


class Entry(NamedTuple):
    """One typical fault.

    Attributes:
        name: what a report calls it.
        fault: the value.
        hazards: of H1 to H8 which it puts to the test.
        seen_by: alarms of CTRL or PUMP, and counters of CTRL_Diag, one of which shows it; empty if nothing can.
        unseen: why nothing can.
    """

    name: str
    fault: Any
    hazards: tuple[str, ...]
    seen_by: tuple[str, ...] = ()
    unseen: str = ""


def _entries() -> tuple[Entry, ...]:
    cgm, status, delivered = "CGM_Reading", "PUMP_Status", "PUMP_Delivered"
    some = {"start": "02:00", "end": "02:40"}
    boluses = {"start": "01:00", "end": "05:00"}
    return (
        # ---- lost and late
        Entry("one sample lost", make.drop(cgm, start="02:00", count=1), ("H3", "H7")),
        Entry("samples lost for 40 min", make.drop(cgm, **some), ("H3", "H4", "H7")),
        Entry("16 samples lost: the counter comes round", make.drop(cgm, start="02:00", count=16), ("H3", "H4", "H7")),
        Entry("a third of all samples lost", make.drop(cgm, start="01:00", probability=0.33), ("H3", "H4", "H7")),
        Entry("pump status lost", make.drop(status, **some), ("H7",)),
        Entry("totals lost", make.drop(delivered, **some), ("H6", "H7")),
        Entry("acknowledgements lost", make.drop("PUMP_Ack", **boluses), ("H1", "H5")),
        Entry("bolus states lost", make.drop("PUMP_BolusState", **boluses), ("H1", "H5")),
        Entry("bolus commands lost", make.drop("PUMP_BolusCmd", **boluses, every=2), ("H1", "H5")),
        Entry("set-points lost", make.drop("PUMP_BasalCmd", **some), ("H6", "H7")),
        Entry("meal announcements lost", make.drop("MEAL_Announce", **boluses), ("H1",)),
        Entry("samples a step late", make.delay(cgm, steps=1, **some), ("H3",)),
        Entry("samples four steps late", make.delay(cgm, steps=4, **some), ("H3", "H4")),
        Entry("acknowledgements two steps late", make.delay("PUMP_Ack", steps=2, **boluses), ("H1", "H5")),
        Entry("bolus commands a step late", make.delay("PUMP_BolusCmd", steps=1, **boluses), ("H1", "H5")),
        Entry("samples behind the token", make.delay(cgm, ms=50, **some), ("H3",)),
        # ---- doubled, out of order, old
        Entry("samples doubled", make.duplicate(cgm, **some), ("H3",)),
        Entry("bolus commands doubled", make.duplicate("PUMP_BolusCmd", **boluses), ("H1",)),
        Entry("announcements doubled", make.duplicate("MEAL_Announce", **boluses), ("H1",)),
        Entry("samples in the wrong order", make.reorder(cgm, **some), ("H3",)),
        Entry("old samples again", make.replay(cgm, back=4, **some), ("H3",)),
        Entry("old totals again", make.replay(delivered, back=3, **some), ("H6",)),
        Entry("old announcements again", make.replay("MEAL_Announce", back=1, **boluses), ("H1",)),
        # ---- damaged
        Entry("a bit of each sample turned over", make.flip_bits(cgm, bits=(21,), **some), ("H3",)),
        Entry("random bits of each sample", make.flip_bits(cgm, random=3, **some), ("H3",)),
        Entry("a bit of the sequence, checksum right", make.flip_bits(cgm, bits=(46,), repair_crc=True, **some), ("H3",)),
        Entry("bits of bolus commands", make.flip_bits("PUMP_BolusCmd", random=2, **boluses), ("H1", "H2")),
        Entry("samples of 380 mg/dL, checksum wrong", make.set_value(cgm, "GlucoseConc", 380, repair_crc=False, **some), ("H3",)),
        Entry("samples of 380 mg/dL, checksum right", make.set_value(cgm, "GlucoseConc", 380, **some), ("H2", "H3")),
        Entry("samples 15 mg/dL too high", make.set_value(cgm, "GlucoseConc", add=15, **some), ("H2",)),
        Entry("a sensor fault told", make.set_value(cgm, "CgmState", "SensorFault", **some), ("H3", "H4")),
        Entry("sample frames stuck", make.stuck_frame(cgm, **some), ("H3", "H4")),
        Entry("glucose stuck", make.stuck_value(cgm, "GlucoseConc", start="01:00", end="05:00"), ("H3",)),
        Entry("the sample number stuck", make.stuck_value(cgm, "CgmSampleSeq", **some), ("H3", "H4")),
        Entry("the counter stuck", make.frozen_counter(cgm, **some), ("H3", "H4")),
        Entry("samples cut to 7 bytes", make.wrong_length(cgm, 7, **some), ("H3", "H4")),
        Entry("remote frames for samples", make.remote_frame(cgm, **some), ("H3", "H4")),
        Entry("samples with 29-bit ids", make.extended_id(cgm, **some), ("H3", "H4")),
        Entry("samples under the pump's id", make.misroute(cgm, status, **some), ("H3", "H7")),
        # ---- forged, and other nodes
        Entry("forged samples", make.masquerade(cgm, values={"GlucoseConc": 300}, **some), ("H2", "H3")),
        Entry("forged set-points towards the pump", make.masquerade("PUMP_BasalCmd", values={"InsulinRate": 20}, **some), ("H2", "H6")),
        Entry("a babbling node with id 0", make.babble(frames=50, **some), ("H7",)),
        Entry("a babbling node with the samples' id", make.babble(message=cgm, frames=50, **some), ("H3", "H7")),
        Entry("a flood of the samples' id", make.babble(message=cgm, frames=600, start="02:00", end="02:20"), ("H3", "H7")),
        Entry("a babbling node with the device's own id", make.babble(message="PUMP_BolusCmd", frames=2, **some), ("H1", "H7")),
        Entry("a node that does not belong here", make.foreign_id(**some), ("H7",)),
        Entry("error frames", make.error_frames(frames=20, **some), ("H7",)),
        Entry("off the bus", make.bus_off(**some), ("H4", "H7")),
        # ---- time
        Entry("the clock an hour ahead", make.clock_jump(3600, **some), ("H1", "H3")),
        Entry("the clock set back an hour", make.clock_jump(-3600, **some), ("H1", "H3")),
        Entry("the clock 1 % fast", make.clock_drift(10_000, start="01:00"), ("H1", "H3")),
        Entry("the date a day off", make.day_change(1, start="02:00"), ("H1", "H2", "H3")),
        # ---- the device
        Entry("a restart", make.restart(start="02:00"), ("H1", "H8")),
        Entry("a restart amid a meal's boluses", make.restart(start="01:00", after_frames=2), ("H1", "H5", "H8")),
        Entry("a restart with a torn memory", make.restart(start="03:05", memory="torn"), ("H1", "H5", "H8")),
        Entry("a restart with a blank memory", make.restart(start="02:00", memory="lost"), ("H1", "H2")),
        Entry("no power for half an hour", make.restart(start="02:00", end="02:30"), ("H4", "H6", "H8")),
        Entry("a device that hangs for 40 min", make.hang(**some), ("H4", "H6")),
        Entry("a device that dies", make.kill(start="02:00"), ("H4", "H6")),
        Entry("a slow task", make.slow_task(task=1, start="02:00", end="02:05"), ("H7",)),
        Entry("a task that stays slow", make.slow_task(task=5, start="02:00", end="02:30"), ("H4", "H7")),
        # ---- the pump
        Entry("an occlusion", make.occlusion(start="01:30", end="04:30"), ("H6", "H7")),
        Entry("an occlusion, lost with the set", make.occlusion(start="01:30", end="04:30", lost=True), ("H6", "H7")),
        Entry("a pramlintide occlusion", make.occlusion("pramlintide", start="01:30", end="04:30"), ("H6", "H7")),
        Entry("an air bubble", make.air_bubble("insulin", 20, start="02:00"), ("H6",)),
        Entry("an empty reservoir", make.empty_reservoir("insulin", start="02:00"), ("H6", "H7")),
        Entry("an empty pramlintide reservoir", make.empty_reservoir("pramlintide", start="02:00"), ("H6", "H7")),
        Entry("a low battery", make.low_battery(10, start="02:00"), ("H7",)),
        Entry("an empty battery", make.low_battery(0, start="02:00"), ("H6", "H7")),
        # ---- the sensor
        Entry("compression", make.compression_low(start="02:00", end="03:00"), ("H4",)),
        Entry("drift", make.drift(offset_per_hour=10.0, start="01:00"), ("H2",)),
        Entry("a wrong calibration", make.bias(gain=1.2, start="01:00"), ("H2",)),
        Entry("a noisy sensor", make.noise(sd=20.0, start="01:00"), ("H3",)),
        Entry("a slower sensor", make.lag(20.0, start="01:00"), ("H2",)),
        Entry("a stuck sensor", make.stuck(start="01:00", end="04:00"), ("H3",)),
        Entry("a warm-up", make.state("Warmup", start="02:00", end="04:00"), ("H3", "H4")),
        Entry("a sensor that fails to send", make.drop_out(probability=0.5, start="01:00"), ("H3", "H4")),
        Entry("a new sensor", make.replacement(start="02:00"), ("H3",)),
    )  # fmt: skip


ENTRIES = _entries()
"""All of them."""
