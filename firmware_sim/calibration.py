"""The calibration of one patient: flashed parameter by parameter, checked as a set, active as a whole."""

import binascii
from collections.abc import Iterator

from can_bus import codec

from .control import layout
from .control.fixed import Ints

SET_CRC_INDEX = 63

CORE = {
    "BASAL": "CfgBasal",
    "TARGET": "CfgGlucoseTarget",
    "MAX_BASAL": "CfgMaxBasal",
    "PRAM_RATIO": "CfgPramRatio",
    "MEAL_GAIN": "CfgMealGain",
    "INSULIN_GAIN": "CfgInsulinGain",
    "OBSERVER_GAIN": "CfgObserverGain",
    "LEAD1_B0": "CfgLead1B0",
    "LEAD1_B1": "CfgLead1B1",
    "LEAD2_B0": "CfgLead2B0",
    "LEAD2_B1": "CfgLead2B1",
    "LEAD_A1": "CfgLeadA1",
    "INSULIN_A11": "CfgInsulinA11",
    "INSULIN_A21": "CfgInsulinA21",
    "INSULIN_A22": "CfgInsulinA22",
    "INSULIN_A31": "CfgInsulinA31",
    "INSULIN_A32": "CfgInsulinA32",
    "INSULIN_A33": "CfgInsulinA33",
    "INSULIN_B1": "CfgInsulinB1",
    "INSULIN_B2": "CfgInsulinB2",
    "INSULIN_B3": "CfgInsulinB3",
    "CARB_RATIO": "CfgCarbRatio",
    "MAX_BOLUS": "CfgMaxBolus",
    "MAX_IOB": "CfgMaxIob",
    "PRAM_BOLUS": "CfgPramBolus",
    "BOLUS_DEDUCTION": "CfgBolusDeduction",
    "MEAL_FACTOR": "CfgMealFactor",
    "ASSUMED_CARBS": "CfgAssumedCarbs",
    "FILTER_A1": "CfgFilterA1",
    "FILTER_A2": "CfgFilterA2",
    "FILTER_A3": "CfgFilterA3",
    "FILTER_B1": "CfgFilterB1",
    "FILTER_B2": "CfgFilterB2",
    "FILTER_B3": "CfgFilterB3",
    "PEAK_RATIO": "CfgPeakRatio",
    "PEAK_SLOPE": "CfgPeakSlope",
    "PEAK_LOCKOUT": "CfgPeakLockout",
    "BASAL_FACTOR": "CfgBasalFactor",
    "LOW_SUSPEND": "CfgLowSuspend",
    "BOLUS_LOCKOUT": "CfgBolusLockout",
    "MAX_RISE": "CfgMaxRise",
}
"""Which CFG_Param signal feeds which word of the control core's parameters."""

NEEDED = tuple(range(10))
"""CfgIndex of the parameters without which no set becomes active, whatever the mode (requirement STA-01)."""

UNSET = {
    "CfgInsulinTdd": 0,
    "CfgPramTdd": 0,
    "CfgBasalFactor": 0,
    "CfgLowSuspend": 700,
    "CfgBolusLockout": 3,
    "CfgMaxRise": 2000,
    "CfgStaleCgmLimit": 15,
    "CfgStuckSamples": 10,
}
"""Raw values of limits and options that were not flashed: the tight ones, never unlimited (requirement LIM-04)."""

LOWEST = {
    "CfgBasal": 1,
    "CfgGlucoseTarget": 600,
    "CfgMealGain": 10000,
    "CfgInsulinGain": 10000,
    "CfgCarbRatio": 100,
}
"""Raw values below which a parameter is refused as implausible (project's choice)."""


def set_crc(values: dict[int, int]) -> int:
    """CRC-16/CCITT-FALSE over index (1 byte) and raw value (4 bytes, little endian, signed) in order of index."""
    data = bytearray()
    for index in sorted(values):
        data.append(index)
        data += (values[index] & 0xFFFFFFFF).to_bytes(4, "little")
    return binascii.crc_hqx(bytes(data), 0xFFFF)


def parameter_names() -> dict[int, str]:
    """CfgIndex -> signal name, from the DBC."""
    message = codec.message("CFG_Param")
    return {index: fields[0].name for index, fields in message.pages.items()}


class Calibration:
    """What was flashed so far, and what is in force."""

    def __init__(self) -> None:
        self._names = parameter_names()
        self._fields = codec.message("CFG_Param").fields
        self._received: dict[int, int] = {}
        self._active: dict[str, int] = {}
        self._active_crc = 0
        self.parameters: Ints = [0] * len(layout.PARAMETERS)

    @property
    def active(self) -> bool:
        """Whether a complete, checked set is in force."""
        return bool(self._active)

    @property
    def intact(self) -> bool:
        """Whether what is in force is still what was checked when it was activated."""
        if not self._active:
            return True
        index = {name: number for number, name in self._names.items()}
        stored = set_crc({index[name]: raw for name, raw in self._active.items()}) == self._active_crc
        used = [self._active.get(name, UNSET.get(name, 0)) for name in (CORE[word.name] for word in layout.PARAMETERS)]
        return stored and used == list(self.parameters)

    @property
    def values(self) -> dict[str, int]:
        """The set in force, raw values by name."""
        return dict(self._active)

    def value(self, name: str) -> int:
        """Raw value of a parameter of `UNSET` in force, e.g. a limit that the control core does not know."""
        return self._active.get(name, UNSET[name])

    def save(self) -> list[int]:
        """The set in force for the non-volatile memory: index and value in turn, their number first."""
        index = {name: number for number, name in self._names.items()}
        words = [len(self._active)]
        for name, raw in self._active.items():
            words += [index[name], raw]
        return words

    def restore(self, words: Iterator[int]) -> None:
        """Take back what `save` wrote; a set that is not complete is not in force."""
        self._received = {}
        for _ in range(next(words)):
            index = next(words)
            self._received[index] = next(words)
        if self._received:
            self._activate()

    def store(self, values: dict[str, int]) -> dict[str, int]:
        """Take one decoded CFG_Param and return the raw values of its CFG_ParamEcho.

        A value out of range is refused, not clipped: the echo shows what stays in force.
        """
        index = values["CfgIndex"]
        name = self._names.get(index)
        if index == SET_CRC_INDEX and name is not None:
            if set_crc(self._received) == values[name]:
                self._activate()
            stored = self._active_crc
        elif name is None:
            stored = 0
        else:
            field = self._fields[name]
            if max(field.low, LOWEST.get(name, field.low)) <= values[name] <= field.high:
                self._received[index] = values[name]
            stored = self._received.get(index, 0)
        return {
            "EchoIndex": index,
            "EchoRaw": stored & 0x3FFFFFFF,
            "EchoSetCrc": set_crc(self._received),
        }

    def _activate(self) -> None:
        if not self._received.keys() >= set(NEEDED):
            return
        values = {self._names[index]: raw for index, raw in self._received.items()}
        parameters = []
        for word in layout.PARAMETERS:
            name = CORE[word.name]
            if name not in values and name not in UNSET:
                return
            parameters.append(values[name] if name in values else UNSET[name])
        self.parameters = parameters
        self._active = values
        self._active_crc = set_crc(self._received)
