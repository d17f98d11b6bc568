"""Deep Q-learning (Mnih et al., Nature 518, 2015): a network trained before.

`road-recon train-policy` makes such files; `training.py` says how.
"""

from dataclasses import dataclass

from road_envs.policies.network_policy import NetworkPolicy


@dataclass(kw_only=True)
class Dqn(NetworkPolicy):
    """The most valued action of the shipped network, or of another `file`."""

    file: str = "dqn.npz"
