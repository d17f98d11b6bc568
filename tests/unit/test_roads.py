"""Roads: contract of every road, configuration, bumps, and roads made of other roads."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles_roads import trapezoid

from road_envs.core.config import ConfigError, find, names, read_yaml
from road_envs.records.record import profile_stations
from road_envs.roads import KINDS, Road, load_road, with_length
from road_envs.roads.belgian import Belgian
from road_envs.roads.composite import FixedSeed, Flat, NoisyCopy
from road_envs.roads.iso8608 import Iso8608
from road_envs.roads.obstacles import Bumps, _Trapezoid

SHIPPED = names("roads")
RANDOM = ["belgian_like", "belgian_training", "iso_c"]


def rng(seed=0):
    return np.random.default_rng(seed)


# every road


@pytest.mark.parametrize("name", SHIPPED)
def test_every_shipped_road_fulfils_the_road_contract(name):
    road = load_road(name)
    assert isinstance(road, Road)
    surface, again = road.realise(rng(7)), road.realise(rng(7))
    assert np.isfinite(surface.z).all()
    np.testing.assert_array_equal(surface.z, again.z)
    np.testing.assert_array_equal(surface.z[:, 0], 0.0)
    assert surface.start == 0.0
    assert surface.end == pytest.approx(road.length, abs=surface.ds)
    assert hash(road) == hash(load_road(name))


@pytest.mark.parametrize("name", SHIPPED)
def test_a_surface_depends_on_the_generator_state_only(name):
    road, used = load_road(name), rng(7)
    state = used.bit_generator.state
    first = road.realise(used)
    used.bit_generator.state = state
    np.testing.assert_array_equal(road.realise(used).z, first.z)


@pytest.mark.parametrize("name", RANDOM)
def test_different_seeds_give_different_surfaces(name):
    road = load_road(name)
    assert np.abs(road.realise(rng(1)).z - road.realise(rng(2)).z).max() > 1e-3


def test_every_kind_of_road_is_shipped_or_read_from_a_file():
    shipped = {read_yaml(find("roads", name))["kind"] for name in SHIPPED}
    assert shipped == KINDS.keys() - {"measured"}


# configuration


@pytest.mark.parametrize(
    ("source", "reason"),
    [
        ("iso_z", "unknown road 'iso_z'"),
        ("nowhere.yaml", "nowhere.yaml"),
        (3, "got 3"),
        ({"length": 100.0}, "missing kind"),
        ({"kind": "iso8609"}, "did you mean 'iso8608'"),
        ({"kind": "iso8608"}, "exactly one of road_class and G_d0"),
        ({"kind": "iso8608", "road_class": "D", "G_d0": 1e-3}, "exactly one"),
        ({"kind": "iso8608", "road_class": "I"}, "road_class"),
        ({"kind": "iso8608", "G_d0": -1.0}, "G_d0: must be positive"),
        ({"kind": "iso8608", "G_d0": "16e-6"}, "G_d0"),
        ({"kind": "iso8608", "road_class": "A", "n_max": 60.0}, "n_max"),
        ({"kind": "iso8608", "road_class": "A", "n_min": 20.0}, "n_min"),
        ({"kind": "iso8608", "road_class": "A", "length": 0.02}, "length"),
        ({"kind": "belgian", "coherence": 0.9}, "coherence must be within 0 and 0.694"),
        ({"kind": "belgian", "peak": 1.0}, "peak"),
        ({"kind": "bumps", "layout": "large"}, "layout"),
        ({"kind": "bumps", "layout": "small", "ramp": 0.1}, "ramp: unknown key"),
        ({"kind": "bumps", "layout": "large_small", "spacing": 0.9}, "overlap"),
        ({"kind": "bumps", "layout": "small", "small": {"height": 0.1, "ramp": 0.0, "top": 1.0}},
         "small.ramp: must be positive, got 0.0 m"),
        ({"kind": "fixed_seed", "seed": 1}, "road: missing"),
        ({"kind": "fixed_seed", "road": "flat", "seed": -1}, "seed"),
        ({"kind": "fixed_seed", "road": "flat", "seed": 1.5}, "seed"),
        ({"kind": "fixed_seed", "seed": 1, "road": {"kind": "flat", "lenght": 3.0}}, "'length'"),
        ({"kind": "scaled", "road": {"kind": "noisy_copy", "road": "iso_x"}}, "'iso_x'"),
        ({"kind": "noisy_copy", "road": "flat", "noise": -0.1}, "noise"),
        ({"kind": "flat", "length": float("nan")}, "length"),
        ({"name": "iso_d", "w": 3.0}, "unknown ['w']"),
        ({"name": "bump_small", "length": 300.0}, "bumps"),
        ({"kind": "iso8608", "road_class": "A", "n_min": 1e-9}, "more than 50,000,000 samples"),
        ({"kind": "flat", "length": 1e12}, "samples"),
        ({"kind": "bumps", "layout": "small", "run_out": 1e12}, "samples"),
        ({"name": "iso_d", "length": -3.0}, "length: must be positive"),
        ({"name": "belgian", "length": "300"}, "length must be a number"),
    ],
)  # fmt: skip
def test_an_invalid_road_is_named_in_one_sentence(source, reason):
    with pytest.raises(ConfigError) as error:
        load_road(source)
    assert reason in str(error.value)
    assert "\n" not in str(error.value)


def test_a_nested_road_may_be_a_name_or_a_mapping():
    by_name = load_road({"kind": "fixed_seed", "seed": 3, "road": "iso_d"})
    mapping = {"kind": "iso8608", "road_class": "D", "length": 100.0}
    assert by_name == load_road({"kind": "fixed_seed", "seed": 3, "road": mapping})


def test_a_shipped_road_can_be_loaded_with_another_length():
    assert load_road({"name": "iso_d", "length": 300.0}) == Iso8608(road_class="D", length=300.0)


@pytest.mark.parametrize("name", ["flat", "iso_d", "belgian", "belgian_like", "belgian_training"])
def test_the_length_of_nested_roads_can_be_changed(name):
    road = with_length(load_road(name), 250.0)
    assert road.length == 250.0
    assert road.realise(rng()).end == pytest.approx(250.0, abs=0.02)


def test_the_length_of_bumps_cannot_be_changed():
    with pytest.raises(ConfigError, match="follows from its other settings"):
        with_length(load_road("bump_small"), 100.0)


# bumps

LAYOUTS = {
    "small": (["small"], ["small"]),
    "large_small": (["large", "small"], ["large", "small"]),
    "asymmetric": (["large", None], [None, "small"]),
}


def bump_heights(road, s):
    """Return heights (2, M) by the paper's description: run-in, first bump, then the spacing."""
    out = np.zeros((2, s.size))
    first = {"small": road.small, "large": road.large}[
        "small" if road.layout == "small" else "large"
    ]
    start = road.run_in + road.length_factor * (first.ramp + 0.5 * first.top)
    for side, sizes in enumerate(LAYOUTS[road.layout]):
        for k, size in enumerate(sizes):
            if size:
                block = getattr(road, size)
                x, h = road.length_factor, road.height_factor * block.height
                middle = start + k * road.spacing
                out[side] += trapezoid(s, middle, h, x * block.ramp, x * block.top)
    return out


@pytest.mark.parametrize("name", [n for n in SHIPPED if n.startswith("bump")])
def test_shipped_bumps_match_trapezoids_except_at_corners(name):
    road = load_road(name)
    s = np.arange(-2.0, road.length + 2.0, 0.0013)
    error = np.abs(road.realise(rng()).height(s) - bump_heights(road, s))
    assert error.max() < 0.3e-3  # limit of the rounding by the cubic at a corner
    assert (error > 1e-4).mean() < 0.005


def test_the_three_layouts_are_those_of_the_paper():
    small, both, cross = (load_road(f"bump_{k}") for k in ("small", "large_small", "asymmetric"))
    assert small.realise(rng()).z.max(axis=1) == pytest.approx([0.1, 0.1])
    z = both.realise(rng()).z
    np.testing.assert_array_equal(z[0], z[1])
    assert cross.realise(rng()).z.max(axis=1) == pytest.approx([0.15, 0.1])
    for road in (both, cross):
        left, right = (np.flatnonzero(z > 0.05) * 0.005 for z in road.realise(rng()).z)
        # 0.8 m, 0.45 m: half widths of the large and the small bump at the height of 0.05 m
        assert right[-1] - left[0] == pytest.approx(10.4 + 0.8 + 0.45, abs=0.02)


def test_training_bumps_are_scaled_by_10_percent_and_8_m_apart():
    for layout in ("small", "large_small", "asymmetric"):
        true = load_road(f"bump_{layout}")
        factors = {"p": 1.1, "m": 0.9}
        for a, b in ("pp", "pm", "mp", "mm"):
            training = load_road(f"bump_{layout}_training_{a}{b}")
            assert training == dataclasses.replace(
                true, spacing=8.0, length_factor=factors[a], height_factor=factors[b]
            )


@settings(deadline=None, max_examples=40)
@given(
    st.sampled_from(sorted(LAYOUTS)),
    st.floats(0.05, 0.5), st.floats(0.05, 1.0), st.floats(0.7, 1.3), st.floats(0.7, 1.3),
    st.floats(4.0, 20.0),
)  # fmt: skip
def test_samples_of_bumps_of_any_size_match_trapezoids(layout, ramp, top, x, h, spacing):
    road = Bumps(
        layout=layout, spacing=spacing, length_factor=x, height_factor=h,
        small=_Trapezoid(height=0.1, ramp=ramp, top=top),
    )  # fmt: skip
    surface = road.realise(rng())
    np.testing.assert_allclose(surface.z, bump_heights(road, surface.s), atol=1e-12)
    np.testing.assert_array_equal(surface.z[:, -1], 0.0)
    assert surface.end - road.length < road.ds


# roads made of roads

PAVING = [
    [0.0688453871, 0.0060346766, 0.0350033315, 0.0156217798],
    [0.0026297291, -0.0234214554, -0.0119282393, 0.0049574759],
]


def test_the_belgian_paving_is_a_fixed_surface():
    paving = load_road("belgian")
    z = paving.realise(rng(1)).z
    np.testing.assert_array_equal(z, paving.realise(rng(2)).z)
    # reference values detect any change of the surface: left and right at 25, 50, 75, 100 m
    np.testing.assert_allclose(z[:, [2500, 5000, 7500, 10000]], PAVING, atol=1e-9)


def test_a_fixed_road_does_not_use_the_generator():
    used = rng(5)
    load_road("belgian").realise(used)
    assert used.random() == rng(5).random()


def test_the_training_paving_is_the_paving_delayed_1_m_with_10_percent_noise():
    true = load_road("belgian").realise(rng())
    s = profile_stations(99.0)[1:]
    noise = []
    for seed in range(5):
        surface = load_road("belgian_training").realise(rng(seed))
        np.testing.assert_array_equal(surface.height(np.linspace(-3.0, 1.0, 50)), 0.0)
        moved = surface.height(s + 1.0)
        noise.append(moved - true.height(s))
    noise = np.array(noise)
    noise -= noise.mean(axis=-1, keepdims=True)
    ratio = noise.std(axis=-1) / true.z.std(axis=1)
    assert ratio == pytest.approx(0.1, rel=4.0 / np.sqrt(2.0 * s.size))
    flat = noise.reshape(10, -1)
    close = 5.0 / np.sqrt(s.size)
    np.testing.assert_allclose(np.corrcoef(flat), np.eye(10), atol=close)
    assert (
        np.abs([np.corrcoef(x[1:], x[:-1])[0, 1] for x in flat]).max() < close
    )  # white noise on the grid


CUBIC = 0.902  # RMS of the Catmull-Rom cubic through white noise, relative to its nodes


def test_noise_and_road_of_a_noisy_copy_are_drawn_independently():
    quiet, noisy = (
        NoisyCopy(road=Iso8608(road_class="C"), noise=x, delay=0.0).realise(rng(4))
        for x in (0.0, 0.1)
    )
    error = noisy.z - quiet.z
    ratio = error.std(axis=1) / quiet.z.std(axis=1)
    assert ratio == pytest.approx(0.1 * CUBIC, rel=0.05)  # 3964 nodes: standard error of 1.1 %
    assert np.corrcoef(error[0], quiet.z[0])[0, 1] == pytest.approx(0.0, abs=0.05)


def test_a_noisy_copy_without_noise_and_delay_equals_the_road():
    road = FixedSeed(road=Belgian(length=30.0), seed=1)
    same = NoisyCopy(road=road, noise=0.0, delay=0.0).realise(rng())
    np.testing.assert_allclose(same.z, road.realise(rng()).z, atol=1e-15)


def test_a_flat_road_has_no_height_and_slope():
    surface = Flat(length=12.3).realise(rng())
    s = np.linspace(-5.0, 20.0, 100)
    assert not surface.height(s).any()
    assert not surface.slope(s).any()
    assert surface.end == pytest.approx(12.3)
