"""A learned policy as plain numbers: layers of a small network, stored without pickle.

    h_0 = features,   h_i = f(W_i h_{i-1} + b_i),   action = argmax of the last, which has no f

A file is a .npz of arrays `W_i`, `b_i` and one text, `metadata`, in JSON: format, activation,
control, how many intervals an action is held, whether it looks ahead, and how it was trained.
Nothing in it is run, so a file of a stranger can do no worse than drive badly.
"""

import io
import json
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from road_envs.config import STRICT, ConfigError, folder
from road_envs.envs.options import ACTIONS
from road_envs.policies.api import PolicyContext
from road_envs.policies.features import FeatureExtractor, n_features

FORMAT = "roadrecon policy 2"
ACTIVATIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "tanh": np.tanh,
    "relu": lambda x: np.maximum(x, 0.0),
}


@dataclass(frozen=True)
class PolicyNetwork:
    """Weights (out, in) and biases (out,) of each layer; `metadata` says how they were made."""

    layers: tuple[tuple[np.ndarray, np.ndarray], ...]
    metadata: dict[str, Any]

    def forward(self, features: np.ndarray) -> np.ndarray:
        """What the last layer makes (N, actions) of features (N, K)."""
        activation, h = ACTIVATIONS[self.metadata["activation"]], features
        for i, (W, b) in enumerate(self.layers):
            h = h @ W.T + b
            h = activation(h) if i < len(self.layers) - 1 else h
        return h

    def to_bytes(self) -> bytes:
        """The file."""
        arrays = {f"W_{i}": W for i, (W, _) in enumerate(self.layers)}
        arrays |= {f"b_{i}": b for i, (_, b) in enumerate(self.layers)}
        text = json.dumps({"format": FORMAT, **self.metadata}, sort_keys=True)
        buffer = io.BytesIO()
        np.savez(buffer, about=np.array(text), **arrays)  # type: ignore[arg-type]
        return buffer.getvalue()


def read_policy_network(path: Path) -> PolicyNetwork:
    """A network from its file. Raises ConfigError that says what is wrong with it."""
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror or error}") from None
    except (ValueError, zipfile.BadZipFile, EOFError) as error:
        raise ConfigError(f"{path}: not a stored policy: {error}") from None
    try:
        metadata = json.loads(str(arrays.pop("about")))
        if metadata["format"] != FORMAT:
            raise ValueError(f"format {metadata['format']!r} is not {FORMAT!r}")
        if metadata["activation"] not in ACTIVATIONS or metadata["control"] not in ACTIONS:
            raise ValueError("activation or control is unknown")
        if not (isinstance(metadata["held"], int) and metadata["held"] >= 1):
            raise ValueError("an action is held for a whole number of intervals")
        layers = tuple((arrays[f"W_{i}"], arrays[f"b_{i}"]) for i in range(len(arrays) // 2))
        if not isinstance(metadata["ahead"], bool):
            raise ValueError("a policy looks ahead or it does not")
        _validate_layers(layers, n_features(metadata["ahead"]), len(ACTIONS[metadata["control"]]))
    except (KeyError, TypeError, ValueError) as error:
        raise ConfigError(f"{path}: not a stored policy: {error}") from None
    return PolicyNetwork(layers, metadata)


def _validate_layers(
    layers: tuple[tuple[np.ndarray, np.ndarray], ...], features: int, actions: int
) -> None:
    """Raise ValueError unless the layers lead from features to actions."""
    size, lead = features, f"layers must lead from {features} features to {actions} actions"
    for W, b in layers:
        if W.dtype.kind != "f" or W.ndim != 2 or W.shape[1] != size or b.shape != W.shape[:1]:
            raise ValueError(lead)
        if not (np.isfinite(W).all() and np.isfinite(b).all()):
            raise ValueError("every weight must be finite")
        size = len(b)
    if size != actions or not layers:
        raise ValueError(lead)


@dataclass(kw_only=True)
class NetworkPolicy:
    """The likeliest (or most valued) action of the network in `file`, a name in the shipped folder
    of policies or a path.
    """

    __pydantic_config__ = STRICT

    file: str
    network: PolicyNetwork = field(init=False, repr=False, compare=False)

    def __post_init__(self):
        path = Path(self.file)
        self.network = read_policy_network(
            path if path.exists() else folder() / "policies" / self.file
        )

    @classmethod
    def from_network(cls, network: PolicyNetwork) -> "NetworkPolicy":
        """A policy of a network that is in no file yet."""
        policy = cls.__new__(cls)
        policy.file, policy.network = "a network in memory", network
        return policy

    def reset(self, context: PolicyContext) -> None:
        """Forget the past."""
        if len(context.actions) != len(self.network.layers[-1][1]):
            control = self.network.metadata["control"]
            raise ConfigError(f"{self.file} was trained with control {control!r}: drive it so")
        self.features, self.done = FeatureExtractor(context, self.network.metadata["ahead"]), 0

    def act(self, observations: np.ndarray) -> np.ndarray:
        """One pass through the network, now and then."""
        features = self.features.update(observations)
        if self.done % self.network.metadata["held"] == 0:
            self.actions = np.argmax(self.network.forward(features), axis=1)
        self.done += 1
        return self.actions
