"""The bound of a score against the information bound of the road that was driven."""

import dataclasses

import numpy as np
import pytest
from fakes import task

from leaderboard.evaluation.bound import fit_spectrum, nrmse_bound
from leaderboard.evaluation.tasks import load_task
from leaderboard.metrics.api import ScoredEstimate
from leaderboard.metrics.registry import compute_scores
from leaderboard.metrics.roughness import THIRD_OCTAVES
from leaderboard.report.charts import _third_octave_bound
from road_envs.analysis.information_bound import RoadPrior, bound
from road_envs.core import config
from road_envs.records.record import Estimate, Profile, profile_stations, scored_band
from road_envs.roads import load_road
from road_envs.sensing.instruments import load_instruments
from road_envs.vehicle.parameters import load_vehicle


def realised(length=300.0, seed=3, **road):
    description = load_road({"kind": "iso8608", "length": length, **road})
    s = profile_stations(length)
    return Profile(s, description.realise(np.random.default_rng(seed)).height(s))


@pytest.mark.parametrize("place", [0, 1])
def test_the_bound_of_a_realised_road_is_that_of_its_class(place):
    t = task()
    condition = t.conditions[place]  # ride at 14.5, front ride and rear handling at 54 km/h
    found = nrmse_bound(t, condition, realised(road_class="D"))
    car, instruments = load_vehicle(t.car), load_instruments(t.instruments)
    expected = bound(
        car, condition.simulator_mode, condition.speed_kmh / 3.6, instruments, RoadPrior()
    )
    assert found == pytest.approx(expected.pooled, rel=0.1)
    assert found == pytest.approx((0.117, 0.0266)[place], rel=0.1)


def test_the_bound_is_that_of_the_car_of_the_condition():
    condition = {"mode": "passive", "speed_kmh": 54.0}
    own = task(car="van", conditions=[condition])
    other = task(car="bmw_320i", conditions=[condition])
    given = task(car="bmw_320i", conditions=[{**condition, "car": "van"}])
    of_road, of_octaves = (
        [find(t, t.conditions[0], *more) for t in (own, given, other)]
        for find, more in ((nrmse_bound, [realised(road_class="C")]), (_third_octave_bound, []))
    )
    assert of_road[0] == of_road[1] > 1.3 * of_road[2]
    assert of_octaves[0] == of_octaves[1] != of_octaves[2]


def test_the_bound_is_of_the_car_as_its_file_is_now(tmp_path):
    condition, file = {"mode": "passive", "speed_kmh": 54.0}, tmp_path / "own.yaml"
    text, bounds = config.find("vehicles", "van").read_text(), []
    for mass in ("1930.0", "1330.0"):
        file.write_text(text.replace("m_b: 1930.0", f"m_b: {mass}"))
        t = task(car=str(file), conditions=[condition])
        bounds.append(nrmse_bound(t, t.conditions[0], realised(road_class="C")))
    assert bounds[0] != pytest.approx(bounds[1], rel=1e-3)


def test_the_bound_of_a_plant_is_that_of_the_car_that_it_drives():
    """The struts of `commonroad` are linear."""
    condition = {"mode": "passive", "speed_kmh": 36.0, "car": "jeep_cherokee"}
    other = task(car="bmw_320i", conditions=[{**condition, "plant": "mujoco"}])
    t = task(car="bmw_320i", conditions=[{**condition, "plant": "commonroad"}])
    spectrum = fit_spectrum(realised(road_class="C"), scored_band(10.0))
    prior = RoadPrior(G_d0=10.0 ** (spectrum[0] / 10.0), w=spectrum[1])
    instruments = load_instruments(t.instruments)
    expected = bound(t.vehicle_of(t.conditions[0]), "passive", 10.0, instruments, prior)
    found = [nrmse_bound(x, x.conditions[0], realised(road_class="C")) for x in (t, other)]
    assert found[0] == pytest.approx(expected.pooled, rel=1e-3) and found[1] > 1.1 * found[0]


def test_instruments_or_drives_without_noise_have_no_bound():
    quiet = {"roads": ["iso_d"], "seeds": [11], "noise": False}
    for t in (task(instruments="ideal"), task(test=quiet)):
        assert np.isnan(nrmse_bound(t, t.conditions[0], realised(road_class="C")))
    assert _third_octave_bound(task(instruments="ideal"), t.conditions[0]) == []


def test_level_and_waviness_are_fitted_inside_the_band():
    band = (0.2, 1.8)
    level, w = fit_spectrum(realised(road_class="D"), band)
    assert level == pytest.approx(10.0 * np.log10(1024e-6), abs=1.0) and w == pytest.approx(
        2.0, abs=0.2
    )
    rough, steep = fit_spectrum(realised(road_class="E", w=2.5), band)
    assert rough - level == pytest.approx(6.0, abs=1.5) and steep == pytest.approx(2.5, abs=0.2)
    truth = realised(road_class="D")
    assert fit_spectrum(dataclasses.replace(truth, z=0.0 * truth.z), band) is None
    t = task()
    assert np.isnan(nrmse_bound(t, t.conditions[0], dataclasses.replace(truth, z=0.0 * truth.z)))


def test_the_third_octave_bounds_add_up_to_the_bound_of_the_band():
    """Weighted with the road's n^-2, the third octaves that tile 0.2 to 1.6 give the whole band."""
    t = load_task("new_road")
    for condition in (t.conditions[0], t.conditions[2]):
        shares = np.array(_third_octave_bound(t, condition))
        inside = (THIRD_OCTAVES > 0.24) & (THIRD_OCTAVES < 1.45)
        weight = THIRD_OCTAVES[inside] ** -1.0
        over = np.sqrt(np.sum(weight * shares[inside] ** 2) / weight.sum())
        n = np.linspace(
            THIRD_OCTAVES[inside][0] * 2 ** (-1 / 6), THIRD_OCTAVES[inside][-1] * 2 ** (1 / 6), 4001
        )
        car, instruments = load_vehicle(t.car), load_instruments(t.instruments)
        v = condition.speed_kmh / 3.6
        whole = bound(car, condition.simulator_mode, v, instruments, RoadPrior(), n=n).pooled
        assert over == pytest.approx(whole, rel=0.02)


def test_efficiency_is_the_ratio_of_mean_square_errors_of_bound_and_estimate():
    truth = realised(100.0, road_class="D")
    half = compute_scores(
        ScoredEstimate(truth, Estimate(truth.s, 0.8 * truth.z), 4.0, bumps=False, bound=0.1)
    )
    assert half["bound_nrmse"] == 0.1
    assert half["bound_efficiency"] == pytest.approx((0.1 / 0.2) ** 2)
    perfect = compute_scores(
        ScoredEstimate(truth, Estimate(truth.s, truth.z), 4.0, bumps=False, bound=0.1)
    )
    assert np.isnan(perfect["bound_efficiency"])
    unbounded = compute_scores(ScoredEstimate(truth, Estimate(truth.s, truth.z), 4.0, bumps=False))
    assert np.isnan(unbounded["bound_nrmse"])
