"""Policies that switch the suspension: one file each; observation in, action out.

To add one: write a file beside this one and put it into REGISTRY.
"""

from road_envs.policies.fixed import FixedHandling, FixedRide
from road_envs.policies.ppo import LearnedPPO
from road_envs.policies.protocol import Learner, Policy
from road_envs.policies.random import RandomSwitching

__all__ = ["REGISTRY", "Learner", "Policy"]

REGISTRY: dict[str, type[Policy]] = {
    "fixed_ride": FixedRide,
    "fixed_handling": FixedHandling,
    "random": RandomSwitching,
    "ppo": LearnedPPO,
}
