"""Networks learned by policy iteration with rollouts, on drives of `RoadRecon/Safe4S4-v1`.

In each round the present policy drives new training drives. At many instants of them every pair of
states is tried in the simulator: held for a moment, after which the actions of the drive go on; its
cost over a horizon is comfort and the price of violations. The network then learns, from the
features of `features` alone, to choose pairs whose cost is low; its softmax p has the loss

    sum over pairs of p (cost - least cost)  -  ENTROPY H(p)

over all instants of all rounds. The simulator knows the true state and the road; the policy does
not. Lagoudakis & Parr, ICML 2003 (rollouts as a classifier's examples); Ross & Bagnell,
arXiv:1406.5979, 2014 (costs of all actions on the states that the policy itself visits). The first
rounds drive with `mpc`.

Other training drives choose the round: of those that violate in no more drives than CONSTRAINT the
one with the best score, or, if there is none, the one that violates in fewest.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from road_envs.core.config import Count, Positive, Settings
from road_envs.core.extras import optional_import
from road_envs.envs.safe4s4 import Safe4S4Setup
from road_envs.policies import create
from road_envs.policies.api import PolicyContext
from road_envs.policies.features import N_FEATURES, FeatureExtractor
from road_envs.policies.network_policy import NetworkPolicy, PolicyNetwork
from road_envs.policies.rollout import POLICY_SEED, Drives, drive_all

FIRST_ROUNDS = 2  # rounds whose drives are those of `mpc`
TRAINING_SEEDS = 6_000_000  # first seed of the drives of training seed 1; a million for each
DEVELOPMENT_SEED = 3_000_000  # first seed of the drives of comparison
CONSTRAINT = "rrms"  # policy whose violations a network should not exceed
FAILED = 0.05  # comfort [m²/s³] and time in violation [s] of each interval after a failure
MAX_COST = 10.0  # most that a pair may cost above the best [m²/s³]
ENTROPY, BATCH = 0.002, 512  # weight of the entropy; instants of a step


@dataclass(frozen=True, kw_only=True)
class IterationConfig(Settings):
    """Settings of a training; a step is a round. Times are numbers of control intervals."""

    steps: Count = 26
    drives: Count = 12  # new ones of every round, each to both sides
    compared: Count = 48  # that choose the round, each to both sides
    hold: Count = 3
    horizon: Count = 16
    every: Count = 3  # between the instants
    # of a second in violation, above the score's: the least of 100, 200, 400 and 1000 with which a
    # network violated no more than CONSTRAINT on training drives
    price: Positive = 400.0
    width: Count = 64  # of both layers


def iterate(
    config: IterationConfig, seed: int, progress: Callable[[str, float], None]
) -> tuple[PolicyNetwork, tuple[tuple[int, float], ...]]:
    """Return the network of the best round, and each round's score on other training drives.
    `progress` is called with a description and the share done.
    """
    with optional_import("training a policy"):
        import torch

    torch.set_num_threads(1)  # more are slower for layers this small
    torch.manual_seed(seed)
    setup, rng = Safe4S4Setup({"split": "train"}), np.random.default_rng(seed)
    compared = Drives.mirrored(setup, [DEVELOPMENT_SEED + k for k in range(config.compared)])
    allowed = drive_all(create(CONSTRAINT), compared).violated.sum()
    widths = (N_FEATURES, config.width, config.width, len(setup.command_bytes))
    linear = [torch.nn.Linear(a, b) for a, b in pairwise(widths)]
    model = torch.nn.Sequential(linear[0], torch.nn.Tanh(), linear[1], torch.nn.Tanh(), linear[2])
    policy: Any = None
    metadata = {"activation": "tanh", "control": "states", "held": 1, "seed": seed}
    best, curve = (-np.inf, -np.inf, PolicyNetwork((), metadata)), []
    seen: list[tuple[np.ndarray, np.ndarray]] = []
    for k in range(config.steps):
        progress(f"round {k + 1}: {best[1]:.4f}", k / config.steps)
        first = TRAINING_SEEDS + 1_000_000 * (seed - 1) + k * config.drives
        drives = Drives.mirrored(setup, range(first, first + config.drives))
        policy = create("mpc") if k < FIRST_ROUNDS else policy
        seen.append(_examples(config, drives, policy, int(rng.integers(config.every))))
        features, costs = (np.concatenate(part) for part in zip(*seen, strict=True))
        epochs = int(np.clip(400_000 // len(costs), 4, 12))
        _fit(model, features, costs, epochs, 2e-3 if k < 4 else 1e-3, rng)
        weights = [part.detach().numpy().copy() for part in model.parameters()]
        layers = tuple(zip(weights[::2], weights[1::2], strict=True))
        network = PolicyNetwork(layers, metadata | {"steps": k + 1})
        policy = NetworkPolicy.from_network(network)
        driven = drive_all(policy, compared)
        score, more = float(driven.score.mean()), driven.violated.sum() - allowed
        curve.append((k + 1, score))
        best = max(best, (min(-more, 0), score, network), key=lambda each: each[:2])
    return best[2], tuple(curve)


def _examples(
    config: IterationConfig, drives: Drives, policy: Any, first: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return features (M, K) at instants of drives and costs (M, 16) [m²/s³] of all pairs there."""
    driven = drive_all(policy, drives, store_observations=True)
    costs = _pair_costs(config, drives, driven.actions, first)
    instants = first + config.every * np.arange(len(costs))
    extractor = FeatureExtractor(PolicyContext.from_setup(drives.setup, len(drives), POLICY_SEED))
    features = np.stack([extractor.update(x) for x in driven.observations])[instants]
    whole = instants[:, None] + config.horizon < driven.intervals[None]
    return features[whole], costs[whole]


def _pair_costs(
    config: IterationConfig, drives: Drives, actions: np.ndarray, first: int
) -> np.ndarray:
    """Return the costs (T', N, 16) of all pairs every few intervals of drives under `actions`."""
    commands, pairs = drives.setup.command_bytes, len(drives.setup.command_bytes)
    fleet = drives.start(pairs)
    fleet.advance(drives.first_bytes(pairs))
    columns = [fleet.columns.index(name) for name in ("comfort", "cost")]
    # all vehicles of a drive are in one state; vehicle v tries pair v % pairs
    planned, tried = np.repeat(commands[actions], pairs, axis=1), np.tile(commands, len(drives))
    for row in planned[:first]:
        fleet.advance(row)
    found = []
    for k in range(first, len(actions) - config.horizon, config.every):
        saved, sums = fleet.copy_state(), np.zeros((2, fleet.n_vehicles))
        for j in range(config.horizon):
            output = fleet.advance(tried if j < config.hold else planned[k + j])
            sums += np.where(output.failed, FAILED, output.values[:, columns].T)
        found.append((sums[0] + config.price * sums[1]).reshape(-1, pairs))
        fleet.restore_state(saved)
        for row in planned[k : k + config.every]:
            fleet.advance(row)
    return np.array(found)


def _fit(
    model: Any, features: np.ndarray, costs: np.ndarray, epochs: int, rate: float, rng: Any
) -> None:
    """Train the model with Adam, whose rate falls to zero."""
    import torch

    worse = np.clip(costs - costs.min(axis=1, keepdims=True), 0.0, MAX_COST)
    x, worse = torch.from_numpy(features), torch.from_numpy(worse.astype(np.float32))
    optimiser = torch.optim.Adam(model.parameters(), lr=rate, weight_decay=1e-5)
    batches = len(x) // BATCH
    for k in range(epochs * batches):
        if k % batches == 0:
            order = torch.from_numpy(rng.permutation(len(x)))
        for group in optimiser.param_groups:
            group["lr"] = rate * (1.0 - k / (epochs * batches)) + 1e-5
        chosen = order[(k % batches) * BATCH : (k % batches + 1) * BATCH]
        log_p = torch.log_softmax(model(x[chosen]), 1)
        loss = (log_p.exp() * (worse[chosen] + ENTROPY * log_p)).sum(1).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
