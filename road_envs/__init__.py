"""Simulator of a vehicle on rough roads, and the Gymnasium environment `RoadRecon-v0`.

Reading order, which is the order of the data flow: `core`, `records`, `roads`, `vehicle`,
`simulation`, `sensing`, `drives`, `analysis`, `envs`, `policies`, `rendering`.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

import gymnasium

from road_envs._version import __version__

if TYPE_CHECKING:
    from road_envs.drives.recording import simulate_record
    from road_envs.records.record import Estimate, Profile, Record
    from road_envs.roads import load_road
    from road_envs.vehicle.parameters import load_vehicle

ID, SAFE_ID = "RoadRecon-v0", "RoadRecon/Safe4S4-v1"

_PUBLIC = {
    "Estimate": "road_envs.records.record",
    "Profile": "road_envs.records.record",
    "Record": "road_envs.records.record",
    "load_road": "road_envs.roads",
    "load_vehicle": "road_envs.vehicle.parameters",
    "simulate_record": "road_envs.drives.recording",
}
"""Names of the Python interface, by the module that is imported when one is first used."""

__all__ = [
    "ID",
    "SAFE_ID",
    "Estimate",
    "Profile",
    "Record",
    "__version__",
    "load_road",
    "load_vehicle",
    "simulate_record",
]

for _id, _single, _vector in (
    (ID, "road_recon:RoadReconEnv", "vector:RoadReconVectorEnv"),
    (SAFE_ID, "safe4s4:Safe4S4Env", "safe4s4:Safe4S4VectorEnv"),
):
    if _id not in gymnasium.registry:
        gymnasium.register(
            id=_id,
            entry_point=f"road_envs.envs.{_single}",
            vector_entry_point=f"road_envs.envs.{_vector}",
            max_episode_steps=100_000,
        )


def __getattr__(name: str) -> Any:
    """Import a name of the Python interface: compiled kernels would slow `import road_envs`."""
    if name not in _PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_PUBLIC[name]), name)
