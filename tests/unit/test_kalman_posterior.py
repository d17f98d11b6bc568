"""The Kalman filter and smoother of a linear vehicle against the dense Gaussian posterior.

The posterior comes from the energy matrices and the exact solution of their equations of motion.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from oracles import linear_matrices
from scipy.linalg import expm
from scipy.signal import sosfilt
from scipy.stats import truncnorm
from vehicle_fixtures import DEFENDER

from estimators.common.block_means import block_means
from estimators.common.model_inputs import REST_STD, build_model_inputs
from estimators.kalman.filter import _normal_hazard, _update_block
from estimators.kalman.forward import WindowFilter
from estimators.kalman.pipeline import (
    run_filter,
    run_smoother,
    setup_output,
    setup_run,
)
from estimators.kalman.road_process import ARModel
from estimators.kalman.state import ROUGHNESS_SUM, ROUGHNESS_WEIGHT, LinearizedBlock, LocalState
from estimators.kalman.tuning import TUNING
from road_envs.analysis.information_bound import RoadPrior
from road_envs.records.record import Record
from road_envs.sensing.instruments import load_instruments
from road_envs.vehicle.body_bending import modal_force, section, shape
from road_envs.vehicle.force_curves import Curve
from road_envs.vehicle.parameters import BendingMode, TorsionalFrame, VehicleParameters
from road_envs.vehicle.struts import _ModeCurves

PAPER = load_instruments("paper")
C_S, K_S = 3000.0, 16682.0
SPEED, TIME, STEP = 5.0, 1.9, 0.00025
LEAD = 0.4
"""Distance [m] before station 0 from which the vehicle starts."""
SMOOTH = RoadPrior(G_d0=1e-9)
START = 0.01
"""Factor on the prior standard deviations of the initial state."""
NOISE = (1e-5) ** 2 * 500.0
CUTOFF = 0.09


FRAME, BENDING = (9.0, 0.08), BendingMode(f=18.0, zeta=0.05, length=4.4)


def linear_car(flexible: bool) -> VehicleParameters:
    """Linear dampers and no friction; on a smooth road the gas springs are linear, too. The body of
    a flexible one twists and bends.
    """
    line, none = Curve(x=(-3.0, 3.0), F=(-3.0 * C_S, 3.0 * C_S)), Curve(x=(-3.0, 3.0), F=(0.0, 0.0))
    damper, friction = _ModeCurves(ride=line, handling=line), _ModeCurves(ride=none, handling=none)
    variation = DEFENDER.variation
    if flexible:
        frame = TorsionalFrame(f=FRAME[0], zeta=FRAME[1])
        variation = replace(variation, frame=frame, bending=BENDING)
    strut = replace(DEFENDER.strut, damper=damper, friction=friction)
    return replace(DEFENDER, strut=strut, variation=variation)


def record_of(a: np.ndarray) -> Record:
    """A record of a short drive with the accelerations `a` (3, T)."""
    t = np.arange(a.shape[1]) / 1000.0
    state = np.zeros((t.size, 4), dtype=bool)
    s = SPEED * t - LEAD
    return Record(t, a, np.full(t.size, SPEED), s, state, state, SPEED * TIME - LEAD - 1.0)


def run_of(a: np.ndarray, flexible: bool = False, lag: float = DEFENDER.wheelbase):
    """The short drive before its first block, without adaptation, and from a narrow initial state,
    in which the gas springs are linear.
    """
    record, car = record_of(a), linear_car(flexible)
    inputs = build_model_inputs(record, PAPER, car, STEP)
    measurements = block_means(record.a, np.isfinite(record.a), 3)
    options = {"noise_variance": NOISE, "prior": SMOOTH, "level_ends": True, "lag": lag}
    run = setup_run(record, car, PAPER, inputs, measurements, **options)
    run.state.adaptive[[ROUGHNESS_SUM, ROUGHNESS_WEIGHT]] = 1e15
    vehicle = slice(run.road.n_vehicle)
    run.state.P[vehicle, vehicle] *= START**2
    model, road = run.model._replace(noise_time=np.inf), run.road._replace(roughness_memory=np.inf)
    return replace(run, model=model, road=road), record, inputs


@cache
def dense(flexible: bool = False):
    """Prior covariance of all unknowns (coefficients, initial state, biases), block means per unit
    of each (3, J, unknowns), the first node number of the front axle, and the number of nodes.
    """
    run, _, inputs = run_of(np.zeros((3, round(1000 * TIME))), flexible)
    road, newest_node = ARModel.fit(SMOOTH), run.windows.initial
    last = int(run.inputs.front_node[-1]) + 3
    number = np.arange(last + 1)
    free = (
        (number - 0.5 > run.road.free_range[0])
        & (number - 0.5 < run.road.free_range[1])
        & (number > newest_node)
    )
    root = np.zeros((2, last + 1, last + 1))
    for component in range(2):
        for k in number[newest_node + 1 :]:
            order = road.weights.shape[1] if free[k] else 1
            weights = road.weights[component] if free[k] else np.ones(1)
            root[component, k] = weights @ root[component, k - 1 - np.arange(order)]
            root[component, k, k] = free[k] * np.sqrt(road.prediction_variance[component])
    frame = FRAME if flexible else None
    M, C, K, K_r, C_r = linear_matrices(DEFENDER, (K_S, K_S), (C_S, C_S), frame)
    h, size, d = inputs.h, 2 * number.size, len(M)
    A = np.block([[np.zeros((d, d)), np.eye(d)], [-np.linalg.solve(M, K), -np.linalg.solve(M, C)]])
    B = np.vstack([np.zeros((d, 8)), np.linalg.solve(M, np.hstack([K_r, C_r]))])
    n = 2 * d
    big = np.zeros((n + 16, n + 16))
    big[:n, :n], big[:n, n : n + 8], big[n : n + 8, n + 8 :] = A * h, B * h, np.eye(8)
    step = expm(big)[:n]
    bias = size + n + 2 * flexible
    unknowns = bias + 3
    state, road_now = np.zeros((n, unknowns)), []
    state[:, size : size + n] = np.eye(n)
    for x in run.inputs.front_node[::2]:
        under = np.zeros((8, unknowns))
        for axle in range(2):
            at = x - axle * DEFENDER.wheelbase / TUNING.node_spacing
            i, t = int(at), at - int(at)
            r = 1.0 - t
            z = np.array([r**3, 4 - 6 * t**2 + 3 * t**3, 4 - 6 * r**2 + 3 * r**3, t**3]) / 6.0
            w = np.array([-(r**2), 3 * t**2 - 4 * t, 4 * r - 3 * r**2, t**2]) / 2.0
            nodes = i + np.arange(-1, 3)
            for side, sign in enumerate((1.0, -1.0)):
                for rows, shares in (
                    (2 * axle + side, z),
                    (4 + 2 * axle + side, w * SPEED / TUNING.node_spacing),
                ):
                    under[rows, nodes] = shares
                    under[rows, number.size + nodes] = sign * shares
        road_now.append(under)
    places = list(PAPER.locations(DEFENDER).values())
    levers = np.zeros((3, d))
    levers[:, :3] = [[1.0, place.y, -place.x] for place in places]
    levers[:, 7:] = [[0.5 * np.sign(place.x) * place.y] for place in places] if flexible else 0.0
    motion = np.zeros((len(road_now), d, unknowns))
    for k, now in enumerate(road_now):
        motion[k] = (A @ state + B @ now)[d:]
        drift = (road_now[k + 1] if k + 1 < len(road_now) else now) - now
        state = step[:, :n] @ state + step[:, n : n + 8] @ now + step[:, n + 8 :] @ drift
    motion = motion[:: inputs.decimation]
    sensed = np.einsum("sj,tju->tsu", levers, motion)
    if flexible:
        zi = np.zeros((1, 2, unknowns))
        zi[0, :, bias - 2 : bias] = np.eye(2)
        force = np.einsum("j,tju->tu", modal_force(BENDING, DEFENDER), motion[:, [0, 2]])
        bent, _ = sosfilt(section(BENDING, 1e-3), force, axis=0, zi=zi)
        sensed += shape(BENDING, np.array([place.x for place in places]))[:, None] * bent[:, None]
    J = run.n_blocks  # blocks of 3 samples
    means = sensed[: 3 * J].reshape(J, 3, 3, unknowns).mean(axis=1)
    means = means.transpose(1, 0, 2)
    means[np.arange(3), :, bias + np.arange(3)] = 1.0
    half = number.size
    P = np.zeros((unknowns, unknowns))
    P[:half, :half], P[half:size, half:size] = root[0] @ root[0].T, root[1] @ root[1].T
    rest = START * np.concatenate([np.repeat(REST_STD[[0, -1]], d), REST_STD[-2 * flexible :]])
    std = np.concatenate([rest[: bias - size], np.full(3, TUNING.bias_std)])
    P[size:, size:] = np.diag(std**2)
    return P, means, run.inputs.front_node[0], half


@cache
def drawn_samples(flexible: bool = False) -> np.ndarray:
    """Samples (3, T) whose block means are drawn from the dense model."""
    P, means, *_ = dense(flexible)
    rng = np.random.default_rng(7)
    root = np.linalg.cholesky(P + 1e-18 * np.eye(P.shape[0]))
    y = means @ (root @ rng.standard_normal(P.shape[0]))
    y += np.sqrt(NOISE / 3.0) * rng.standard_normal(y.shape)
    a = np.repeat(y, 3, axis=1)
    return np.pad(a, ((0, 0), (0, round(1000 * TIME) - a.shape[1])), mode="edge")


def dense_weights(at: float, detrended: bool) -> np.ndarray:
    """Weights of the coefficients in the output at a node number, as a sum over all nodes."""
    half = dense()[3]
    number, window = np.arange(half), TUNING.half_window / TUNING.node_spacing

    def low(d):
        shape = np.where(np.abs(d) < window, np.cos(0.5 * np.pi * d / window) ** 2, 0.0)
        return 2.0 * CUTOFF * np.sinc(2.0 * CUTOFF * d) * shape

    far = np.arange(-100, half + 100)
    d = far - at
    weights = np.zeros(half)
    kernel = low(d - 1) / 6.0 + 4.0 * low(d) / 6.0 + low(d + 1) / 6.0
    np.add.at(weights, np.clip(far, 0, half - 1), kernel)
    weights /= weights.sum()
    if detrended:
        u = TUNING.decay * np.abs(number - at)
        weights -= 0.5 * TUNING.decay * np.exp(-u) * (np.cos(u) + np.sin(u))
    return weights


def posterior(
    blocks: int, weights: np.ndarray, flexible: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Posterior mean and variance (2,) of left and right, given the first `blocks` block means."""
    P, means, *_ = dense(flexible)
    half = weights.size
    f = np.zeros((2, P.shape[0]))
    f[:, :half], f[0, half : 2 * half], f[1, half : 2 * half] = weights, weights, -weights
    H = means[:, :blocks].reshape(-1, P.shape[0])
    samples = drawn_samples(flexible)
    y = block_means(samples, np.isfinite(samples), 3).y[:, :blocks].ravel()
    S = H @ P @ H.T + NOISE / 3.0 * np.eye(y.size)
    gain = np.linalg.solve(S, H @ P @ f.T)
    return gain.T @ y, np.diag(f @ P @ f.T - (f @ P @ H.T) @ gain)


def detrended_weights(run, output, m) -> np.ndarray:
    """Weights in the detrended output of the station `m`, for a road that is level beyond the
    newest node at the time of emission.
    """
    blocks = min(output.emit_block[m], run.n_blocks)
    front = int(np.floor(run.inputs.front_node[2 * blocks * run.model.steps_per_block - 1])) + 2
    weights = dense_weights(output.node[m], True)
    low = dense_weights(output.node[m], False)[front + 1 :].sum()
    u = TUNING.decay * (front + 0.5 - output.node[m])
    weights[front + 1 :] = 0.0
    weights[front] += low - 0.5 * np.exp(-u) * np.cos(u)
    return weights


FLEXIBLE = pytest.param(4.79, True, marks=pytest.mark.slow, id="a body that twists and bends")


@pytest.mark.parametrize("lag, flexible", [(0.0, False), (4.79, False), (6.5, False), FLEXIBLE])
@pytest.mark.costly
def test_an_emitted_station_is_the_dense_posterior_of_the_blocks_until_then(lag, flexible):
    """Heights within a tenth of their standard deviation, standard deviations to a hundredth."""
    run, record, _ = run_of(drawn_samples(flexible), flexible, lag)
    output = setup_output(run, record, 0.004, detrended=True)
    output = replace(output, cutoff=np.full_like(output.cutoff, CUTOFF))
    assert np.searchsorted(output.emit_block, run.n_blocks) > 100
    run_filter(run, output)
    compared = range(
        TUNING.variance_stride * 4, output.node.size, TUNING.variance_stride * 2
    )  # after the apron
    for m in compared:
        blocks = min(output.emit_block[m], run.n_blocks)
        z, variance = posterior(blocks, detrended_weights(run, output, m), flexible)
        assert np.abs(output.z[m] - z).max() < 0.1 * np.sqrt(variance.min())
        np.testing.assert_allclose(np.sqrt(output.variance[m]), np.sqrt(variance), rtol=0.01)
    assert len(compared) >= 7


@pytest.mark.costly
def test_the_smoothed_profile_is_the_dense_posterior_of_all_blocks():
    run, record, _ = run_of(drawn_samples())
    output = setup_output(run, record, 0.004, detrended=False)
    output = replace(output, cutoff=np.full_like(output.cutoff, CUTOFF))
    run_smoother(run, output)
    passed = int(np.searchsorted(output.emit_block, run.n_blocks))
    assert passed > 10 * TUNING.variance_stride

    for m in range(TUNING.variance_stride * 4, passed, TUNING.variance_stride * 2):
        z, variance = posterior(run.n_blocks, dense_weights(output.node[m], False))
        assert np.abs(output.z[m] - z).max() < 0.1 * np.sqrt(variance.min())
        _, variance = posterior(run.n_blocks, detrended_weights(run, output, m))
        np.testing.assert_allclose(np.sqrt(output.variance[m]), np.sqrt(variance), rtol=0.01)


@pytest.mark.costly
def test_smoothing_in_chunks_is_nearly_smoothing_at_once():
    once, chunks = [], []
    for result, size in ((once, 10**6), (chunks, 16)):
        run, record, _ = run_of(drawn_samples())
        output = setup_output(run, record, 0.004, detrended=False)
        run_smoother(run, output, size)
        result += [output.z, np.sqrt(output.variance)]
    assert np.abs(once[0] - chunks[0]).max() < 0.3 * once[1].max()
    np.testing.assert_allclose(chunks[1], once[1], rtol=0.1, atol=1e-3 * once[1].max())
    assert (once[1] <= 1.001 * chunks[1]).all()


@pytest.mark.costly
def test_innovations_on_the_filters_own_model_are_white_with_unit_variance():
    run, record, _ = run_of(drawn_samples())
    one = WindowFilter(run, setup_output(run, record, 0.004, detrended=True))
    windows = [part for i in range(run.windows.newest.size) for part in one.filter_window(i)]
    innovation = np.concatenate([window.innovation for window in windows]).reshape(-1, 3)
    count = innovation.size
    assert count == 3 * run.n_blocks
    assert np.mean(innovation**2) == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / count))
    for gap in (1, 2, 5):
        covariance = np.mean(innovation[gap:] * innovation[:-gap], axis=0)
        assert np.abs(covariance).max() < 4.0 / np.sqrt(run.n_blocks)
    assert abs(np.mean(innovation[:, 0] * innovation[:, 2])) < 4.0 / np.sqrt(run.n_blocks)


@pytest.mark.parametrize("limit", [-1.5, 0.3, 1.4])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_censored_measurement_gives_the_moments_of_a_truncated_normal(limit, sign):
    run, _, _ = run_of(np.zeros((3, 1900)))
    rng = np.random.default_rng(4)
    n, n_vehicle, columns = 24, run.road.n_vehicle, np.array([0, 3, 20])
    root = 0.1 * rng.standard_normal((n, n))
    P, x, h = root @ root.T, rng.standard_normal(n), np.array([2.0, -1.0, 0.5])
    gain, count = P[:, columns] @ h, 3.0
    std = np.sqrt(h @ gain[columns] + run.model.noise_variance / count)
    truncated = truncnorm(limit, np.inf)
    far = 9.0 * abs(limit)
    assert _normal_hazard(far) == pytest.approx(truncnorm(far, np.inf).mean(), rel=1e-3)
    factors = np.zeros((3 + n_vehicle, n))
    factors[1, columns], factors[3:, :n_vehicle] = h, np.eye(n_vehicle)  # it does not move
    block = LinearizedBlock(factors, np.array([0.0, 0.7, 0.0]), x[:n_vehicle].copy(), np.zeros(4))
    column = np.array([0.0, 1.0, 0.0])[:, None]
    inputs = run.inputs._replace(
        y=(0.7 + sign * limit * std) * column, sample_count=count * column, censored=sign * column
    )
    local = LocalState(
        x.copy(), np.concatenate([P, np.eye(n)], axis=1), np.zeros(2, dtype=np.int64),
        np.zeros((4, 3)), run.state.adaptive, np.zeros(3), np.zeros((3, n)),
        np.zeros(1), np.zeros(1), np.zeros(1),
    )  # fmt: skip
    # interpreted: as a kernel of its own it would be compiled for this test alone
    _update_block.py_func(run.model, inputs, local, block, 0, 0)
    np.testing.assert_allclose(local.x - x, sign * gain / std * truncated.mean(), rtol=2e-3)
    shrinkage = (1.0 - truncated.var()) / std**2
    expected = shrinkage * np.outer(gain, gain)
    np.testing.assert_allclose(P - local.rows[:, :n], expected, rtol=2e-3, atol=1e-12)
    # the error of the vehicle moves like that of all others
    transition = np.eye(n) - shrinkage * np.outer(gain, factors[1])
    np.testing.assert_allclose(local.rows[:, n:], transition, rtol=2e-3, atol=1e-12)
