"""Policies of small fully connected networks, stored as plain arrays.

    h_0 = features,   h_i = f(W_i h_{i-1} + b_i),   action = argmax of the last layer, without f

A file is a .npz of arrays `W_i`, `b_i` and a JSON text `about` with the metadata: format,
activation, control, `held` (control intervals per action), `ahead` (whether there are preview
features), and how it was trained. Files are read without pickle, so an untrusted file cannot
execute code.
"""

import io
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from road_envs.core.config import ConfigError, Settings, folder, validate_choice
from road_envs.core.reading import parsing, read_npz
from road_envs.envs.options import ACTIONS
from road_envs.policies.api import PolicyContext
from road_envs.policies.features import FeatureExtractor, n_features

FORMAT = "roadrecon policy 3"
ACTIVATIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "tanh": np.tanh,
    "relu": lambda x: np.maximum(x, 0.0),
}


@dataclass(frozen=True)
class PolicyNetwork:
    """Weights (out, in) and biases (out,) of each layer, and the metadata of the file."""

    layers: tuple[tuple[np.ndarray, np.ndarray], ...]
    metadata: dict[str, Any]

    def forward(self, features: np.ndarray) -> np.ndarray:
        """Return the output (N, actions) of the last layer for features (N, K)."""
        activation, h = ACTIVATIONS[self.metadata["activation"]], features
        for i, (W, b) in enumerate(self.layers):
            h = h @ W.T + b
            h = activation(h) if i < len(self.layers) - 1 else h
        return h

    def to_bytes(self) -> bytes:
        """Return the content of the file."""
        arrays = {f"W_{i}": W for i, (W, _) in enumerate(self.layers)}
        arrays |= {f"b_{i}": b for i, (_, b) in enumerate(self.layers)}
        text = json.dumps({"format": FORMAT, **self.metadata}, sort_keys=True)
        buffer = io.BytesIO()
        np.savez(buffer, about=np.array(text), **arrays)  # type: ignore[arg-type]
        return buffer.getvalue()


def read_policy_network(path: Path) -> PolicyNetwork:
    """Read a network from its file. Raises ConfigError if the file is damaged or foreign."""
    with parsing(path, ConfigError, "not a stored policy"):
        arrays = read_npz(path)
        metadata = json.loads(str(arrays.pop("about")))
        if metadata["format"] != FORMAT:
            raise ValueError(f"format must be {FORMAT!r}, got {metadata['format']!r}")
        for key, known in (("activation", ACTIVATIONS), ("control", ACTIONS)):
            validate_choice(key, metadata[key], known)
        if not (isinstance(metadata["held"], int) and metadata["held"] >= 1):
            raise ValueError(f"held must be a positive whole number, got {metadata['held']!r}")
        layers = tuple((arrays[f"W_{i}"], arrays[f"b_{i}"]) for i in range(len(arrays) // 2))
        if not isinstance(metadata["ahead"], bool):
            raise ValueError(f"ahead must be true or false, got {metadata['ahead']!r}")
        _validate_layers(layers, n_features(metadata["ahead"]), len(ACTIONS[metadata["control"]]))
        return PolicyNetwork(layers, metadata)


def _validate_layers(
    layers: tuple[tuple[np.ndarray, np.ndarray], ...], features: int, actions: int
) -> None:
    """Raise ValueError unless the layers map features to actions and are finite."""
    size, message = features, f"layers must map {features} features to {actions} actions"
    for W, b in layers:
        if W.dtype.kind != "f" or W.ndim != 2 or W.shape[1] != size or b.shape != W.shape[:1]:
            raise ValueError(message)
        if not (np.isfinite(W).all() and np.isfinite(b).all()):
            raise ValueError("every weight must be finite")
        size = len(b)
    if size != actions or not layers:
        raise ValueError(message)


@dataclass(kw_only=True)
class NetworkPolicy(Settings):
    """Policy that takes the action with the largest output of a network.

    `file` is a path, or a name in the shipped folder of policies.
    """

    file: str
    network: PolicyNetwork = field(init=False, repr=False, compare=False)

    def __post_init__(self):
        super().__post_init__()
        path, shipped = Path(self.file), folder() / "policies" / self.file
        self.network = read_policy_network(path if path.exists() else shipped)

    @classmethod
    def from_network(cls, network: PolicyNetwork) -> "NetworkPolicy":
        """Return a policy of a network in memory."""
        policy = cls.__new__(cls)
        policy.file, policy.network = "a network in memory", network
        return policy

    def reset(self, context: PolicyContext) -> None:
        """Reset the features. Raises ConfigError if the action space is another one."""
        if len(context.actions) != len(self.network.layers[-1][1]):
            control = self.network.metadata["control"]
            raise ConfigError(f"{self.file} needs the control {control!r} it was trained with")
        self.features = FeatureExtractor(context, self.network.metadata["ahead"])
        self.n_intervals = 0

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Return actions (N,), new ones after every `held` intervals."""
        features = self.features.update(observations)
        if self.n_intervals % self.network.metadata["held"] == 0:
            self.actions = np.argmax(self.network.forward(features), axis=1)
        self.n_intervals += 1
        return self.actions
