"""Half sines, potholes and sweeps against their closed forms."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles_roads import half_sine, sweep_height, trapezoid

from road_envs.core.config import ConfigError
from road_envs.roads import load_road
from road_envs.roads.obstacles import Defect, Defects, Potholes
from road_envs.roads.sine_sweep import SineSweep


def rng(seed=0):
    return np.random.default_rng(seed)


# half sines and potholes


@given(
    st.floats(5.0, 30.0), st.floats(0.02, 4.0), st.floats(-0.3, 0.3).filter(bool),
    st.sampled_from(["left", "right", "both"]),
)  # fmt: skip
def test_a_half_sine_has_its_shape_on_its_wheel_path_only(at, length, height, side):
    bump = Defect(shape="half_sine", at=at, length=length, height=height, side=side)
    surface = Defects(defects=(bump,), length=40.0).realise(rng())
    expected = half_sine(surface.s, at, height, length)
    for name, path in zip(("left", "right"), surface.z, strict=True):
        np.testing.assert_allclose(path, expected if side in (name, "both") else 0.0, atol=1e-12)


def test_a_sampled_half_sine_keeps_its_area():
    bump = Defect(shape="half_sine", at=5.0, length=0.5, height=0.05)
    s = np.linspace(4.0, 6.0, 200_001)
    z = Defects(defects=(bump,), length=10.0).realise(rng()).height(s)[0]
    assert np.trapezoid(z, s) == pytest.approx(2.0 / np.pi * 0.05 * 0.5, rel=1e-3)


@given(
    st.floats(5.0, 30.0), st.floats(0.2, 2.0), st.floats(0.01, 0.3), st.floats(0.05, 0.45),
)  # fmt: skip
def test_a_pothole_is_a_trapezoid(at, length, depth, share):
    edge = share * length
    hole = Defect(shape="pothole", at=at, length=length, height=-depth, edge=edge)
    surface = Defects(defects=(hole,), length=40.0).realise(rng())
    expected = trapezoid(surface.s, at, -depth, edge, length - 2.0 * edge)
    np.testing.assert_allclose(surface.z, [expected, expected], atol=1e-12)


def test_growing_defects_form_a_row_with_a_growth_of_1_5():
    surface = load_road("growing_defects").realise(rng())
    expected = np.zeros_like(surface.z)
    for k in range(6):
        height = 0.01 * 1.5**k
        expected[0] += half_sine(surface.s, 15.0 + 15.0 * k, height, 0.6)
        expected[1] += trapezoid(surface.s, 20.0 + 15.0 * k, -height, 0.1, 0.4)
    np.testing.assert_allclose(surface.z, expected, atol=1e-12)


def test_heights_of_overlapping_defects_add_up():
    one = Defect(shape="half_sine", at=5.0, length=1.0, height=0.05)
    other = Defect(shape="half_sine", at=5.3, length=2.0, height=-0.02)
    both = Defects(defects=(one, other), length=10.0).realise(rng()).z
    alone = [Defects(defects=(x,), length=10.0).realise(rng()).z for x in (one, other)]
    np.testing.assert_allclose(both, alone[0] + alone[1], atol=1e-15)


BUMP = {"shape": "half_sine", "at": 10.0, "length": 1.0, "height": 0.05}
HOLE = {"shape": "pothole", "at": 10.0, "length": 1.0, "height": -0.05, "edge": 0.1}


@pytest.mark.parametrize(
    ("defect", "reason"),
    [
        ({**BUMP, "shape": "hump"}, "shape"),
        ({**BUMP, "height": 0.0}, "height that is not 0"),
        ({**BUMP, "height": float("nan")}, "height: must be finite"),
        ({**BUMP, "height": 11.0}, "higher than 10 m"),
        ({**BUMP, "edge": 0.1}, "no edge"),
        ({**BUMP, "length": 0.01}, "defects.0.length: must be at least 0.02"),
        ({**BUMP, "at": 0.4}, "from -0.1 to 0.9 m are not on a road of 100 m"),
        ({**BUMP, "count": 10, "spacing": 10.0}, "from 9.5 to 100.5 m"),
        ({**BUMP, "count": 0}, "count: must be at least 1"),
        ({**BUMP, "count": 10**400, "spacing": 1.0}, "count: must be at most 1e+09"),
        ({**BUMP, "count": 3}, "overlap"),
        ({**BUMP, "count": 1_000_000_000, "spacing": 1e-9}, "overlap"),
        ({**BUMP, "count": 1_000_000_000, "spacing": 1.0}, "are not on a road"),
        ({**BUMP, "count": 9, "spacing": 5.0, "growth": 2.0}, "higher than 10 m"),
        ({**BUMP, "growth": 0.0}, "growth: must be positive"),
        ({**HOLE, "height": 0.05}, "height below 0"),
        ({**HOLE, "edge": 0.5}, "0 < edge < length / 2"),
        ({**HOLE, "edge": 0.0}, "0 < edge < length / 2"),
    ],
)  # fmt: skip
def test_an_invalid_defect_is_named_in_one_sentence(defect, reason):
    with pytest.raises(ConfigError) as error:
        load_road({"kind": "defects", "defects": [defect]})
    assert reason in str(error.value)
    assert "\n" not in str(error.value)


# random potholes


def holes(path, ds=0.005):
    """Return size [m] and depth [m] of each connected hole of a wheel path."""
    edges = np.flatnonzero(np.diff(np.r_[0, (path < 0.0).astype(int), 0]))
    return [((b - a) * ds, -path[a:b].min()) for a, b in edges.reshape(-1, 2)]


def test_random_potholes_have_the_specified_rate_size_and_depth():
    road = Potholes(length=2000.0, rate=0.01)
    paths = np.concatenate([road.realise(rng(seed)).z for seed in range(10)])
    assert paths.max() == 0.0
    actual = [hole for path in paths for hole in holes(path)]
    expected = 20 * 20.0  # overlapping holes count once, about 1 in 100
    assert abs(len(actual) - 0.99 * expected) < 4.0 * np.sqrt(expected)
    size, depth = np.array(actual).T
    assert depth.min() > 0.025 - 0.01 and depth.max() < 0.075  # a floor can be between samples
    assert np.median(depth) == pytest.approx(0.05, abs=4 * 0.0144 / np.sqrt(len(actual)) + 1e-3)
    alone = size[size < 0.8]
    assert alone.min() > 0.15 - 0.01
    assert alone.mean() == pytest.approx(0.475, abs=4 * 0.188 / np.sqrt(len(actual)) + 0.01)


def test_potholes_are_uniform_and_independent_on_the_wheel_paths():
    road = Potholes(length=50.0, rate=0.4)  # 10,001 samples per path
    where = np.mean([road.realise(rng(seed)).z < 0.0 for seed in range(300)], axis=0)
    thirds = where[:, 200:-201].reshape(2, 3, -1).mean(axis=-1)
    np.testing.assert_allclose(thirds, thirds.mean(), rtol=0.1)
    z = Potholes(length=5000.0, rate=0.2).realise(rng()).z
    assert abs(np.corrcoef(z)[0, 1]) < 4.0 / np.sqrt(5000.0 / 0.475)


def test_overlapping_potholes_take_the_greater_depth():
    z = Potholes(length=20.0, rate=20.0, depth=(0.05, 0.05)).realise(rng()).z
    assert z.min() == pytest.approx(-0.05)


@pytest.mark.parametrize(
    ("setting", "reason"),
    [
        ({"depth": [0.05, 0.02]}, "depth: must be the smallest and the largest value"),
        ({"depth": [0.05]}, "depth"),
        ({"size": [0.05, 0.8]}, "more than two edges"),
        ({"size": [0.2, 800.0]}, "at most the length 100"),
        ({"rate": -1.0}, "rate: must be positive"),
        ({"rate": 1e9}, "samples"),
        ({"length": 1e12}, "samples"),
    ],
)
def test_invalid_potholes_are_named_in_one_sentence(setting, reason):
    with pytest.raises(ConfigError) as error:
        load_road({"kind": "potholes", **setting})
    assert reason in str(error.value)


# sweeps


@given(
    st.floats(0.05, 2.0), st.floats(0.05, 2.0), st.sampled_from(["linear", "logarithmic"]),
    st.floats(1e-3, 0.1), st.floats(1e-3, 0.1), st.floats(10.0, 90.0),
)  # fmt: skip
def test_a_sweep_is_a_sine_of_the_integrated_frequency(start, end, progress, a, b, s):
    road = SineSweep(n_start=start, n_end=end, progress=progress, amplitude=a, amplitude_end=b)
    expected = sweep_height(s, 100.0, start, end, progress, a, b)
    assert road.height(np.array(s)) == pytest.approx(expected, abs=1e-9)
    surface = road.realise(rng())
    assert np.abs(surface.height(s) - expected).max() < 2e-4 * max(a, b)  # between the samples


@pytest.mark.parametrize(("progress", "cycles"), [("linear", 105.0), ("logarithmic", 63.423)])
def test_a_sweep_has_the_number_of_waves_of_its_law(progress, cycles):
    road = SineSweep(n_start=0.1, n_end=2.0, progress=progress, amplitude=0.01, amplitude_end=0.01)
    z = road.realise(rng()).z[0]
    assert 0.5 * np.count_nonzero(np.diff(np.sign(z[1:-1]))) == pytest.approx(cycles, abs=0.6)


def test_the_shipped_sweep_has_a_constant_maximum_slope():
    surface = load_road("sine_sweep").realise(rng())
    for start in (10.0, 30.0, 50.0, 70.0, 85.0):
        s = np.linspace(start, start + 10.0, 5000)
        assert np.abs(surface.slope(s)).max() == pytest.approx(2 * np.pi * 0.1 * 0.032, rel=0.02)


def test_a_tapered_sweep_joins_the_level_road_smoothly():
    surface = load_road("sine_sweep").realise(rng())
    for s in (0.0, 100.0):
        assert abs(surface.height(s)[0]) < 1e-12
        assert abs(surface.slope(s)[0]) < 1e-5
    half = load_road("sine_sweep").height(np.array([2.5, 97.5]))
    full = [sweep_height(s, 100.0, 0.1, 2.0, "logarithmic", 0.032, 0.0016) for s in (2.5, 97.5)]
    np.testing.assert_allclose(half, 0.5 * np.array(full), atol=1e-12)


@pytest.mark.parametrize(
    ("paths", "signs"),
    [("in_phase", (1, 1)), ("antiphase", (1, -1)), ("left", (1, 0)), ("right", (0, 1))],
)
def test_wheel_paths_of_a_sweep_have_their_signs(paths, signs):
    settings = dict(n_start=0.2, n_end=0.2, amplitude=0.05, amplitude_end=0.05)
    road = SineSweep(**settings, paths=paths)
    surface = road.realise(rng())
    np.testing.assert_array_equal(surface.z, np.outer(signs, road.height(surface.s)))


def test_the_twist_road_tilts_the_axles_in_opposite_directions():
    surface = load_road("twist").realise(rng())
    np.testing.assert_array_equal(surface.z[0], -surface.z[1])
    assert 0.8 < surface.z[0].max() - surface.z[0].min() < 0.9
    s = np.linspace(20.0, 50.0, 3000)
    tilt, later = (np.subtract(*surface.height(s + x)) for x in (0.0, 2.794))
    assert np.corrcoef(tilt, later)[0, 1] < -0.98  # the axles tilt in opposite directions


@pytest.mark.parametrize(
    ("setting", "reason"),
    [
        ({"n_end": 13.0}, "at most 1 / (8 ds) = 12.5 cycles/m"),
        ({"n_start": 0.0}, "n_start: must be positive"),
        ({"taper": 51.0}, "do not fit"),
        ({"taper": -1.0}, "taper: must not be negative"),
        ({"paths": "both"}, "paths"),
        ({"length": 1e12}, "samples"),
    ],
)
def test_an_invalid_sweep_is_named_in_one_sentence(setting, reason):
    sound = {"n_start": 0.1, "n_end": 1.0, "amplitude": 0.01, "amplitude_end": 0.01}
    with pytest.raises(ConfigError) as error:
        load_road({"kind": "sine_sweep", **sound, **setting})
    assert reason in str(error.value)
