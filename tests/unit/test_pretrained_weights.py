"""The shipped weights are those that their command produces."""

from functools import cache

import numpy as np
import pytest

from estimators import create, pretrained_weights
from estimators.common.training_data import training_example
from estimators.linear.fir_bank import fit_bank
from estimators.networks.inputs import window_span
from road_envs.data.training_corpus import Corpus

RARE = (79, 264, 344, 578, 648, 674, 835, 858, 1033, 1040, 1050, 1103, 1195)
"""The drives of the corpus with stiff springs and low damping in front and ride mode at the rear:
the rarest combination of states.
"""

STIFF_LOW_AND_RIDE = 0b1000
NETWORKS = ("tcn", "tcn_causal", "gru", "gru_causal")
WINDOWS = {"fir_ridge": "bank"} | dict.fromkeys(NETWORKS, "taps")
"""Names of the FIR taps in the weight files."""


def read_shipped(name: str):
    """Arrays and metadata of a shipped file."""
    return pretrained_weights.read_weights(pretrained_weights.FOLDER / f"{name}.safetensors")


MOVED = 0.01
"""Largest change of a tap, over the largest tap, since the weights were trained: the simulator has
divided steps over steep edges and another gas spring near its end since, which moves taps by up to
0.0075. Where weights are trained anew this becomes 0.002, for the rounding of sums.
"""


def nearly_equal(fresh: np.ndarray, stored: np.ndarray) -> bool:
    """Whether arrays are equal up to MOVED."""
    apart = np.abs(fresh.astype(float) - stored.astype(float))
    return bool(apart.max() < MOVED * np.abs(stored).max())


@cache
def rare_taps(causal: bool) -> np.ndarray:
    """Taps of the rarest combination; they depend on its own drives only."""
    pairs = [Corpus().simulate_drive(k) for k in RARE]
    drives = [training_example(record, truth, causal) for record, truth in pairs]
    assert all((drive.signals.states == [1.0, 0.0, 0.0, 0.0]).all() for drive in drives)
    all_signals, targets = zip(*drives, strict=True)
    return fit_bank(all_signals, targets, *window_span(causal)).taps[STIFF_LOW_AND_RIDE]


@pytest.mark.parametrize(("name", "array"), WINDOWS.items())
def test_shipped_fir_taps_match_the_corpus_as_simulated_now(name, array):
    """A change of simulator, road or corpus requires new weights."""
    arrays, _ = read_shipped(name)
    assert nearly_equal(rare_taps(create(name).causal), arrays[array][STIFF_LOW_AND_RIDE])


def test_all_pretrained_estimators_share_the_same_fir_taps():
    for causal in (False, True):
        banks = [
            read_shipped(name)[0][array]
            for name, array in WINDOWS.items()
            if create(name).causal == causal
        ]
        for bank in banks[1:]:
            np.testing.assert_array_equal(bank, banks[0])


@pytest.mark.parametrize("name", NETWORKS)
def test_weight_files_hold_half_precision_and_little_else(name):
    arrays, _ = read_shipped(name)
    precise = {key for key, x in arrays.items() if x.dtype != np.float16}
    assert precise == {"widths", "wheelbase"}
    assert all(np.isfinite(x).all() for x in arrays.values())
