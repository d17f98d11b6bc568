"""Composite roads: the surfaces of their parts, lengths, and errors."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from road_envs.core.config import ConfigError
from road_envs.roads import Road, load_road, with_length
from road_envs.roads.composite import (
    Concatenated,
    FixedSeed,
    Flat,
    Offset,
    Scaled,
    Superposed,
    Tiled,
    WithAprons,
)
from road_envs.roads.iso8608 import Iso8608

ISO = Iso8608(road_class="C", length=20.0)
BUMP = load_road("bump_small")


def rng(seed=0):
    return np.random.default_rng(seed)


def test_aprons_are_level_before_and_after_the_road():
    alone = ISO.realise(rng())
    surface = WithAprons(road=ISO, before=5.0, after=7.0).realise(rng())
    assert surface.end == pytest.approx(32.0)
    np.testing.assert_array_equal(surface.height(np.linspace(0.0, 5.0, 40)), 0.0)
    s = np.linspace(0.0, 20.0, 333)
    np.testing.assert_allclose(surface.height(5.0 + s), alone.height(s), atol=1e-10)
    end = surface.height(np.linspace(25.0, 32.0, 40))
    np.testing.assert_allclose(end, alone.z[:, -1:] * np.ones(40), atol=1e-12)


def test_an_offset_road_shifts_each_wheel_path():
    alone = BUMP.realise(rng())
    road = Offset(road=BUMP, left=0.25, right=1.5)
    surface, s = road.realise(rng()), np.linspace(-1.0, BUMP.length + 1.0, 999)
    assert road.length == BUMP.length + 1.5
    np.testing.assert_allclose(surface.height(s + 0.25)[0], alone.height(s)[0], atol=1e-10)
    np.testing.assert_allclose(surface.height(s + 1.5)[1], alone.height(s)[1], atol=1e-10)


@settings(max_examples=40)
@given(st.floats(-3.0, 3.0).filter(lambda x: abs(x) > 0.01), st.floats(0.1, 5.0))
def test_a_scaled_road_has_scaled_heights_and_lengths(height, length):
    alone = ISO.realise(rng())
    road = Scaled(road=ISO, height_factor=height, length_factor=length)
    surface, s = road.realise(rng()), np.linspace(0.0, 20.0, 100)
    assert surface.end == pytest.approx(road.length) == pytest.approx(20.0 * length)
    np.testing.assert_allclose(surface.height(length * s), height * alone.height(s), atol=1e-9)
    np.testing.assert_allclose(
        surface.slope(length * s), height / length * alone.slope(s), atol=1e-6
    )


@pytest.mark.parametrize(("repeat", "sign"), [("repeat", 1.0), ("mirror", -1.0)])
def test_a_tiled_road_repeats_one_draw(repeat, sign):
    surface = Tiled(road=ISO, length=90.0, repeat=repeat).realise(rng(4))
    s = np.linspace(0.0, 20.0, 200)
    for start in (40.0, 80.0) if repeat == "mirror" else (20.0, 40.0, 60.0):
        there = surface.height(start + sign * s[:100])
        np.testing.assert_allclose(there, surface.height(s[:100]), atol=1e-10)
    assert surface.end == pytest.approx(90.0)
    assert "times to 90 m" in surface.notes[-1]
    alone = ISO.realise(rng(4))
    rise = alone.z[:, -1:] * s / 20.0 if repeat == "repeat" else 0.0
    np.testing.assert_allclose(surface.height(s), alone.height(s) - rise, atol=1e-5)


def test_concatenated_roads_follow_without_a_step():
    parts = (FixedSeed(road=ISO, seed=1), BUMP, FixedSeed(road=Iso8608(G_d0=1e-3, ds=0.04), seed=2))
    surface = Concatenated(roads=parts).realise(rng())
    assert surface.end == pytest.approx(20.0 + BUMP.length + 100.0)
    assert surface.ds == 0.005
    start = 0.0
    for part in parts:
        # the cubic of a surface alone is curved within one sample beyond its ends
        alone, s = part.realise(rng()), np.arange(0.05, part.length - 0.05, 0.005)
        moved = surface.height(start + s) - surface.height(start)[:, None]
        np.testing.assert_allclose(moved, alone.height(s), atol=1e-9)
        start += part.length


def test_an_appended_road_does_not_change_earlier_ones():
    two = Concatenated(roads=(ISO, ISO)).realise(rng(7))
    three = Concatenated(roads=(ISO, ISO, ISO)).realise(rng(7))
    np.testing.assert_array_equal(three.z[:, : two.z.shape[1]], two.z)
    first, second = two.z[:, :2001], two.z[:, 2000:] - two.z[:, 2000:2001]
    assert np.abs(first - second).max() > 0.01


def test_superposed_heights_add_up():
    parts = (FixedSeed(road=ISO, seed=1), BUMP, Flat(length=30.0))
    surface = Superposed(roads=parts).realise(rng())
    s = np.arange(0.0, 30.0, 0.005)
    expected = sum(part.realise(rng()).height(s) for part in parts)
    np.testing.assert_allclose(surface.height(s), expected, atol=1e-9)
    assert surface.end == pytest.approx(30.0)


# nested roads


leaves = st.one_of(
    st.builds(lambda x: {"kind": "flat", "length": x}, st.floats(0.5, 9.0)),
    st.builds(
        lambda x, n: {"kind": "iso8608", "road_class": "E", "length": x, "n_min": n, "ds": 0.05},
        st.floats(0.5, 9.0), st.floats(0.1, 1.0),
    ),
    st.just({"kind": "sine_sweep", "length": 6.0, "n_start": 0.3, "n_end": 2.0, "amplitude": 0.1,
             "amplitude_end": 0.01, "taper": 0.0}),
    st.just("bump_asymmetric"),
)  # fmt: skip
metres = st.floats(0.0, 5.0)


def wrapped(road):
    return st.one_of(
        st.builds(lambda r, a, b: {"kind": "with_aprons", "road": r, "before": a, "after": b},
                  road, metres, metres),
        st.builds(lambda r, a, b: {"kind": "offset", "road": r, "left": a, "right": b},
                  road, metres, metres),
        st.builds(lambda r, a, b: {"kind": "scaled", "road": r, "height_factor": a,
                                   "length_factor": b}, road, st.floats(-2.0, -0.1),
                  st.floats(0.3, 3.0)),
        st.builds(lambda r, a, b: {"kind": "tiled", "road": r, "length": a, "repeat": b},
                  road, st.floats(2.0, 60.0), st.sampled_from(["repeat", "mirror"])),
        st.builds(lambda k, r: {"kind": k, "roads": r},
                  st.sampled_from(["concatenated", "superposed"]),
                  st.lists(road, min_size=1, max_size=3)),
    )  # fmt: skip


@settings(max_examples=150)
@given(st.recursive(leaves, wrapped, max_leaves=6), st.integers(0, 2**32))
def test_nested_roads_fulfil_the_road_contract(mapping, seed):
    road = load_road(mapping)
    assert isinstance(road, Road) and hash(road) == hash(load_road(mapping))
    surface, again = road.realise(rng(seed)), road.realise(rng(seed))
    np.testing.assert_array_equal(surface.z, again.z)
    # an offset that is not a multiple of ds samples the curved cell before the first sample
    np.testing.assert_allclose(surface.z[:, 0], 0.0, atol=1e-12 + 0.1 * np.ptp(surface.z))
    assert surface.start == 0.0
    assert surface.end == pytest.approx(road.length, abs=surface.ds)


@settings(max_examples=15)
@given(st.integers(0, 2**32))
def test_a_wrapped_road_is_drawn_like_the_road_alone(seed):
    alone = ISO.realise(rng(seed)).z
    for road in (WithAprons(road=ISO, before=0.0, after=0.0), Offset(road=ISO), Scaled(road=ISO)):
        np.testing.assert_allclose(road.realise(rng(seed)).z, alone, atol=1e-12)


# lengths and settings


@pytest.mark.parametrize(
    "road",
    [WithAprons(road=ISO, before=4.0, after=3.0), Offset(road=ISO, left=2.0),
     Tiled(road=ISO, length=5.0),
     Scaled(road=WithAprons(road=ISO), length_factor=0.3), load_road("iso_c_varying")],
    ids=lambda road: type(road).__name__,
)  # fmt: skip
def test_a_road_made_of_one_other_can_be_resized(road):
    longer = with_length(road, 70.0)
    assert type(longer) is type(road)
    assert longer.length == pytest.approx(70.0)
    assert longer.realise(rng()).end == pytest.approx(70.0, abs=0.03)


@pytest.mark.parametrize(
    ("source", "reason"),
    [
        ({"name": "iso_changing", "length": 30.0}, "follows from its other settings"),
        ({"name": "iso_b_potholes", "length": 30.0}, "follows from its other settings"),
        ({"name": "washboard_oblique", "length": "30"}, "length must be a number"),
        ({"name": "washboard_oblique", "length": 0.1}, "length: must be positive"),
        ({"kind": "concatenated", "roads": []}, "roads: must have at least 1 element"),
        ({"kind": "superposed", "roads": []}, "roads: must have at least 1 element"),
        ({"kind": "superposed", "roads": ["flat", "flot"]}, "did you mean 'flat'"),
        ({"kind": "concatenated", "roads": "flat"}, "roads"),
        ({"kind": "with_aprons", "road": "flat", "before": -1.0}, "before: must not be negative"),
        ({"kind": "offset", "road": "flat", "right": float("inf")}, "right: must be finite"),
        ({"kind": "scaled", "road": "flat", "height_factor": 0.0}, "height_factor must not be 0"),
        ({"kind": "scaled", "road": "flat", "length_factor": -1.0}, "length_factor"),
        ({"kind": "tiled", "road": "flat", "length": 5.0, "repeat": "none"}, "repeat"),
        ({"kind": "tiled", "road": "flat", "length": 0.0}, "length: must be positive"),
    ],
)
def test_an_invalid_composition_is_named_in_one_sentence(source, reason):
    with pytest.raises(ConfigError) as error:
        load_road(source)
    assert reason in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "road",
    [WithAprons(road=BUMP, before=1e9), Offset(road=BUMP, right=1e9), Tiled(road=BUMP, length=1e9),
     Concatenated(roads=(BUMP, WithAprons(road=Flat(), after=1e9)))],
    ids=lambda road: type(road).__name__,
)  # fmt: skip
def test_a_road_with_too_many_samples_is_rejected_when_drawn(road):
    with pytest.raises(ConfigError, match="more than 50,000,000 samples"):
        road.realise(rng())


def test_nested_file_paths_are_relative_to_their_yaml_file(tmp_path):
    (tmp_path / "short.csv").write_text("".join(f"{k},{k % 3}\n" for k in range(9)))
    scaled = "{kind: scaled, road: {kind: measured, path: short.csv}}"
    text = f"kind: concatenated\nroads: [flat, {scaled}]\n"
    (tmp_path / "road.yaml").write_text(text)
    assert load_road(tmp_path / "road.yaml").length == 108.0


def test_a_random_level_is_uniform_in_decibels_and_leaves_the_road_as_it_is():
    road = load_road({"kind": "random_level", "level": [-9.0, 3.0], "road": "iso_d"})
    inner = load_road("iso_d")
    levels = []
    for seed in range(60):
        z = road.realise(np.random.default_rng(seed)).z
        y = inner.realise(np.random.default_rng(seed)).z
        gain = (z * y).sum() / (y * y).sum()
        np.testing.assert_allclose(z, gain * y, atol=1e-12)
        levels.append(20.0 * np.log10(gain))
    assert stats.kstest(levels, "uniform", (-9.0, 12.0)).pvalue > 0.01
    assert -9.0 <= min(levels) and max(levels) <= 3.0
    with pytest.raises(ConfigError, match="smallest and the largest"):
        load_road({"kind": "random_level", "level": [3.0, -3.0], "road": "iso_d"})
