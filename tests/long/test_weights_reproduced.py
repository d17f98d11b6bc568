"""The shipped weights are reproduced by the command that their files name."""

import numpy as np
import pytest
from test_pretrained_weights import WINDOWS, nearly_equal, read_shipped

from estimators import create
from leaderboard import pretraining
from leaderboard.evaluation.tasks import load_task
from leaderboard.evaluation.test_data import simulate_drives
from leaderboard.metrics.heights import nrmse, scored_band
from road_envs.drives.training_corpus import Corpus

SEED_SPREAD = 0.05
"""Relative change of the mean NRMSE that another seed or order of summation may cause."""


def train_again(name: str, path):
    """The result of `road-recon train NAME` with the seed of the shipped file."""
    about = read_shipped(name)[1]
    return pretraining.train(
        create(name), name, Corpus(), int(about["seed"]), path, about["command"]
    )


def mean_error(estimator) -> float:
    """In-band NRMSE over all conditions of the main board, one road of each of two families."""
    task, found = load_task("new_road"), []
    for condition in task.conditions:
        for drive in simulate_drives(task, task.with_test_drives(2).test, condition):
            z = estimator.estimate(drive.record, task.vehicle).z
            band = scored_band(condition.speed_kmh / 3.6)
            found.append(nrmse(drive.truth.z, z, drive.truth.ds, band).pooled)
    return float(np.mean(found))


@pytest.mark.slow
def test_the_shipped_fir_taps_are_reproduced_by_their_command(tmp_path):
    fresh = train_again("fir_ridge", tmp_path / "bank.safetensors").weights()
    assert nearly_equal(fresh["bank"], read_shipped("fir_ridge")[0]["bank"])


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in WINDOWS if name != "fir_ridge"])
def test_shipped_networks_are_reproduced_within_the_spread_of_seeds(name, tmp_path):
    fresh = mean_error(train_again(name, tmp_path / "network.safetensors"))
    assert fresh == pytest.approx(mean_error(create(name)), rel=SEED_SPREAD)
