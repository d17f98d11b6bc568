"""Checker of vector environments; Gymnasium provides one for scalar environments only.

It compares a vector environment with scalar ones, step by step and in every autoreset mode:
environment i must equal a scalar environment with seed + i to the bit, in observations, rewards,
terminations, truncations and infos. It also detects faults that corrupt training data: shared
buffers, wrong spaces, wrong final observations and wrong masks.
"""

from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

MakeVector = Callable[..., VectorEnv]
"""Function of `num_envs` and `autoreset_mode` that returns the vector environment."""


class VectorCheckError(AssertionError):
    """Difference between a vector environment and its scalar one, in one sentence."""


def check_vector_env(
    make_vector: MakeVector,
    make_single: Callable[[], gymnasium.Env],
    *,
    num_envs: int = 3,
    steps: int = 50,
    seed: int = 0,
    modes: tuple[AutoresetMode, ...] = tuple(AutoresetMode),
) -> int:
    """Compare `steps` steps under random actions, and return the number of ended episodes.

    Autoreset is tested only if episodes end: choose `steps` large enough. Raises
    VectorCheckError.
    """
    ended = 0
    for mode in modes:
        vector = make_vector(num_envs=num_envs, autoreset_mode=mode)
        singles = [make_single() for _ in range(num_envs)]
        try:
            _check_spaces(vector, singles[0], num_envs, mode)
            ended += _Comparison(vector, singles, mode).run(steps, seed)
        finally:
            vector.close()
            for single in singles:
                single.close()
    return ended


def _require(holds: bool, sentence: str) -> None:
    if not holds:
        raise VectorCheckError(sentence)


def _check_spaces(vector: VectorEnv, single: gymnasium.Env, n: int, mode: AutoresetMode) -> None:
    _require(vector.num_envs == n, f"num_envs is {vector.num_envs}, must be {n}")
    own_mode = vector.metadata.get("autoreset_mode")
    _require(own_mode == mode, f"metadata['autoreset_mode'] is {own_mode!r}, must be {mode}")
    for name in ("observation_space", "action_space"):
        scalar, batched = getattr(single, name), getattr(vector, name)
        _require(getattr(vector, f"single_{name}") == scalar, f"single_{name} must be {scalar}")
        _require(batched == batch_space(scalar, n), f"{name} must be a batch of {n} {scalar}")


class _Comparison:
    """Comparison of a vector environment with scalar ones in one autoreset mode."""

    def __init__(self, vector: VectorEnv, singles: list[gymnasium.Env], mode: AutoresetMode):
        self.vector, self.singles, self.mode = vector, singles, mode
        self.ended = np.zeros(len(singles), dtype=bool)
        self.count = 0
        self.returned: tuple[Any, Any] | None = None

    def run(self, steps: int, seed: int) -> int:
        """Compare a reset and `steps` steps, and return the number of ended episodes."""
        observations, infos = self.vector.reset(seed=seed)
        for i, single in enumerate(self.singles):
            self._compare("reset", i, observations, infos, single.reset(seed=seed + i))
        self._remember(observations)
        self.vector.action_space.seed(seed)
        for step in range(steps):
            if self.mode == AutoresetMode.DISABLED and self.ended.any():
                self._reset_by_mask(f"reset before step {step}")
            self._step(f"step {step}")
        return self.count

    def _step(self, when: str) -> None:
        actions = self.vector.action_space.sample()
        observations, rewards, terminated, truncated, infos = self.vector.step(actions)
        self._check_types(when, observations, rewards, terminated, truncated)
        self._check_buffers(when)
        before, self.ended = self.ended, np.zeros_like(self.ended)
        for i, (single, action) in enumerate(zip(self.singles, actions, strict=True)):
            if before[i]:  # NEXT_STEP: this step is the reset, whatever the action
                expected: tuple[Any, ...] = (0.0, False, False)
                self._compare(when, i, observations, infos, single.reset())
            else:
                observation, *rest, info = single.step(action)
                expected = tuple(rest)
                self.ended[i] = expected[1] or expected[2]
                if self.ended[i] and self.mode == AutoresetMode.SAME_STEP:
                    self._check_final(when, i, infos, observation, info)
                    observation, info = single.reset()
                self._compare(when, i, observations, infos, (observation, info))
            actual = (rewards[i], terminated[i], truncated[i])
            _require(
                actual == expected,
                f"{when}, environment {i}: reward, terminated, truncated are {actual}, must be "
                f"{expected} as in the scalar environment",
            )
        self.count += int(self.ended.sum())
        if self.mode == AutoresetMode.SAME_STEP:
            masks = np.asarray(infos.get("_final_obs", np.zeros_like(self.ended)))
            same = bool((masks == self.ended).all())
            _require(same, f"{when}: _final_obs does not mark the ended episodes")
            self.ended = np.zeros_like(self.ended)
        self._remember(observations)

    def _reset_by_mask(self, when: str) -> None:
        observations, infos = self.vector.reset(options={"reset_mask": self.ended.copy()})
        self._check_buffers(when)
        for i, single in enumerate(self.singles):
            if self.ended[i]:
                self._compare(when, i, observations, infos, single.reset())
            else:
                same = np.array_equal(observations[i], self.last[i])
                _require(same, f"{when}: environment {i} changed although it was not reset")
                set_ = [k for k, v in infos.items() if k.startswith("_") and np.asarray(v)[i]]
                _require(not set_, f"{when}: {set_} mark environment {i}, which was not reset")
        self.ended = np.zeros_like(self.ended)
        self._remember(observations)

    def _check_types(self, when: str, observations, rewards, terminated, truncated) -> None:
        n = len(self.singles)
        inside = self.vector.observation_space.contains(observations)
        _require(inside, f"{when}: the observations are not in the observation space")
        for name, array, kind in (
            ("rewards", rewards, "f"),
            ("terminations", terminated, "b"),
            ("truncations", truncated, "b"),
        ):
            fits = isinstance(array, np.ndarray) and array.shape == (n,)
            _require(fits and array.dtype.kind == kind, f"{when}: {name} are {array!r}")

    def _check_final(self, when: str, i: int, infos: dict, observation: Any, info: Mapping) -> None:
        _require("final_obs" in infos, f"{when}: an episode ended but infos lack final_obs")
        same = np.array_equal(infos["final_obs"][i], observation)
        _require(same, f"{when}, environment {i}: final_obs is not the last observation")
        self._compare_info(f"{when}, final_info", i, infos["final_info"], info)

    def _compare(self, when: str, i: int, observations, infos: dict, single: tuple) -> None:
        observation, info = single
        same = np.array_equal(observations[i], observation)
        _require(same, f"{when}, environment {i}: the observation differs from the scalar one")
        self._compare_info(when, i, infos, info)

    def _compare_info(self, when: str, i: int, infos: dict, info: Mapping) -> None:
        for name, value in info.items():
            where = f"{when}, environment {i}: info {name!r}"
            _require(name in infos, f"{where} is missing")
            _require(bool(np.asarray(infos[f"_{name}"])[i]), f"{where} is masked")
            same = np.array_equal(infos[name][i], value)
            _require(same, f"{where} is {infos[name][i]}, must be {value}")

    def _remember(self, observations: np.ndarray) -> None:
        """Keep the returned array and a copy, to detect that a later step overwrites it."""
        self.returned, self.last = (observations, observations.copy()), observations.copy()

    def _check_buffers(self, when: str) -> None:
        if self.returned is not None:
            same = np.array_equal(*self.returned)
            _require(same, f"{when}: the observations of the previous step have changed")
