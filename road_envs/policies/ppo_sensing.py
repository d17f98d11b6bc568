"""Learned sensing: as `ppo`, but taught with a price on the variance left unknown of the road.

`road-recon train-policy` makes such files; `training.py` says how.
"""

from dataclasses import dataclass

from road_envs.policies.network_policy import NetworkPolicy


@dataclass(kw_only=True)
class PpoSensing(NetworkPolicy):
    """The shipped network, or another `file`."""

    file: str = "ppo_sensing.npz"
