"""Proximal policy optimisation (Schulman et al. 2017, arXiv:1707.06347): a network trained before.

`road-recon train-policy` makes such files; `training.py` says how.
"""

from dataclasses import dataclass

from road_envs.policies.network_policy import NetworkPolicy


@dataclass(kw_only=True)
class Ppo(NetworkPolicy):
    """The shipped network, or another `file`."""

    file: str = "ppo.npz"
