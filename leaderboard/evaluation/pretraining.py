"""Teaching an estimator from a corpus: simulation, learning, and what is said about the weights.

An interrupted teaching goes on where it was: the drives are simulated again, which is the smaller
part, and the state that was kept beside the output is taken up if it belongs to the same corpus,
settings, seed and version.
"""

import hashlib
import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from estimators import pretrained_weights, weights_io
from estimators.api import Calibratable, Pretrained
from leaderboard.evaluation.evaluate import get_settings
from leaderboard.evaluation.provenance import package_version
from road_envs.data.training_corpus import Corpus

Progress = Callable[[str, float], None]
SIMULATION_SHARE = 0.15
"""Share of the time that the drives take."""

CALIBRATION_SHARE = 0.5
"""Drives by the car as described that standard deviations are made honest on, per drive taught."""


class FileCheckpoint:
    """An unfinished state in a file; one of another `purpose` is as good as none."""

    def __init__(self, path: Path, purpose: str):
        self.path, self.purpose = path, purpose

    def load(self) -> dict[str, np.ndarray] | None:
        """The state, if there is one that fits."""
        if not self.path.exists():
            return None
        try:
            arrays, about = pretrained_weights.read_weights(self.path)
        except pretrained_weights.WeightsError:
            return None
        return arrays if about.get("purpose") == self.purpose else None

    def save(self, state: Mapping[str, np.ndarray]) -> None:
        """Keep a state, whole or not at all."""
        pretrained_weights.write_weights(self.path, state, {"purpose": self.purpose})

    def done(self) -> None:
        """Nothing is left to be kept."""
        self.path.unlink(missing_ok=True)


def run_digest(estimator: Pretrained, name: str, corpus: Corpus, seed: int) -> str:
    """Digest of all that decides what is learnt."""
    what = [name, get_settings(estimator), corpus.digest, seed, package_version()]
    return hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()[:12]


def train(
    estimator: Pretrained,
    name: str,
    corpus: Corpus,
    seed: int,
    out: Path,
    command: str,
    progress: Progress = lambda text, share: None,
) -> Pretrained:
    """Teach `estimator` and write it to `out` (.safetensors). Raises ConfigError, StorageError."""
    purpose = run_digest(estimator, name, corpus, seed)
    checkpoint = FileCheckpoint(out.with_name(f".{out.name}.unfinished"), purpose)
    drives = []
    for k in range(corpus.number):
        if k % 10 == 0:
            progress(f"driving, {k} of {corpus.number}", SIMULATION_SHARE * k / corpus.number)
        drives.append(estimator.training_example(*corpus.simulate_drive(k)))
    learnt = estimator.pretrain(
        drives,
        corpus.vehicle,
        seed,
        lambda text, share: progress(text, SIMULATION_SHARE + (1.0 - SIMULATION_SHARE) * share),
        checkpoint,
    )
    if isinstance(learnt, Calibratable):
        progress("making standard deviations honest", 1.0)
        more = range(corpus.number, corpus.number + math.ceil(CALIBRATION_SHARE * corpus.number))
        drives = [learnt.training_example(*corpus.simulate_drive(k, True)) for k in more]
        learnt = learnt.calibrate(drives)
    about = {"command": command, "seed": str(seed), "corpus": corpus.digest, "digest": purpose}
    weights_io.save(learnt, out, about)
    checkpoint.done()
    return learnt
