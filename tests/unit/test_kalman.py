"""The Kalman filter: the dense Gaussian posterior of a linear car, what it makes of its own model,
what it tells and when, and drives of the real car.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from oracles import linear_matrices
from scipy.linalg import expm
from vehicle_fixtures import DEFENDER

from estimators import create
from estimators.common.block_means import block_means, to_uniform_clock
from estimators.common.model_inputs import REST_STD, build_model_inputs
from estimators.kalman.filter import filter_forward
from estimators.kalman.friction_linearization import RATE_STDS, residual_variance, smoothed_tables
from estimators.kalman.pipeline import (
    BIAS_STD,
    NODE_SPACING,
    run_filter,
    run_smoother,
    setup_output,
    setup_run,
)
from estimators.kalman.profile_output import (
    HALF_WINDOW,
    VARIANCE_STRIDE,
    decay_per_node,
    output_weights,
)
from estimators.kalman.road_process import fit_ar_model
from estimators.kalman.state import (
    N_VEHICLE,
    ROUGHNESS_SCALE,
    ROUGHNESS_SUM,
    ROUGHNESS_WEIGHT,
    empty_blocks,
)
from leaderboard.conformance.probes import probe_estimator
from leaderboard.metrics.heights import band_pass, nrmse, uncertainty
from road_envs.analysis.information_bound import RoadPrior
from road_envs.analysis.roughness import displacement_psd
from road_envs.data.record import PROFILE_SPACING, Record, profile_stations, scored_band
from road_envs.data.recording import simulate_record
from road_envs.roads import load_road, with_length
from road_envs.sensing.instruments import load_instruments
from road_envs.vehicle.equations import build_plant
from road_envs.vehicle.force_curves import Curve, interpolate_table
from road_envs.vehicle.parameters import ModeCurves, VehicleParameters
from road_envs.vehicle.suspension import V_0, V_STEP, decode_commands, encode_command

PAPER = load_instruments("paper")
SPLIT = {"front": "ride", "rear": "handling"}
PRIOR = RoadPrior()

# --- the linear car, all at once ------------------------------------------------------------------

C_S, K_S = 3000.0, 16682.0
SPEED, TIME, STEP = 5.0, 1.9, 0.00025
LEAD = 0.4
"""Way [m] before station 0 on which the car sets out."""
SMALL = RoadPrior(G_d0=1e-9)
START = 0.01
"""Of the deviations that the first state has otherwise."""
NOISE = (1e-5) ** 2 * 500.0


def linear_car() -> VehicleParameters:
    """Dampers are straight lines, there is no friction, and on a small road the gas is straight."""
    line, none = Curve(x=(-3.0, 3.0), F=(-3.0 * C_S, 3.0 * C_S)), Curve(x=(-3.0, 3.0), F=(0.0, 0.0))
    damper, friction = ModeCurves(ride=line, handling=line), ModeCurves(ride=none, handling=none)
    return replace(DEFENDER, strut=replace(DEFENDER.strut, damper=damper, friction=friction))


def still(a: np.ndarray) -> Record:
    """A record of the short drive, of accelerations `a` (3, T)."""
    t = np.arange(a.shape[1]) / 1000.0
    state = np.zeros((t.size, 4), dtype=bool)
    s = SPEED * t - LEAD
    return Record(t, a, np.full(t.size, SPEED), s, state, state, SPEED * TIME - LEAD - 1.0)


def run_of(a: np.ndarray, lag: float):
    """The short drive as the filter takes it, with nothing learnt on the way, and a start that does
    not bend the gas springs.
    """
    record, car = still(a), linear_car()
    course = build_model_inputs(record, PAPER, car, STEP)
    readings = block_means(record.a, np.isfinite(record.a), 3)
    run = setup_run(record, car, PAPER, course, readings, NOISE, SMALL, True, lag)
    model = run.model._replace(roughness_memory=np.inf, noise_time=np.inf)
    run.state.adaptive[[ROUGHNESS_SUM, ROUGHNESS_WEIGHT]] = 1e15
    run.state.P[:N_VEHICLE, :N_VEHICLE] *= START**2
    return replace(run, model=model), record, course


@cache
def dense():
    """Prior covariance of all unknowns (coefficients, start, zeros) and what the block means are of
    them (3, J, unknowns), from the energies' matrices and the exact solution of their equations;
    and the node number of the front axle at first.
    """
    run, _, course = run_of(np.zeros((3, round(1000 * TIME))), 4.79)
    road, newest_node = fit_ar_model(SMALL, NODE_SPACING), int(run.inputs.front_node[0]) + 2
    last = int(run.inputs.front_node[-1]) + 3
    number = np.arange(last + 1)
    free = (
        (number - 0.5 > run.inputs.free_range[0])
        & (number - 0.5 < run.inputs.free_range[1])
        & (number > newest_node)
    )
    made = np.zeros((2, last + 1, last + 1))
    for component in range(2):
        for k in number[newest_node + 1 :]:
            order = road.weights.shape[1] if free[k] else 1
            weights = road.weights[component] if free[k] else np.ones(1)
            made[component, k] = weights @ made[component, k - 1 - np.arange(order)]
            made[component, k, k] = free[k] * np.sqrt(road.prediction_variance[component])
    M, C, K, K_r, C_r = linear_matrices(DEFENDER, (K_S, K_S), (C_S, C_S))
    h, size = course.h, 2 * number.size
    A = np.block([[np.zeros((7, 7)), np.eye(7)], [-np.linalg.solve(M, K), -np.linalg.solve(M, C)]])
    B = np.vstack([np.zeros((7, 8)), np.linalg.solve(M, np.hstack([K_r, C_r]))])
    big = np.zeros((30, 30))
    big[:14, :14], big[:14, 14:22], big[14:22, 22:] = A * h, B * h, np.eye(8)
    step = expm(big)[:14]
    unknowns = size + 17
    state, road_now = np.zeros((14, unknowns)), []
    state[:, size : size + 14] = np.eye(14)
    for x in run.inputs.front_node[::2]:
        under = np.zeros((8, unknowns))
        for axle in range(2):
            at = x - axle * DEFENDER.wheelbase / NODE_SPACING
            i, t = int(at), at - int(at)
            r = 1.0 - t
            z = np.array([r**3, 4 - 6 * t**2 + 3 * t**3, 4 - 6 * r**2 + 3 * r**3, t**3]) / 6.0
            w = np.array([-(r**2), 3 * t**2 - 4 * t, 4 * r - 3 * r**2, t**2]) / 2.0
            nodes = i + np.arange(-1, 3)
            for side, sign in enumerate((1.0, -1.0)):
                for rows, shares in (
                    (2 * axle + side, z),
                    (4 + 2 * axle + side, w * SPEED / NODE_SPACING),
                ):
                    under[rows, nodes] = shares
                    under[rows, number.size + nodes] = sign * shares
        road_now.append(under)
    levers = np.array([[1.0, y, -forward_] for forward_, y in PAPER.locations(DEFENDER).values()])
    sensed = np.zeros((len(road_now), 3, unknowns))
    for n, now in enumerate(road_now):
        sensed[n] = levers @ (A @ state + B @ now)[[7, 8, 9]]
        drift = (road_now[n + 1] if n + 1 < len(road_now) else now) - now
        state = step[:, :14] @ state + step[:, 14:22] @ now + step[:, 22:] @ drift
    J = run.n_blocks
    means = sensed[:: course.decimation][: 3 * J].reshape(J, 3, 3, unknowns).mean(axis=1)
    means = means.transpose(1, 0, 2)
    means[np.arange(3), :, size + 14 + np.arange(3)] = 1.0
    half = number.size
    P = np.zeros((unknowns, unknowns))
    P[:half, :half], P[half:size, half:size] = made[0] @ made[0].T, made[1] @ made[1].T
    rest = np.concatenate([START * REST_STD, np.full(3, BIAS_STD)])
    P[size:, size:] = np.diag(rest**2)
    return P, means, run.inputs.front_node[0]


@cache
def drawn() -> np.ndarray:
    """Samples (3, T) whose block means are a draw from the dense model."""
    P, means, _ = dense()
    rng = np.random.default_rng(7)
    root = np.linalg.cholesky(P + 1e-18 * np.eye(P.shape[0]))
    y = means @ (root @ rng.standard_normal(P.shape[0]))
    y += np.sqrt(NOISE / 3.0) * rng.standard_normal(y.shape)
    a = np.repeat(y, 3, axis=1)
    return np.pad(a, ((0, 0), (0, round(1000 * TIME) - a.shape[1])), mode="edge")


def functional(at: float, top: float, detrended: bool) -> np.ndarray:
    """Shares of coefficients in what is told at a node number, summed out over all nodes."""
    half = dense()[0].shape[0] // 2 - 8  # 17 unknowns stand behind the coefficients
    number, window = np.arange(half), HALF_WINDOW / NODE_SPACING

    def low(d):
        shape = np.where(np.abs(d) < window, np.cos(0.5 * np.pi * d / window) ** 2, 0.0)
        return 2.0 * top * np.sinc(2.0 * top * d) * shape

    far = np.arange(-100, half + 100)
    d = far - at
    share = np.zeros(half)
    np.add.at(
        share, np.clip(far, 0, half - 1), low(d - 1) / 6.0 + 4.0 * low(d) / 6.0 + low(d + 1) / 6.0
    )
    share /= share.sum()
    if detrended:
        u = decay_per_node(NODE_SPACING) * np.abs(number - at)
        share -= 0.5 * decay_per_node(NODE_SPACING) * np.exp(-u) * (np.cos(u) + np.sin(u))
    return share


def posterior(seen: int, share: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance (2,) of left and right, by the block means before `seen`."""
    P, means, _ = dense()
    half = share.size
    f = np.zeros((2, P.shape[0]))
    f[:, :half], f[0, half : 2 * half], f[1, half : 2 * half] = share, share, -share
    H = means[:, :seen].reshape(-1, P.shape[0])
    y = block_means(drawn(), np.isfinite(drawn()), 3).y[:, :seen].ravel()
    S = H @ P @ H.T + NOISE / 3.0 * np.eye(y.size)
    gain = np.linalg.solve(S, H @ P @ f.T)
    return gain.T @ y, np.diag(f @ P @ f.T - (f @ P @ H.T) @ gain)


def shift_of(run) -> int:
    """From node numbers of a trip to those of the dense model; windows of other lengths differ."""
    return round(dense()[2] - run.inputs.front_node[0])


def held(run, output, m) -> np.ndarray:
    """Shares in what is told of the station `m` about its long waves, by one who knows no node
    ahead of the newest at that time and holds the road level from there on.
    """
    shift, seen = shift_of(run), min(output.emit_block[m], run.n_blocks)
    front = int(np.floor(run.inputs.front_node[2 * seen * run.model.steps_per_block - 1])) + 2
    share = functional(output.node[m] + shift, 0.09, True)
    low = functional(output.node[m] + shift, 0.09, False)[front + shift + 1 :].sum()
    u = decay_per_node(NODE_SPACING) * (front + 0.5 - output.node[m])
    share[front + shift + 1 :] = 0.0
    share[front + shift] += low - 0.5 * np.exp(-u) * np.cos(u)
    return share


def compare(output, wanted, at_least: int):
    """Heights within a tenth of their deviation, deviations to a hundredth."""
    compared = 0
    for m in range(
        VARIANCE_STRIDE * 8, output.node.size, VARIANCE_STRIDE * 4
    ):  # on the apron all is known
        z, variance = wanted(m)
        assert np.abs(output.z[m] - z).max() < 0.1 * np.sqrt(variance.min())
        np.testing.assert_allclose(np.sqrt(output.variance[m]), np.sqrt(variance), rtol=0.01)
        compared += 1
    assert compared >= at_least


@pytest.mark.parametrize("lag", [0.0, 4.79])
def test_what_is_told_early_is_the_dense_posterior_of_what_was_heard_until_then(lag):
    run, record, _ = run_of(drawn(), lag)
    output = setup_output(run, record, lag, 0.004, detrended=True)
    output = output._replace(cutoff=np.full_like(output.cutoff, 0.09))
    assert np.searchsorted(output.emit_block, run.n_blocks) > 100
    run_filter(run, output)

    def wanted(m):
        return posterior(min(output.emit_block[m], run.n_blocks), held(run, output, m))

    compare(output, wanted, 7)


def test_what_is_told_of_the_whole_drive_is_its_dense_posterior():
    run, record, _ = run_of(drawn(), DEFENDER.wheelbase)
    output = setup_output(run, record, DEFENDER.wheelbase, 0.004, detrended=False)
    output = output._replace(cutoff=np.full_like(output.cutoff, 0.09))
    run_smoother(run, output)
    shift, known = shift_of(run), int(np.searchsorted(output.emit_block, run.n_blocks))
    assert known > 20 * VARIANCE_STRIDE

    for m in range(VARIANCE_STRIDE * 8, known, VARIANCE_STRIDE * 2):
        at = output.node[m] + shift
        z, variance = posterior(run.n_blocks, functional(at, 0.09, False))
        assert np.abs(output.z[m] - z).max() < 0.1 * np.sqrt(variance.min())
        _, variance = posterior(run.n_blocks, held(run, output, m))
        np.testing.assert_allclose(np.sqrt(output.variance[m]), np.sqrt(variance), rtol=0.01)


def test_smoothing_in_parts_is_smoothing_at_once_where_much_follows():
    once, parts = [], []
    for found, size in ((once, 10**6), (parts, 200)):
        run, record, _ = run_of(drawn(), DEFENDER.wheelbase)
        output = setup_output(run, record, DEFENDER.wheelbase, 0.004, detrended=False)
        run_smoother(run, output, size)
        found += [output.z, np.sqrt(output.variance)]
    assert np.abs(once[0] - parts[0]).max() < 0.3 * once[1].max()
    np.testing.assert_allclose(parts[1], once[1], rtol=0.1, atol=1e-3 * once[1].max())
    assert (once[1] <= 1.001 * parts[1]).all()


def test_on_its_own_model_the_news_are_white_and_of_unit_size():
    run, record, _ = run_of(drawn(), 4.79)
    output = setup_output(run, record, 4.79, 0.004, detrended=True)
    blocks = empty_blocks(run.n_states, run.max_columns, run.n_blocks)
    filter_forward(run.model, run.inputs, run.state, 0, run.n_blocks, output, blocks)
    innovation, many = blocks.innovation, 3 * run.n_blocks
    assert np.mean(innovation**2) == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / many))
    for gap in (1, 2, 5):
        for s in range(3):
            both = np.mean(innovation[gap:, s] * innovation[:-gap, s])
            assert abs(both) < 4.0 / np.sqrt(run.n_blocks)
    assert abs(np.mean(innovation[:, 0] * innovation[:, 2])) < 4.0 / np.sqrt(run.n_blocks)


# --- its parts ------------------------------------------------------------------------------------


def test_the_road_ahead_goes_on_with_the_prior_s_density_and_coherence():
    road, rng, size = fit_ar_model(PRIOR, NODE_SPACING), np.random.default_rng(1), 12000
    order = road.weights.shape[1]
    z = np.zeros((2, 2, size))
    noise = np.sqrt(road.prediction_variance)[:, None] * rng.standard_normal((2, 2, size))
    for k in range(order, size):
        past = z[:, :, k - 1 : k - order - 1 : -1] if k > order else z[:, :, order - 1 :: -1]
        z[:, :, k] = np.einsum("rpk,pk->rp", past, road.weights) + noise[:, :, k]
    heights = (z[:, :, :-2] + 4.0 * z[:, :, 1:-1] + z[:, :, 2:]) / 6.0
    n, mean = displacement_psd(heights[:, 0, 500:], NODE_SPACING)
    _, half = displacement_psd(heights[:, 1, 500:], NODE_SPACING)
    for low, high in ((0.2, 0.5), (0.5, 1.8)):
        inside = (n > low) & (n < high)
        S = PRIOR.spectrum(n[inside])
        for found, sign in ((mean, 1.0), (half, -1.0)):
            wanted = 0.5 * np.real(S[:, 0, 0] + sign * S[:, 0, 1])
            assert np.mean(found[:, inside] / wanted) == pytest.approx(1.0, abs=0.12)
    rise = z[:, :, order + 10 :] - z[:, :, order:-10]
    np.testing.assert_allclose(np.mean(rise**2, axis=(0, 2)), road.increment_variance(10), rtol=0.1)


def test_waves_are_told_in_their_band_and_no_long_ones():
    u, K, newest_node = np.empty(2 + 4000), 4000, 5000
    number = newest_node - K + 1 + np.arange(K)
    at, half = 3000.3, HALF_WINDOW / NODE_SPACING
    for n, top, wanted in (
        (0.02, 0.25, 0.0016),
        (0.1, 0.25, 0.5),
        (1.0, 0.25, 1.0),
        (4.0, 0.1, 0.0),
    ):
        output_weights(u, at, newest_node, decay_per_node(NODE_SPACING), top, half)
        wave = np.cos(2.0 * np.pi * n * NODE_SPACING * (number - at))
        found = sum(u[2 + k % K] * x for k, x in zip(number, wave, strict=True))
        rounding = (
            2.0 + np.cos(2.0 * np.pi * n * NODE_SPACING)
        ) / 3.0  # coefficients of a wave of height 1
        assert found * (rounding if n < 1.0 else 1.0) == pytest.approx(
            wanted * (1.0 if n < 1.0 else rounding), abs=0.02
        )


def test_a_force_over_an_uncertain_rate_is_its_mean_and_best_line_and_what_is_left():
    one = build_plant(DEFENDER)
    tables, left = smoothed_tables(one.velocity)
    kinds, rng = one.velocity.shape[0], np.random.default_rng(3)
    for which, width in ((3, RATE_STDS[3]), (6, RATE_STDS[6])):
        for k, rate in ((0, 0.02), (1, -0.15)):
            w = rng.normal(rate, width, 20_000)
            F = np.array([interpolate_table(one.velocity, float(k), V_0, V_STEP, x)[0] for x in w])
            line = np.polynomial.Polynomial.fit(w - rate, F, 1).convert()
            mean, slope = interpolate_table(tables, float(kinds * which + k), V_0, V_STEP, rate)
            assert mean == pytest.approx(F.mean(), abs=0.03 * F.std())
            assert slope == pytest.approx(line.coef[1], rel=0.05)
            over = np.var(F - line(w - rate))
            at = round((rate - V_0) / V_STEP)
            assert left[which, k, at] == pytest.approx(over, rel=0.1)
    assert residual_variance(one.velocity, 0.0).max() < 1e-6


# --- the real car ---------------------------------------------------------------------------------


@cache
def drive(mode="handling", kmh=54.0, seed=3, length=100.0, road="iso_d"):
    surface = with_length(load_road(road), length).realise(np.random.default_rng(seed))
    given = SPLIT if mode == "split" else mode
    return simulate_record(
        DEFENDER, surface, speed_kmh=kmh, mode=given, instruments=PAPER, seed=seed, step=5e-4
    )


@cache
def told(name, *args, **settings):
    return create(name, **settings).estimate(drive(*args)[0], DEFENDER)


def error(estimate, truth, kmh=54.0) -> float:
    return nrmse(truth.z, estimate.z, PROFILE_SPACING, scored_band(kmh / 3.6)).pooled


@pytest.mark.parametrize("mode, most", [("ride", 0.2), ("handling", 0.13)])
def test_the_later_it_tells_the_better_it_knows(mode, most):
    _, truth = drive(mode)
    early, late, whole = (error(told(name, mode), truth) for name in
                          ("kalman", "kalman_lag", "kalman_rts"))  # fmt: skip
    assert whole < late < most
    assert 2.0 * late < early < 0.8


def test_with_unequal_states_the_whole_drive_knows_what_the_lag_does_not():
    _, truth = drive("split")
    assert error(told("kalman_rts", "split"), truth) < 0.12
    assert error(told("kalman_lag", "split"), truth) < 0.35


def test_what_comes_later_changes_nothing_that_was_told_even_where_it_clips():
    record, _ = drive("handling", 54.0, 3, 60.0)
    late = record.s > 30.0
    a = np.where(late, np.clip(25.0 * record.a, -PAPER.range, PAPER.range), record.a)
    a[1, np.argmax(late) : np.argmax(late) + 4] = np.nan
    for name, lag in (("kalman", 0.0), ("kalman_lag", 4.79)):
        before = create(name).estimate(record, DEFENDER)
        after = create(name).estimate(replace(record, a=a), DEFENDER)
        past = before.s < 30.0 - lag - 1e-9
        np.testing.assert_array_equal(before.z[:, past], after.z[:, past])
        np.testing.assert_array_equal(before.z_std[:, past], after.z_std[:, past])
        assert np.abs(before.z - after.z)[:, ~past].max() > 1e-3


def test_lost_clipped_and_dropped_samples_cost_little_and_are_noted():
    record, truth = drive()
    a = record.a.copy()
    rng = np.random.default_rng(5)
    a[:, rng.random(a.shape[1]) < 0.01] = np.nan
    a[2, 2000:2100] = np.nan
    a[0, 3000:3010] = PAPER.range
    damaged = create("kalman_lag").estimate(replace(record, a=a), DEFENDER)
    assert error(damaged, truth) < 1.5 * error(told("kalman_lag"), truth)
    assert any("samples lost or clipped, left out" in note for note in damaged.notes)
    keep = rng.random(record.t.size) > 0.02
    keep[[0, -1]] = True
    fewer = Record(
        record.t[keep], record.a[:, keep], record.v[keep], record.s[keep],
        record.spring_stiff[keep], record.damper_high[keep], record.length,
    )  # fmt: skip
    even, notes = to_uniform_clock(fewer)
    assert even.t.size == record.t.size and np.isnan(even.a[0]).sum() == (~keep).sum()
    assert notes == [f"the clock is uneven; {(~keep).sum()} samples were dropped"]
    dropped = create("kalman_lag").estimate(fewer, DEFENDER)
    assert error(dropped, truth) < 1.5 * error(told("kalman_lag"), truth)
    assert notes[0] in dropped.notes


def test_switches_in_the_drive_are_followed_valve_by_valve():
    record, truth = switched()
    estimate = create("kalman_lag").estimate(record, DEFENDER)
    assert error(estimate, truth) < 0.25
    never = np.zeros_like(record.spring_stiff)
    deaf = create("kalman_lag").estimate(
        replace(record, spring_stiff=never, damper_high=never), DEFENDER
    )
    assert error(deaf, truth) > 2.0 * error(estimate, truth)


@cache
def switched():
    """A drive whose struts change their state every second and a half."""
    from road_envs.data.recording import truth as truth_of
    from road_envs.sensing.data_logger import DataLogger
    from road_envs.simulation.drive import DriveSimulator

    surface = with_length(load_road("iso_d"), 100.0).realise(np.random.default_rng(4))
    step = 5e-4
    car = DriveSimulator(build_plant(DEFENDER), DEFENDER, surface, 15.0, "ride", step)
    logger = DataLogger(PAPER, DEFENDER, step, np.random.default_rng(4))
    modes = [encode_command(mode) for mode in ("ride", "handling", "stiff_low", SPLIT, "soft_high")]
    parts, bytes_ = [], []
    while not car.is_finished:
        many = min(3000, car.steps_left)
        commands = np.full(many, modes[len(parts) % len(modes)], dtype=np.uint8)
        parts.append(logger.sample(car.advance(commands)))
        bytes_.append(commands)
    a = np.concatenate([*parts, logger.flush()], axis=1)
    t = np.arange(a.shape[1]) / PAPER.fs
    distance, v, _ = car.speed_profile.at(t)
    stiff, high = decode_commands(np.concatenate(bytes_)[::2][: t.size])
    record = Record(t, a, v, car.start + distance, stiff, high, surface.length)
    return record, truth_of(surface)


def test_it_begins_in_the_middle_of_a_road_and_ends_there():
    record, truth = drive()
    inside = (record.s > 20.0) & (record.s < 80.0)
    cut = Record(
        record.t[inside], record.a[:, inside], record.v[inside], record.s[inside],
        record.spring_stiff[inside], record.damper_high[inside], record.length,
    )  # fmt: skip
    for name in ("kalman_lag", "kalman_rts"):
        estimate = create(name).estimate(cut, DEFENDER)
        s = profile_stations(record.length)
        here = (s > 25.0) & (s < 70.0)
        assert (
            nrmse(truth.z[:, here], estimate.z[:, here], PROFILE_SPACING, scored_band(15.0)).pooled
            < 0.3
        )
        assert estimate.z_std[:, s > 81.0].min() > 5.0 * np.median(estimate.z_std[:, here])


@pytest.mark.parametrize("name", ["kalman", "kalman_lag", "kalman_rts"])
def test_its_intervals_hold_what_they_should(name):
    shares = []
    for mode, kmh, road in (
        ("ride", 14.5, "iso_d"), ("handling", 14.5, "belgian_like"),
        ("ride", 54.0, "belgian_like"), ("handling", 54.0, "iso_d"), ("split", 54.0, "iso_d"),
    ):  # fmt: skip
        _, truth = drive(mode, kmh, 6, 60.0, road)
        estimate = told(name, mode, kmh, 6, 60.0, road)
        y, a = band_pass(np.stack([truth.z, estimate.z]), PROFILE_SPACING, scored_band(kmh / 3.6))
        found = uncertainty(y, a, estimate.z_std)
        shares.append((found.coverage_50, found.coverage_90))
    half, most = np.mean(shares, axis=0)
    assert half == pytest.approx(0.5, abs=0.08)
    assert most == pytest.approx(0.9, abs=0.05)


def test_the_level_of_the_road_is_learnt():
    for name, level in (("iso_b", 1.0 / 16.0), ("iso_e", 4.0)):
        record, _ = drive("handling", 54.0, 2, 60.0, name)
        course = build_model_inputs(record, PAPER, DEFENDER, 0.001)
        readings = block_means(record.a, np.isfinite(record.a), 3)
        run = setup_run(record, DEFENDER, PAPER, course, readings, 0.05, PRIOR, True, 4.79)
        run_filter(run, setup_output(run, record, 4.79, 0.004, detrended=True))
        assert abs(np.log2(run.state.adaptive[ROUGHNESS_SCALE] / level)) < 1.0


@pytest.mark.parametrize("name", ["kalman", "kalman_lag"])
def test_the_probes_are_passed(name):
    record, _ = drive("handling", 54.0, 3, 60.0)
    for found in probe_estimator(create(name), record, DEFENDER):
        assert found.passed, f"{found.name}: {found.said}"


REFUSED = {
    "shorter than 1 s": lambda r: Record(
        r.t[:200],
        r.a[:, :200],
        r.v[:200],
        r.s[:200],
        r.spring_stiff[:200],
        r.damper_high[:200],
        r.length,
    ),
    "the car stands": lambda r: replace(r, v=0.0 * r.v, s=0.0 * r.s),
    "at least 50 Hz": lambda r: replace(r, t=25.0 * r.t),
    "'spring_stiff' must say of each of 4 struts": lambda r: replace(
        r, spring_stiff=2 * r.spring_stiff.astype(int)
    ),
    "no finite acceleration": lambda r: replace(r, a=np.nan * r.a),
    "drives backwards": lambda r: replace(r, s=r.s[::-1]),
    "the record's v must be finite": lambda r: replace(r, v=np.nan * r.v),
    "clock must go on": lambda r: replace(r, t=np.where(r.t == r.t[70], r.t[60], r.t)),
}


@pytest.mark.parametrize("sentence", REFUSED)
def test_a_record_of_no_drive_is_refused_with_the_reason(sentence):
    record, _ = drive()
    with pytest.raises(ValueError, match=sentence):
        create("kalman_lag").estimate(REFUSED[sentence](record), DEFENDER)


def test_a_fast_car_needs_more_columns_and_a_jump_is_refused():
    record, truth = drive("handling", 110.0)
    assert error(create("kalman_lag").estimate(record, DEFENDER), truth, 110.0) < 0.3
    jump = record.s + 5.0 * (record.s > 50.0)
    with pytest.raises(ValueError, match="the odometer jumps by 5"):
        create("kalman_lag").estimate(replace(record, s=jump), DEFENDER)


def test_impossible_settings_are_refused():
    for settings in (
        {"data_rate": 0.0},
        {"noise_density": -1.0},
        {"lag": -1.0},
        {"std_factor": 0.0},
    ):
        with pytest.raises(ValueError, match=next(iter(settings))):
            create("kalman_lag", **settings)
