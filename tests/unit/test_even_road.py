"""A road with obstacles that is sought as an even one, where a rough place confirms itself."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from estimators.estimation import estimate
from estimators.map_smoother import gauss_newton
from estimators.map_smoother.tuning import TUNING
from leaderboard.scoring import score
from road_envs.drives.logger_tables.description import PLACES
from road_envs.drives.recording import simulate_record
from road_envs.sensing.instruments import load_instruments

CAR, KMH = "bmw_320i", 100.0
ROAD = {
    "kind": "superposed",
    "roads": [
        {"kind": "iso8608", "road_class": "B", "length": 100.0},
        {
            "kind": "defects",
            "length": 100.0,
            "defects": [
                {"shape": "half_sine", "at": 35.0, "length": 0.9, "height": 0.06},
                {"shape": "half_sine", "at": 70.0, "length": 3.7, "height": 0.075},
            ],
        },
    ],
}


@pytest.fixture(scope="module")
def drive():
    """A saloon, as described, over two bumps with three phones in it."""
    return simulate_record(ROAD, speed_kmh=KMH, vehicle=CAR, instruments="phone", seed=9103)


def solved(record):
    return estimate("map_smoother", record, CAR, instruments="phone", adapt=False)


@pytest.mark.costly
def test_a_rough_place_that_confirms_itself_is_given_up_for_an_even_road(drive, monkeypatch):
    record, truth = drive
    found = solved(record)
    assert found.residual < 1.1
    assert score(found, truth, speed_kmh=KMH)["nrmse"] < 0.3
    monkeypatch.setattr(gauss_newton, "TUNING", replace(TUNING, even_gain=0.0))
    assert solved(record).residual > 3.0


@pytest.mark.costly
def test_one_phone_chooses_between_an_even_and_an_uneven_road(monkeypatch):
    """One sensor does not tell roads apart by what they leave unexplained."""
    bumps = [(40.0, 1.2, 0.06), (80.0, 0.9, 0.06), (115.0, 0.9, 0.05)]
    defects = [
        {"shape": "half_sine", "at": at, "length": length, "height": height}
        for at, length, height in bumps
    ]
    ground = {"kind": "iso8608", "road_class": "C", "length": 150.0}
    obstacles = {"kind": "defects", "length": 150.0, "defects": defects}
    road = {"kind": "superposed", "roads": [ground, obstacles]}
    phone = replace(load_instruments("phone"), accelerometers={"PHONE": PLACES["dashboard"]})
    record, truth = simulate_record(road, speed_kmh=60.0, vehicle=CAR, instruments=phone, seed=9306)
    near = [np.abs(truth.s - at) < 4.0 for at, _, _ in bumps]
    compared, is_likelier = [], gauss_newton._is_likelier

    def choose(even, uneven):
        compared.append(is_likelier(even, uneven))
        return compared[-1]

    # what an uneven road would be is a matter of rounding, another one on each kernel of BLAS
    monkeypatch.setattr(gauss_newton, "_is_likelier", choose)
    found = solved(record)
    z = [np.interp(truth.s, found.s, found.z.mean(axis=0)), truth.z.mean(axis=0)]
    low, true_low = ([path[k].min() - np.median(path[k]) for k in near] for path in z)
    assert compared and found.residual < 1.1
    assert np.abs(np.subtract(low, true_low)).max() < 0.0045


@pytest.mark.parametrize(
    ("sensors", "even", "uneven", "expected"),
    [
        (1, (1.6, 500.0), (1.2, 2000.0), True),  # costs less under a noise of 1.6
        (1, (2.0, 500.0), (1.0, 700.0), False),  # 1000 under a noise of 2, and 950
        (3, (1.6, 500.0), (1.2, 2000.0), False),  # three sensors tell by what is left
        (3, (0.5, 2000.0), (1.2, 500.0), True),
    ],
)
def test_an_even_road_is_likelier(monkeypatch, sensors, even, uneven, expected):
    """Roads are their residuals' power and their own cost, which is that of 1000 readings."""

    def point(power, prior):
        return SimpleNamespace(
            power=np.array([power]),
            objective=SimpleNamespace(is_underdetermined=sensors < 3),
            cost_under=lambda noise: prior + 500.0 * power / float(noise[0]),
        )

    monkeypatch.setattr(gauss_newton, "misfit_power", lambda lin: lin.power)
    assert gauss_newton._is_likelier(point(*even), point(*uneven)) is expected


@pytest.mark.costly
def test_behind_a_bump_off_which_a_wheel_flew_the_road_may_fall_at_once(drive):
    """The straight line to where the wheel lands is 35 mm too high, and was said to err by 3."""
    record, truth = drive
    found = solved(record)
    behind = (found.s > 35.6) & (found.s < 36.2)
    z = np.array([np.interp(found.s, truth.s, path) for path in truth.z])
    about = np.abs(found.s - 35.0) < 5.0
    error = (found.z - z) - (found.z - z)[:, about].mean(axis=1, keepdims=True)
    assert (np.abs(error[:, behind]) < 3.0 * found.z_std[:, behind]).mean() > 0.9
    assert np.abs(error[:, behind]).max() < 0.025
