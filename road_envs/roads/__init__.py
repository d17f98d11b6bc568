"""Roads: frozen descriptions that can be realised as a `Surface`.

To add a kind of road, write a module with a frozen dataclass that has `length` and `realise(rng)`,
put the class into KINDS below, add a YAML file to `configs/roads` and run `pytest`.
"""

from road_envs.roads.api import KINDS, Road, load_road, realise_road, with_length
from road_envs.roads.belgian import Belgian
from road_envs.roads.composite import (
    Concatenated,
    FixedSeed,
    Flat,
    NoisyCopy,
    Offset,
    RandomLevel,
    Scaled,
    Superposed,
    Tiled,
    WithAprons,
)
from road_envs.roads.formats.write import write, write_csv
from road_envs.roads.iso8608 import Iso8608
from road_envs.roads.measured import Measured
from road_envs.roads.obstacles import Bumps, Defects, Potholes
from road_envs.roads.sine_sweep import SineSweep
from road_envs.roads.surface import Surface

__all__ = [
    "KINDS",
    "Road",
    "Surface",
    "load_road",
    "realise_road",
    "with_length",
    "write",
    "write_csv",
]

KINDS.update(
    {
        "belgian": Belgian,
        "bumps": Bumps,
        "concatenated": Concatenated,
        "defects": Defects,
        "fixed_seed": FixedSeed,
        "flat": Flat,
        "iso8608": Iso8608,
        "measured": Measured,
        "noisy_copy": NoisyCopy,
        "offset": Offset,
        "potholes": Potholes,
        "random_level": RandomLevel,
        "scaled": Scaled,
        "sine_sweep": SineSweep,
        "superposed": Superposed,
        "tiled": Tiled,
        "with_aprons": WithAprons,
    }
)
