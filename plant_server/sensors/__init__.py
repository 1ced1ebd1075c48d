"""Error models of glucose sensors, one per file; `plant_server.sensor` makes a sensor of one."""

from typing import Annotated

from pydantic import BeforeValidator, Field

from .breton2008 import Breton2008
from .coloured import Coloured
from .dexcom_g5 import DexcomG5
from .dexcom_g6 import DexcomG6
from .facchinetti2014 import Facchinetti2014
from .ideal import Ideal
from .model import Errors, Model, Streams, Wear
from .vettoretti2019 import Vettoretti2019

MODELS: dict[str, type[Model]] = {
    "coloured": Coloured,
    "ideal": Ideal,
    "breton": Breton2008,
    "facchinetti": Facchinetti2014,
    "dexcom-g5": DexcomG5,
    "dexcom-g6": DexcomG6,
    "vettoretti": Vettoretti2019,
}
"""By the name people use."""

AnyModel = Annotated[
    Coloured | Ideal | Breton2008 | Facchinetti2014 | DexcomG5 | DexcomG6 | Vettoretti2019,
    Field(discriminator="name"),
    BeforeValidator(lambda value: {"name": value} if isinstance(value, str) else value),
]
"""A model in a file: its name, or a mapping of its name and parameters."""

__all__ = [
    "MODELS",
    "AnyModel",
    "Errors",
    "Model",
    "Streams",
    "Wear",
]
