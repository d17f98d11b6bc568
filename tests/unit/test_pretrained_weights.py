"""The shipped weights are those that their command produces."""

from functools import cache

import numpy as np
import pytest

from estimators import create, pretrained_weights
from estimators.common.pretrained import STATIONS_AHEAD, STATIONS_BEHIND, TrainingExample
from estimators.linear.fir_bank import FirBank
from road_envs.drives.training_corpus import Corpus

RARE = (
    *(79, 264, 344, 578, 648, 674, 835, 858, 1033, 1040, 1050, 1103, 1195, 1251),
    *(1359, 1403, 1430, 1513, 1615, 1761, 1839, 1910, 1932, 1937, 1974, 1982, 1992),
)
"""The drives of the corpus with stiff springs and low damping in front and ride mode at the rear:
the rarest combination of states.
"""

STIFF_LOW_AND_RIDE = 0b1000
NETWORKS = ("tcn", "tcn_causal", "gru", "gru_causal")
WINDOWS = {"fir_ridge": "bank"} | dict.fromkeys(NETWORKS, "taps")
"""Names of the FIR taps in the weight files that were trained on the corpus as it is."""


def read_shipped(name: str):
    """Arrays and metadata of a shipped file."""
    return pretrained_weights.read_weights(pretrained_weights.FOLDER / f"{name}.safetensors")


MOVED = 0.002
"""Largest change of a tap, over the largest tap, by the rounding of sums."""


def nearly_equal(fresh: np.ndarray, stored: np.ndarray) -> bool:
    """Whether arrays are equal up to MOVED."""
    apart = np.abs(fresh.astype(float) - stored.astype(float))
    return bool(apart.max() < MOVED * np.abs(stored).max())


@cache
def rare_drives():
    """Records and true profiles of the rarest combination."""
    return [Corpus().simulate_drive(k) for k in RARE]


@cache
def rare_taps(causal: bool, flexible: bool) -> np.ndarray:
    """Taps of the rarest combination, fitted to flexible bodies too or to rigid ones only; they
    depend on its own drives only.
    """
    drives = [
        TrainingExample.of(record, truth, causal)
        for record, truth, rigid in rare_drives()
        if rigid or flexible
    ]
    assert all((drive.signals.states == [1.0, 0.0, 0.0, 0.0]).all() for drive in drives)
    all_signals, targets, _ = zip(*drives, strict=True)
    ahead = STATIONS_AHEAD if causal else STATIONS_BEHIND
    return FirBank.fit(all_signals, targets, STATIONS_BEHIND, ahead).taps[STIFF_LOW_AND_RIDE]


@pytest.mark.parametrize(("name", "array"), WINDOWS.items())
@pytest.mark.costly
def test_shipped_fir_taps_match_the_corpus_as_simulated_now(name, array):
    """A change of simulator, road or corpus requires new weights."""
    arrays, _ = read_shipped(name)
    fresh = rare_taps(create(name).causal, flexible=name == "fir_ridge")
    assert nearly_equal(fresh, arrays[array][STIFF_LOW_AND_RIDE])


@pytest.mark.parametrize("name", NETWORKS)
def test_weight_files_hold_half_precision_and_little_else(name):
    arrays, _ = read_shipped(name)
    precise = {key for key, x in arrays.items() if x.dtype != np.float16}
    assert precise == {"widths", "wheelbase"}
    assert all(np.isfinite(x).all() for x in arrays.values())
