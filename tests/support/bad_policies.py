"""Policies with one fault each, for the checks of policies."""

import os
import time
from dataclasses import dataclass

import numpy as np


@dataclass(kw_only=True)
class Lateral:
    """Handling on both axles while the lateral acceleration exceeds `threshold` [m/s²]."""

    threshold: float = 1.0

    def reset(self, context):
        self.context = context

    def act(self, observations):
        firm = np.abs(self.context.signal("planar", observations)[:, 1]) > self.threshold
        return self.context.switch_axles(np.stack([firm, firm], axis=1), "ride", "handling")


class Endless(Lateral):
    def act(self, observations):
        while True:
            time.sleep(1.0)


class Greedy(Lateral):
    def act(self, observations):
        self.hoard = np.ones(2**28)
        return super().act(observations)


class Leaves(Lateral):
    def act(self, observations):
        os._exit(3)


class Floats(Lateral):
    def act(self, observations):
        return np.zeros(len(observations))


class TooMany(Lateral):
    def act(self, observations):
        return np.zeros(1000 * len(observations), dtype=int)


class Beyond(Lateral):
    def act(self, observations):
        return np.full(len(observations), 99)


class Remembers(Lateral):
    """Its counter goes on over episodes."""

    def reset(self, context):
        self.context, self.steps = context, getattr(self, "steps", 0)

    def act(self, observations):
        self.steps += 1
        return np.full(len(observations), self.steps // 7 % 2)


class Chance(Lateral):
    def act(self, observations):
        return np.random.default_rng().integers(0, 2, len(observations))


class Raises(Lateral):
    """Names the number of its episodes in an error."""

    def reset(self, context):
        self.context, self.episodes = context, getattr(self, "episodes", 0) + 1

    def act(self, observations):
        raise ValueError(f"episode {self.episodes}")


class Crowd(Lateral):
    """What it commands depends on how many vehicles there are."""

    def act(self, observations):
        return np.full(len(observations), len(observations) % 2)


class Prints(Lateral):
    """Prints where replies are expected."""

    def act(self, observations):
        os.write(1, b"\x01\x08\x00\x00\x00nonsense")
        print("nonsense", flush=True)
        return super().act(observations)
