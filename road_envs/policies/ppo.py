"""Policy trained by proximal policy optimisation (Schulman et al. 2017, arXiv:1707.06347).

`road-recon train-policy` writes such networks; `training.py` implements the training.
"""

from dataclasses import dataclass

from road_envs.policies.network_policy import NetworkPolicy


@dataclass(kw_only=True)
class Ppo(NetworkPolicy):
    """Policy of the shipped network, or of another `file`."""

    file: str = "ppo.npz"
