"""Policy trained by deep Q-learning (Mnih et al., Nature 518, 2015).

`road-recon train-policy` writes such networks; `training.py` implements the training.
"""

from dataclasses import dataclass

from road_envs.policies.network_policy import NetworkPolicy


@dataclass(kw_only=True)
class Dqn(NetworkPolicy):
    """Policy that takes the action of highest value; shipped network, or another `file`."""

    file: str = "dqn.npz"
