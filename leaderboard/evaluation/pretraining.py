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
from estimators.api import Calibrated, Teachable
from leaderboard.evaluation.evaluate import settings_of
from leaderboard.evaluation.provenance import version
from road_envs.data.training_corpus import Corpus

Progress = Callable[[str, float], None]
SIMULATED = 0.15
"""Share of the time that the drives take."""

UNTAUGHT = 0.5
"""Drives by the car as described that standard deviations are made honest on, per drive taught."""


class FileKeeper:
    """An unfinished state in a file; one of another `purpose` is as good as none."""

    def __init__(self, path: Path, purpose: str):
        self.path, self.purpose = path, purpose

    def load(self) -> dict[str, np.ndarray] | None:
        """The state, if there is one that fits."""
        if not self.path.exists():
            return None
        try:
            arrays, about = pretrained_weights.read(self.path)
        except pretrained_weights.WeightsError:
            return None
        return arrays if about.get("purpose") == self.purpose else None

    def save(self, state: Mapping[str, np.ndarray]) -> None:
        """Keep a state, whole or not at all."""
        pretrained_weights.write(self.path, state, {"purpose": self.purpose})

    def done(self) -> None:
        """Nothing is left to be kept."""
        self.path.unlink(missing_ok=True)


def purpose_of(estimator: Teachable, name: str, corpus: Corpus, seed: int) -> str:
    """Digest of all that decides what is learnt."""
    what = [name, settings_of(estimator), corpus.digest, seed, version()]
    return hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()[:12]


def train(
    estimator: Teachable,
    name: str,
    corpus: Corpus,
    seed: int,
    out: Path,
    command: str,
    progress: Progress = lambda text, share: None,
) -> Teachable:
    """Teach `estimator` and write it to `out` (.safetensors). Raises ConfigError, StorageError."""
    purpose = purpose_of(estimator, name, corpus, seed)
    keeper = FileKeeper(out.with_name(f".{out.name}.unfinished"), purpose)
    drives = []
    for k in range(corpus.number):
        if k % 10 == 0:
            progress(f"driving, {k} of {corpus.number}", SIMULATED * k / corpus.number)
        drives.append(estimator.material(*corpus.drive(k)))
    learnt = estimator.learn(
        drives,
        corpus.vehicle,
        seed,
        lambda text, share: progress(text, SIMULATED + (1.0 - SIMULATED) * share),
        keeper,
    )
    if isinstance(learnt, Calibrated):
        progress("making standard deviations honest", 1.0)
        more = range(corpus.number, corpus.number + math.ceil(UNTAUGHT * corpus.number))
        learnt = learnt.calibrated([learnt.material(*corpus.drive(k, True)) for k in more])
    about = {"command": command, "seed": str(seed), "corpus": corpus.digest, "digest": purpose}
    weights_io.save(learnt, out, about)
    keeper.done()
    return learnt
