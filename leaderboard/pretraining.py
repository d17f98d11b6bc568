"""Training on a simulated corpus: pretrained estimators, and the regression on RMS.

An interrupted run continues from the checkpoint beside the output file if corpus, settings, seed
and the code of simulator and estimator are the same. The drives are simulated again, which is the
smaller part of the time.
"""

import hashlib
import json
import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np

from estimators import pretrained_weights, registry, weights_io
from estimators.api import DeviationCalibratable, Pretrained, Trainable
from estimators.roughness.rms_regression import RmsRoughness, RoughnessEstimate
from estimators.wiener.segments import dominant_modes
from leaderboard.evaluation.evaluate import get_settings
from leaderboard.evaluation.provenance import package_version
from road_envs.core.artifacts import Kind
from road_envs.core.config import ConfigError
from road_envs.drives.training_corpus import Corpus, drives_in_mode
from road_envs.records.record import Record

_SIMULATION_SHARE = 0.15  # of the run time, for the progress bar
_CALIBRATION_SHARE = 0.3  # drives of the nominal vehicle for deviations, per training drive
_N_DRIVES, _SPEED_MARGIN = 60, 1.5  # of the regression on RMS; factor around the speeds of a record


class _FileCheckpoint:
    """State of an unfinished training run in a file; the file of another run is ignored."""

    def __init__(self, path: Path, digest: str):
        self.path, self.digest = path, digest

    def load(self) -> dict[str, np.ndarray] | None:
        """Return the stored state, or None if there is none of this run."""
        with suppress(pretrained_weights.StorageError):
            arrays, metadata = pretrained_weights.read_weights(self.path)
            if metadata.get("run") == self.digest:
                return arrays
        return None

    def save(self, state: Mapping[str, np.ndarray]) -> None:
        pretrained_weights.write_weights(self.path, state, {"run": self.digest})


def _run_digest(estimator: Pretrained, name: str, corpus: Corpus, seed: int) -> str:
    inputs = [name, get_settings(estimator), corpus.digest, seed, package_version()]
    return hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()[:12]


def _checkpoint(estimator: Pretrained, out: Path, digest: str) -> _FileCheckpoint:
    kind = Kind("checkpoint", 1, (__name__, type(estimator).__module__))
    return _FileCheckpoint(out.with_name(f".{out.name}.unfinished"), kind.identity(digest))


def train(
    estimator: Trainable,
    name: str,
    corpus: Corpus,
    seed: int,
    out: Path,
    command: str,
    progress: Callable[[str, float], None] = lambda text, share: None,
) -> Pretrained:
    """Pretrain `estimator`, which is called `name`, and write it to `out` (.safetensors).

    Raises ConfigError for an estimator of one speed and mode, and for another suffix.
    """
    if not isinstance(estimator, Pretrained):
        raise ConfigError(
            f"{name} is trained for one speed and mode: give training roads with --road; "
            f"pretraining on the corpus is possible for {', '.join(registry.pretrainable())}"
        )
    if out.suffix != ".safetensors":
        raise ConfigError(f"{out}: the name must end in .safetensors for weights from the corpus")
    digest = _run_digest(estimator, name, corpus, seed)
    checkpoint = _checkpoint(estimator, out, digest)
    drives = []
    for k in range(corpus.number):
        if k % 10 == 0:
            progress(f"simulating, {k} of {corpus.number}", _SIMULATION_SHARE * k / corpus.number)
        drives.append(estimator.training_example(*corpus.simulate_drive(k)))

    def shown(text: str, share: float) -> None:
        progress(text, _SIMULATION_SHARE + (1.0 - _SIMULATION_SHARE) * share)

    trained = estimator.pretrain(drives, corpus.vehicle, seed, shown, checkpoint)
    if isinstance(trained, DeviationCalibratable):
        progress("calibrating standard deviations", 1.0)
        more = range(corpus.number, corpus.number + math.ceil(_CALIBRATION_SHARE * corpus.number))
        drives = [trained.training_example(*corpus.simulate_drive(k, True)) for k in more]
        trained = trained.calibrate_deviations(drives)
    metadata = {"command": command, "seed": str(seed), "corpus": corpus.digest, "digest": digest}
    weights_io.save(trained, out, metadata)
    checkpoint.path.unlink(missing_ok=True)
    return trained


def rms_roughness(record: Record, corpus: Corpus) -> RoughnessEstimate:
    """Roughness of a record by the regression on its RMS, fitted to simulated drives like it.

    They are of individuals of the vehicle of `corpus` and of its instruments (grade S2), in the
    record's mode and at its speeds: a car that is as described would teach too narrow an interval.
    """
    mode = dominant_modes(record, np.arange(record.t.size), corpus.vehicle.modes)
    slow, fast = 3.6 * np.percentile(record.v, [5.0, 95.0])
    speeds = slow / _SPEED_MARGIN, fast * _SPEED_MARGIN
    drives = drives_in_mode(corpus, mode, speeds, _N_DRIVES, "S2")
    return RmsRoughness.fit(*zip(*drives, strict=True)).predict(record)
