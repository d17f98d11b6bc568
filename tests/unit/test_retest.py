"""What a second guest is asked: drives that go on in another way from a secret point on."""

import numpy as np
import pytest
from scipy.signal import butter, sosfiltfilt

from leaderboard.sandbox.retest import with_other_future
from road_envs import simulate_record


@pytest.fixture(scope="module")
def record():
    return simulate_record("iso_d", speed_kmh=54, length=100.0, seed=3)[0]


@pytest.mark.parametrize("seed", range(4))
def test_no_level_of_what_follows_is_left_and_what_came_before_is(record, seed):
    """Of a level in steps of 6 dB, or of the slow waves, an entry would know without being seen."""
    start = 45.0
    other = with_other_future(record, start, np.random.default_rng(seed))
    before = record.s < start
    for name in ("a", "v", "s"):
        ours, theirs = (np.asarray(getattr(x, name)) for x in (record, other))
        np.testing.assert_array_equal(ours[..., before], theirs[..., before])
    slow = butter(4, (1.0, 15.0), "bandpass", fs=record.fs, output="sos")
    levels = [
        20.0 * np.log10(np.std(sosfiltfilt(slow, x.a[:, ~before], axis=1), axis=1))
        for x in (record, other)
    ]
    assert (np.abs(levels[1] - levels[0]) > 3.0).all()
    waves = [sosfiltfilt(slow, x.a[:, ~before], axis=1).ravel() for x in (record, other)]
    assert abs(np.corrcoef(*waves)[0, 1]) < 0.3
