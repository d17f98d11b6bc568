"""The bound against the benchmark table, the information form, and drawn roads."""

import json
from dataclasses import replace
from functools import cache
from itertools import product

import numpy as np
import oracles
import oracles_roads
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import integrate, stats
from test_linear_model import energy_matrices
from vehicle_fixtures import CARS, DEFENDER, PLANTS

from road_envs.analysis.information_bound import (
    BoundTable,
    RoadPrior,
    bound,
    equivalent_damping,
    posterior,
    strut_rate_std,
)
from road_envs.core import config
from road_envs.records.record import scored_band
from road_envs.roads import load_road, with_length
from road_envs.sensing.instruments import load_instruments
from road_envs.simulation.drive import simulate
from road_envs.vehicle.linear_model import frequency_response, linearise, strut_rate_response
from studies.passes import OperatingPoint, bound_of_passes

PAPER = load_instruments("paper")
PAIRS = (("ride",) * 2, ("handling",) * 2, ("ride", "handling"), ("handling", "ride"))
SLOW, FAST = 14.5 / 3.6, 15.0
TABLE = {  # speed, model error -> NRMSE of the left wheel path for PAIRS
    (SLOW, 0.0): (0.136, 0.085, 0.032, 0.041),
    (SLOW, 0.05): (0.161, 0.127, 0.065, 0.067),
    (FAST, 0.0): (0.111, 0.075, 0.032, 0.044),
    (FAST, 0.05): (0.154, 0.123, 0.079, 0.071),
}
DAMPERS = {"ride": 2000.0, "handling": 5000.0}


def modes(pair):
    return dict(zip(("front", "rear"), pair, strict=True))


def ahead():
    """Return the instruments with the rear accelerometers 620 mm ahead of the rear axle."""
    sensors = PAPER.accelerometers
    rear = {name: replace(sensors[name], ahead=0.62) for name in ("LR", "RR")}
    return replace(PAPER, accelerometers=sensors | rear)


def tabled(pair, v, model_error, n, car=DEFENDER):
    damping = np.repeat([DAMPERS[state] for state in pair], 2)
    arguments = (car, modes(pair), v, ahead(), RoadPrior())
    return bound(*arguments, damping=damping, model_error=model_error, n=n)


# --- the benchmark table --------------------------------------------------------------------------


@pytest.mark.parametrize(("v", "model_error"), TABLE)
def test_the_bound_reproduces_the_benchmark_table(v, model_error):
    """To all digits on 400 frequencies equidistant over log n; the integral within 0.0013."""
    top = min(1.8, 0.98 * 25.0 / v)
    coarse, fine = np.geomspace(0.05, 4.0, 400), np.linspace(0.2, top, 4001)
    width = np.gradient(coarse)
    inside = (coarse >= 0.2) & (coarse <= top)
    for pair, printed in zip(PAIRS, TABLE[v, model_error], strict=True):
        result = tabled(pair, v, model_error, coarse[inside])
        powers = (width[inside] @ result.path_psd[:, 0], width[inside] @ result.prior[:, 0, 0])
        assert round(float(np.sqrt(powers[0] / powers[1])), 3) == printed
        assert abs(tabled(pair, v, model_error, fine).nrmse()[0] - printed) < 0.0013


def test_equal_states_leave_the_difference_unobservable_at_wheelbase_notches():
    notches = (2.0 * np.arange(5) + 1.0) / (2.0 * DEFENDER.wheelbase)
    between = np.arange(1, 5) / DEFENDER.wheelbase
    for pair in PAIRS[:2]:
        for v in (SLOW, FAST):
            observable = between[between < 24.0 / v]
            assert (tabled(pair, v, 0.0, notches).relative_error("difference") > 0.97).all()
            assert (tabled(pair, v, 0.0, observable).relative_error("difference") < 0.1).all()
            assert (
                tabled(pair, v, 0.0, notches[notches < 20.0 / v]).relative_error("mean") < 0.2
            ).all()


def test_unequal_states_observe_the_difference_and_halve_the_bound():
    notches = (2.0 * np.arange(5) + 1.0) / (2.0 * DEFENDER.wheelbase)
    for v in (SLOW, FAST):
        n = notches[notches < 22.5 / v]
        for pair in PAIRS[2:]:
            assert (tabled(pair, v, 0.0, n).relative_error("difference") < 0.2).all()
        of = {p: bound(DEFENDER, modes(p), v, PAPER, RoadPrior()).pooled for p in PAIRS}
        assert max(of[p] for p in PAIRS[2:]) < 0.5 * min(of[p] for p in PAIRS[:2])


# --- the estimate ---------------------------------------------------------------------------------


@pytest.mark.parametrize("v", [SLOW, FAST])
@pytest.mark.parametrize("pair", PAIRS[1:3], ids="-".join)
def test_the_bound_is_the_inverse_of_prior_and_measured_information(v, pair):
    """P = (1/S + H* H / R)^-1, with H of the energy matrices and S of the oracle's coherence."""
    n = np.array([0.21, 0.4, 0.9, 1.3])
    matrices = energy_matrices("defender", modes(pair), [DAMPERS[s] for s in pair])
    locations = [(1.395 - 0.12, -0.55), (-1.399 + 0.62, 0.55), (-1.399 + 0.62, -0.55)]
    result = tabled(pair, v, 0.0, n)
    for k, each in enumerate(n):
        H = np.empty((3, 2), dtype=complex)
        for side in range(2):
            road = np.zeros(4, dtype=complex)
            road[[side, 2 + side]] = 1.0, np.exp(-2j * np.pi * each * DEFENDER.wheelbase)
            a = oracles.response(matrices, each * v, road)
            H[:, side] = [oracles.point_acceleration(*a[:3], *at) for at in locations]
        g = oracles_roads.isotropic_root_coherence(each, 2.0, 1.5)
        S = 1024e-6 * (each / 0.1) ** -2 * np.array([[1.0, g], [g, 1.0]])
        information = np.linalg.inv(S) + H.conj().T @ H / (0.01**2 * v)
        expected = np.linalg.inv(information)
        np.testing.assert_allclose(result.error[k], expected, rtol=1e-4)


def test_the_error_on_drawn_roads_agrees_with_the_bound():
    rng, n = np.random.default_rng(3), np.array([0.25, 0.55, 1.1])
    result = tabled(PAIRS[0], SLOW, 0.0, n)
    locations, damping = ahead().locations(DEFENDER), np.full(4, DAMPERS["ride"])
    model = linearise(DEFENDER, modes(PAIRS[0]), locations, damping=damping)
    H, size = frequency_response(model, SLOW, n=n), 20_000

    def normal(*shape):
        return np.sqrt(0.5) * (rng.standard_normal(shape) + 1j * rng.standard_normal(shape))

    z = np.linalg.cholesky(result.prior) @ normal(3, 2, size)
    a = H @ z + 0.01 * np.sqrt(SLOW) * normal(3, 3, size)
    error = result.gain @ a - z
    spectrum = error @ error.conj().swapaxes(1, 2) / size
    level = np.sqrt(result.path_psd[:, :, None] * result.path_psd[:, None, :])
    assert (np.abs(spectrum - result.error) < 5.0 / np.sqrt(size) * level).all()


def test_mean_and_difference_follow_from_the_wheel_paths():
    result = tabled(PAIRS[2], SLOW, 0.0, np.linspace(0.2, 1.8, 50))
    P = result.error
    for name, sign in (("mean", 1.0), ("difference", -1.0)):
        both = [
            (X[:, 0, 0] + X[:, 1, 1] + 2.0 * sign * X[:, 0, 1]).real
            for X in (result.error, result.prior)
        ]
        np.testing.assert_allclose(result.relative_error(name), np.sqrt(both[0] / both[1]))
    for side, name in enumerate(("left", "right")):
        share = np.sqrt(P[:, side, side].real / result.prior[:, side, side])
        np.testing.assert_allclose(result.relative_error(name), share)


positive = st.floats(1e-4, 1.0)


@settings(max_examples=30)
@given(st.sampled_from(PAIRS), st.floats(3.0, 30.0), positive, positive, st.floats(0.0, 0.3))
def test_the_bound_grows_with_noise_and_model_error(pair, v, noise, more, model_error):
    n, prior = np.linspace(*scored_band(v), 15), RoadPrior()
    damping = np.full(4, 3000.0)

    def error(density, share):
        instruments = replace(PAPER, noise_density=density)
        place = instruments.locations(DEFENDER)
        arguments = (PLANTS["defender"], modes(pair), v, instruments, prior)
        return bound(*arguments, locations=place, damping=damping, model_error=share, n=n)

    good, noisy, wrong = error(noise, 0.0), error(noise + more, 0.0), error(noise, model_error)
    slack = 1e-9 * good.prior[:, :1, 0]
    assert (good.path_psd <= good.prior[:, [0, 1], [0, 1]] + slack).all()
    assert (noisy.path_psd >= good.path_psd - slack).all()
    assert (wrong.path_psd >= good.path_psd - slack).all()


def test_no_information_is_gained_above_the_low_pass():
    n = np.array([1.6, 1.7, 3.0])
    result = tabled(PAIRS[0], FAST, 0.0, n)
    assert result.relative_error("left")[0] < 0.9
    np.testing.assert_allclose(result.relative_error("left")[1:], 1.0)
    assert not result.gain[1:].any()


def test_a_sensor_without_response_leaves_the_prior():
    S = RoadPrior().spectrum(np.array([0.3, 0.6]))
    R = np.tile(np.eye(3), (2, 1, 1))
    result = posterior(np.array([0.3, 0.6]), np.zeros((2, 3, 2)), S, R)
    np.testing.assert_array_equal(result.error, S)


# --- equivalent damping ---------------------------------------------------------------------------


@pytest.mark.parametrize("mode", ["ride", "handling"])
@pytest.mark.parametrize("name", CARS)
@pytest.mark.costly
def test_the_equivalent_damping_is_a_fixed_point_of_linearization(name, mode):
    car, v, prior = CARS[name], 12.0, RoadPrior()
    result = equivalent_damping(car, mode, v, prior)
    model = linearise(car, mode, {}, damping=result)
    f = np.geomspace(0.05, 50.0, 600)
    rates = strut_rate_std(model, v, f, prior.spectrum(f / v) / v)
    curves = [
        oracles.CubicCurve(getattr(law, mode)) for law in (car.strut.damper, car.strut.friction)
    ]
    for rate, c in zip(rates, result, strict=True):
        mean, _ = integrate.quad(
            lambda x, s=rate: sum(float(k(s * x)) for k in curves) * x * stats.norm.pdf(x),
            -8.0, 8.0, points=[-0.02 / rate, 0.0, 0.02 / rate], limit=200,
        )  # fmt: skip
        assert c == pytest.approx(mean / rate, rel=0.01)


@pytest.mark.parametrize("mode", ["ride", "handling"])
def test_strut_rates_of_the_nonlinear_car_agree_with_the_linearization(mode):
    road = with_length(load_road("iso_c"), 150.0)
    measured = []
    for seed in range(3):
        drive = simulate(DEFENDER, road.realise(np.random.default_rng(seed)), 12.0, mode)
        rates = np.gradient(drive.extension, drive.t, axis=0)
        measured.append(np.mean(rates[drive.s > 20.0] ** 2, axis=0))
    prior, f = RoadPrior(G_d0=256e-6), np.geomspace(0.05, 50.0, 600)
    damping = equivalent_damping(DEFENDER, mode, 12.0, prior)
    model = linearise(DEFENDER, mode, {}, damping=damping)
    expected = strut_rate_std(model, 12.0, f, prior.spectrum(f / 12.0) / 12.0)
    np.testing.assert_allclose(np.sqrt(np.mean(measured, axis=0)), expected, rtol=0.15)


@pytest.mark.parametrize("name", CARS)
def test_the_strut_rate_is_the_difference_of_its_ends(name):
    """The rate of extension is the body's rate at the strut minus the axle's."""
    car, f = CARS[name], 3.0
    c = np.array([900.0, 900.0, 1500.0, 1500.0])
    model = linearise(PLANTS[name], "ride", {"any": (0.0, 0.0)}, damping=c)
    result = strut_rate_response(model, np.array([f]))[0]
    A = model.A
    K, C = (-np.diag(model.M) @ A[7:, part] for part in (slice(7), slice(7, None)))
    B = np.diag(model.M) @ model.B[7:]
    for wheel in range(4):
        a = oracles.response((np.diag(model.M), C, K, B[:, :4], B[:, 4:]), f, np.eye(4)[wheel])
        v = a / (2j * np.pi * f)
        for w, axle in enumerate((car.front, car.front, car.rear, car.rear)):
            y = axle.y_s * (1.0, -1.0)[w % 2]
            ends = v[0] - axle.x * v[2] + y * v[1], v[3 + 2 * (w // 2)] + y * v[4 + 2 * (w // 2)]
            assert result[w, wheel] == pytest.approx(ends[0] - ends[1], rel=1e-6)


# --- table for policies ---------------------------------------------------------------------------


@cache
def information():
    return BoundTable.tabulate(DEFENDER, PAPER, RoadPrior(), (6.0, 15.0))


def test_the_bound_table_interpolates_the_bound():
    table = information()
    for front, rear in PAIRS:
        for v in table.speeds:
            exact = bound(DEFENDER, modes((front, rear)), v, PAPER, RoadPrior()).pooled
            assert table.interpolate(front, rear, v) == pytest.approx(exact, rel=0.01)
    ends = [table.interpolate("ride", "ride", v) for v in (6.0, 15.0)]
    assert min(ends) < table.interpolate("ride", "ride", 10.0) < max(ends)
    assert table.interpolate("ride", "handling", 10.0) < 0.5 * table.interpolate(
        "ride", "ride", 10.0
    )


# --- invalid input and the command ----------------------------------------------------------------


def test_invalid_arguments_are_rejected():
    with pytest.raises(ValueError, match="model_error must not be negative"):
        bound(DEFENDER, "ride", 10.0, PAPER, RoadPrior(), model_error=-0.1)
    with pytest.raises(ValueError, match="G_d0: must be positive, got 0"):
        RoadPrior(G_d0=0.0)
    with pytest.raises(ValueError, match="give locations"):
        bound(PLANTS["defender"], "ride", 10.0, PAPER, RoadPrior())
    with pytest.raises(ValueError, match=r"nothing above 0\.2 cycles/m"):
        bound(DEFENDER, "ride", 200.0, PAPER, RoadPrior())


@pytest.mark.costly
def test_the_command_prints_and_draws_the_bound(road_recon, tmp_path):
    words = ("observability", "--speed-kmh", 54, "--mismatch", 0.05, "--noise", 0.02)
    code, out, _ = road_recon(*words, "--mode", "front=ride,rear=handling", "--json")
    facts = json.loads(out)
    (row,) = facts["bounds"]
    instruments = replace(PAPER, noise_density=0.02)
    arguments = (DEFENDER, modes(PAIRS[2]), FAST, instruments, RoadPrior())
    assert code == 0
    assert row["nrmse"] == pytest.approx(bound(*arguments, model_error=0.05).pooled, rel=1e-6)
    code, out, _ = road_recon(*words, "--out", "bound.png")
    assert code == 0
    assert "handling / ride" in out and "5 % mismatch" in out
    assert (tmp_path / "bound.png").read_bytes().startswith(b"\x89PNG")


def test_noise_that_is_given_replaces_that_of_sensors_with_a_noise_of_their_own(
    road_recon, tmp_path
):
    sheet = yaml.safe_load((config.folder() / "sensors/paper.yaml").read_text())
    for k, sensor in enumerate(sheet["accelerometers"].values(), start=2):
        sensor["noise_density"] = k / 100
    (tmp_path / "own.yaml").write_text(yaml.safe_dump(sheet))
    made = {}
    for sensors, noise in product(("paper", "own.yaml"), ((), ("--noise", 0.5))):
        words = ("observability", "--mode", "ride", "--speed-kmh", 54, "--sensors", sensors, *noise)
        code, out, _ = road_recon(*words, "--json")
        made[sensors, bool(noise)] = facts = json.loads(out)
        assert code == 0 and facts["bounds"][0]["nrmse"] > 0.0
    (ours,), (papers,) = (made[name, True]["bounds"] for name in ("own.yaml", "paper"))
    assert ours.keys() == papers.keys()
    for key, value in papers.items():  # each sums in its order
        is_text = isinstance(value, str)
        assert ours[key] == (value if is_text else pytest.approx(value, rel=1e-12)), key
    assert made["own.yaml", True]["noise_density"] == 0.5
    assert made["own.yaml", False]["bounds"] != made["paper", False]["bounds"]
    assert made["own.yaml", False]["noise_density"] == [0.02, 0.04]
    alike = {name: x | {"noise_density": 0.02} for name, x in sheet["accelerometers"].items()}
    (tmp_path / "alike.yaml").write_text(yaml.safe_dump(sheet | {"accelerometers": alike}))
    for sensors in ("own.yaml", "alike.yaml"):
        code, _, err = road_recon("observability", "--sensors", sensors, "--attainable")
        assert code == 2 and "have noise of their own" in err and err.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("--mode", "ridee"), "unknown suspension mode 'ridee' (did you mean 'ride'?)"),
        (("--mode", "front=ride,rear"), "--mode must be key=value,key=value, got 'rear'"),
        (("--speed-kmh", "-3"), "the speed must be positive, got -3.0 km/h"),
        (("--noise", "-1"), "noise_density: must not be negative, got -1.0"),
        (("--road-class", "K"), "unknown road class 'K'; known: A, B"),
        (("--damping", "ride=x"), "--damping must be mode=number in N s/m, got 'ride=x'"),
        (("--damping", "ride=1"), "dampings are given for ['ride'], but not for ['handling']"),
        (("--out", "x.txt"), "the name must end in .png"),
    ],
)
def test_the_command_rejects_invalid_options_in_one_sentence(road_recon, words, sentence):
    code, _, err = road_recon("observability", *words)
    assert code == 2
    assert sentence in err and err.count("\n") == 1


# --- several passes over one road -----------------------------------------------------------------


def test_the_information_of_passes_adds_in_a_case_solved_exactly():
    """At one frequency: the posterior precision is the prior's and that of each measurement."""
    passes = [
        OperatingPoint(DEFENDER, "ride", SLOW),
        OperatingPoint(DEFENDER, modes(PAIRS[2]), FAST),
    ]
    n, prior = np.array([0.3, 0.9, 1.4]), RoadPrior()
    found = bound_of_passes(passes, PAPER, prior, n=n)
    precision = np.linalg.inv(prior.spectrum(n))
    for one in passes:
        alone = bound(*one, PAPER, prior, n=n)
        precision = precision + np.linalg.inv(alone.error) - np.linalg.inv(prior.spectrum(n))
    np.testing.assert_allclose(found.error, np.linalg.inv(precision), rtol=1e-6)


def test_equal_passes_count_as_one_with_less_noise():
    quiet = replace(PAPER, noise_density=0.5 * PAPER.noise_density)
    one = OperatingPoint(DEFENDER, "handling", FAST)
    four = bound_of_passes([one] * 4, PAPER, RoadPrior())
    np.testing.assert_allclose(four.pooled, bound(*one, quiet, RoadPrior()).pooled, rtol=1e-6)
    mixed = [
        one,
        OperatingPoint(DEFENDER, "ride", FAST),
        one,
        OperatingPoint(DEFENDER, modes(PAIRS[3]), SLOW),
    ]
    assert bound_of_passes(mixed, PAPER, RoadPrior(), n=four.n).pooled < 0.8 * four.pooled
