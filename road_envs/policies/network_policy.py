"""Policies of small fully connected networks, stored as plain arrays.

    h_0 = features,   h_i = f(W_i h_{i-1} + b_i),   action = argmax of the last layer, without f

A file is a .npz of arrays `W_i`, `b_i` and a JSON text `about` with the metadata: format,
activation, control, `held` (control intervals per action), and how it was trained. The zip that
Stable-Baselines3 saves of a PPO, DQN or QR-DQN with an MlpPolicy is read, too, if it does no more
than the formula; such a network observes features if it has as many inputs, else the observations
as they are. Both are read without pickle, so an untrusted file cannot execute code.
"""

import io
import json
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from road_envs.core.config import ConfigError, Settings, shown, validate_choice
from road_envs.core.extras import optional_import
from road_envs.core.reading import parsing, read_npz, read_zip
from road_envs.envs.options import ACTIONS
from road_envs.policies.api import PolicyContext
from road_envs.policies.features import N_FEATURES, FeatureExtractor

SB3_SUFFIX = ".zip"
FILE_SUFFIXES = (".npz", SB3_SUFFIX)  # suffixes of the files that hold a network
SB3_ACTORS = (
    "mlp_extractor.policy_net.", "action_net.weight", "action_net.bias",
    "q_net.q_net.", "quantile_net.quantile_net.",
)  # fmt: skip
"""Beginnings of the names of the parameters of a Stable-Baselines3 policy that choose actions."""
SB3_CRITICS = ("mlp_extractor.value_net.", "value_net.", "q_net_target.", "quantile_net_target.")
"""Beginnings of the names of those that only learning needs."""
SB3_DEFAULTS = {
    "stable_baselines3.common.policies": "tanh", "sb3_contrib.common.maskable.policies": "tanh",
    "stable_baselines3.dqn.policies": "relu", "sb3_contrib.qrdqn.policies": "relu",
}  # fmt: skip
"""Activation by default, by the module of the policy class: `activation_fn` of its arguments."""
SB3_ACTIVATIONS = {f"torch.nn.modules.activation.{x}": x.lower() for x in ("Tanh", "ReLU")}
SB3_FLATTEN = "stable_baselines3.common.torch_layers.FlattenExtractor"  # changes no observation
SB3_BOX = "gymnasium.spaces.box.Box"  # values of a Dict are put in the order of their names

FORMAT = "roadrecon policy 3"
ACTIVATIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "tanh": np.tanh,
    "relu": lambda x: np.maximum(x, 0.0),
}


Layers = tuple[tuple[np.ndarray, np.ndarray], ...]  # weights (out, in), biases (out,) of each


@dataclass(frozen=True)
class PolicyNetwork:
    """A network's layers, and the metadata of its file."""

    layers: Layers
    metadata: dict[str, Any]

    def forward(self, features: np.ndarray) -> np.ndarray:
        """Return the output (N, actions) of the last layer for features (N, K)."""
        activation, h = ACTIVATIONS[self.metadata["activation"]], features
        for W, b in self.layers[:-1]:
            h = activation(h @ W.T + b)
        W, b = self.layers[-1]
        return h @ W.T + b

    def to_bytes(self) -> bytes:
        arrays = {f"W_{i}": W for i, (W, _) in enumerate(self.layers)}
        arrays |= {f"b_{i}": b for i, (_, b) in enumerate(self.layers)}
        text = json.dumps({"format": FORMAT, **self.metadata}, sort_keys=True)
        buffer = io.BytesIO()
        np.savez(buffer, about=np.array(text), **arrays)  # type: ignore[arg-type]
        return buffer.getvalue()


def sb3_layers(parameters: Mapping[str, Any], actions: int) -> Layers:
    """Return the layers that choose one of the `actions`, from a `state_dict` of a policy of
    Stable-Baselines3. Raises ValueError if it has none, or others that may change its actions.
    """
    if foreign := [name for name in parameters if not name.startswith(SB3_ACTORS + SB3_CRITICS)]:
        raise ValueError(f"{shown(foreign[0])} is no parameter of an MlpPolicy of PPO, DQN, QR-DQN")
    names = [name for name in parameters if name.startswith(SB3_ACTORS)]
    tensors = [parameters[name].detach().cpu() for name in names]
    for tensor in tensors:  # a few bytes can stand for any number of values
        if tensor.numel() * tensor.element_size() > tensor.untyped_storage().nbytes():
            raise ValueError("a tensor of it has more values than it stores")
    arrays = [tensor.numpy().copy() for tensor in tensors]
    if not arrays or len(arrays) % 2:
        raise ValueError("no MlpPolicy of PPO, DQN or QR-DQN")
    layers = list(zip(arrays[::2], arrays[1::2], strict=True))
    if names[-1].startswith("quantile_net"):
        # rows are quantiles of the actions in turn; the value of an action is their mean
        W, b = (x.reshape(-1, actions, *x.shape[1:]).mean(axis=0) for x in layers[-1])
        layers[-1] = W, b
    return tuple(layers)


def _read_sb3(path: Path) -> PolicyNetwork:
    """Read a network from the zip of a model of Stable-Baselines3. Raises ConfigError."""
    with optional_import("a policy of Stable-Baselines3"):
        import torch

    with parsing(path, ConfigError, "not a saved model of Stable-Baselines3"):
        files = read_zip(path)
        about = json.loads(files["data"])
        module, given = about["policy_class"]["__module__"], about["policy_kwargs"]
        activation = SB3_DEFAULTS[validate_choice("module of its policy", module, SB3_DEFAULTS)]
        if "activation_fn" in given:
            name = _class_name(given["activation_fn"])
            activation = SB3_ACTIVATIONS[validate_choice("activation", name, SB3_ACTIVATIONS)]
        extractor = _class_name(given.get("features_extractor_class", SB3_FLATTEN))
        validate_choice("features extractor", extractor, [SB3_FLATTEN])
        space = _class_name(about["observation_space"][":type:"])
        validate_choice("observation space", space, [SB3_BOX])
        with zipfile.ZipFile(io.BytesIO(files["policy.pth"])) as records:
            if any(x.compress_type != zipfile.ZIP_STORED for x in records.infolist()):
                raise ValueError("its weights are compressed, which Stable-Baselines3 does not do")
        parameters = torch.load(io.BytesIO(files["policy.pth"]), weights_only=True)
        actions = int(about["action_space"]["n"])
        control = {len(table): name for name, table in ACTIONS.items()}[actions]
        layers = sb3_layers(parameters, actions)
        _validate_layers(layers, layers[0][0].shape[1], actions)
        return PolicyNetwork(layers, {"activation": activation, "control": control, "held": 1})


def _class_name(text: object) -> str:
    """Return module and name of a class, from the text that Stable-Baselines3 writes of it."""
    return str(text).removeprefix("<class '").removesuffix("'>")


def _read_network(path: Path) -> PolicyNetwork:
    """Read a network from its file. Raises ConfigError if the file is damaged or foreign."""
    if path.suffix == SB3_SUFFIX:
        return _read_sb3(path)
    with parsing(path, ConfigError, "not a stored policy"):
        arrays = read_npz(path)
        metadata = json.loads(str(arrays.pop("about")))
        if metadata["format"] != FORMAT:
            raise ValueError(f"format must be {FORMAT!r}, got {metadata['format']!r}")
        validate_choice("activation", metadata["activation"], ACTIVATIONS)
        validate_choice("control", metadata["control"], ACTIONS)
        if not (isinstance(metadata["held"], int) and metadata["held"] >= 1):
            raise ValueError(f"held must be a positive whole number, got {metadata['held']!r}")
        layers = tuple((arrays[f"W_{i}"], arrays[f"b_{i}"]) for i in range(len(arrays) // 2))
        _validate_layers(layers, N_FEATURES, len(ACTIONS[metadata["control"]]))
        return PolicyNetwork(layers, metadata)


def _validate_layers(layers: Layers, features: int, actions: int) -> None:
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
    """Policy of the largest output of a network; `file`: its path. Raises ConfigError."""

    file: str
    network: PolicyNetwork = field(init=False, repr=False, compare=False)

    def __post_init__(self):
        super().__post_init__()
        self.network = _read_network(Path(self.file))

    @classmethod
    def from_network(cls, network: PolicyNetwork) -> "NetworkPolicy":
        policy = cls.__new__(cls)
        policy.file, policy.network = "a network in memory", network
        return policy

    def reset(self, context: PolicyContext) -> None:
        """Reset the features. Raises ConfigError if the action space is another one."""
        if len(context.actions) != len(self.network.layers[-1][1]):
            control = self.network.metadata["control"]
            raise ConfigError(f"{self.file} needs the control {control!r} it was trained with")
        size = self.network.layers[0][0].shape[1]
        observed = max(part.stop for part in context.observation_slices.values())
        if size not in (N_FEATURES, observed):
            raise ConfigError(
                f"{self.file} needs {size} observed values, as in the environment it was trained "
                f"with; there are {observed}"
            )
        self.features = FeatureExtractor(context) if size == N_FEATURES else None
        self.n_intervals = 0

    def act(self, observations: np.ndarray) -> np.ndarray:
        features = self.features.update(observations) if self.features else observations
        if self.n_intervals % self.network.metadata["held"] == 0:
            self.actions = np.argmax(self.network.forward(features), axis=1)
        self.n_intervals += 1
        return self.actions
