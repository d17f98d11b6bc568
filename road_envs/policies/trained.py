"""Policies of the shipped networks, which `road-recon train-policy` writes (`training.py`)."""

from dataclasses import dataclass

from road_envs.policies.network_policy import NetworkPolicy


@dataclass(kw_only=True)
class Ppo(NetworkPolicy):
    """Policy of proximal policy optimisation (Schulman et al. 2017, arXiv:1707.06347)."""

    file: str = "ppo.npz"


@dataclass(kw_only=True)
class PpoSensing(NetworkPolicy):
    """Policy as `ppo`, trained with an additional cost on the unresolved variance of the road."""

    file: str = "ppo_sensing.npz"


@dataclass(kw_only=True)
class Dqn(NetworkPolicy):
    """Policy of deep Q-learning (Mnih et al., Nature 518, 2015): the action of highest value."""

    file: str = "dqn.npz"
