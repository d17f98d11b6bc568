"""Normal numbers of kernels against NumPy's."""

import numpy as np
import pytest

from road_envs.kernels.normal_numbers import fill_normal, generator_state
from road_envs.kernels.simd import LANES


def drawn(rng, lane, shape):
    state, out = np.zeros((4, LANES), dtype=np.uint64), np.zeros((*shape, LANES))
    state[:, lane] = generator_state(rng)
    fill_normal(state, lane + 1, out)
    assert not out[:, :, lane + 1 :].any()
    return out[:, :, lane].T, state[:, lane]


def test_the_numbers_are_those_of_numpys_generator():
    rng = np.random.default_rng(5)
    ours, state = drawn(rng, 3, (3, 30_000))  # some thousand beside the layers, some in the tail
    np.testing.assert_allclose(ours, rng.standard_normal((30_000, 3)), rtol=1e-14)
    np.testing.assert_array_equal(state, generator_state(rng))
    assert np.abs(ours).max() > 3.7


@pytest.mark.parametrize("kind", [np.random.MT19937, np.random.Philox])
def test_a_generator_of_another_kind_gives_numbers_of_its_seed(kind):
    pair = [drawn(np.random.Generator(kind(seed)), 0, (1, 2000))[0] for seed in (1, 1, 2)]
    np.testing.assert_array_equal(pair[0], pair[1])
    assert abs(np.corrcoef(pair[0].T, pair[2].T)[0, 1]) < 0.1
    assert pair[0].std() == pytest.approx(1.0, abs=0.1)
