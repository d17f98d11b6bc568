"""Policy trained as `ppo`, with an additional cost on the unresolved variance of the road.

`road-recon train-policy` writes such networks; `training.py` implements the training.
"""

from dataclasses import dataclass

from road_envs.policies.network_policy import NetworkPolicy


@dataclass(kw_only=True)
class PpoSensing(NetworkPolicy):
    """Policy of the shipped network, or of another `file`."""

    file: str = "ppo_sensing.npz"
