"""Policies of the shipped networks, which `road-recon train-policy` writes."""

from dataclasses import dataclass

from road_envs.policies.network_policy import NetworkPolicy


@dataclass(kw_only=True)
class Evolved(NetworkPolicy):
    """Policy of linear values of the states of each axle, by an evolution strategy."""

    file: str = "evolved.npz"
