"""Accelerations that were low-passed: the filter is undone, and its silence tells nothing."""

import io
import json
from dataclasses import replace

import numpy as np
import pytest
from scipy import signal
from test_map_smoother import PAPER, drive_record, error, objective_of

from estimators import create
from estimators.low_pass import _find_low_pass
from estimators.map_smoother.preconditioner import stationary_hessian
from estimators.preprocessing import mask_record
from leaderboard.sandbox import messages
from road_envs.drives.recording import read_record, simulate_record, write_record
from road_envs.records.record import LowPass, Record
from road_envs.sensing.instruments import load_instruments
from road_envs.vehicle.parameters import load_vehicle


def low_passed(record: Record, f_c: float = 25.0, order: int = 4) -> Record:
    """The record behind a filter of SciPy, which it names."""
    sos = signal.butter(order, f_c, fs=record.fs, output="sos")
    a = signal.sosfiltfilt(sos, record.a, axis=1)
    return replace(record, a=a, low_pass=LowPass(f_c, order))


def below(f_c: float, a: np.ndarray, fs: float) -> np.ndarray:
    """Signals below `f_c` [Hz], by a filter of linear phase."""
    return signal.fftconvolve(a, signal.firwin(401, f_c, fs=fs)[None], mode="same", axes=1)


@pytest.mark.parametrize("order", [2, 4, 8])
def test_the_gain_of_a_low_pass_is_that_of_the_filter_forwards_and_backwards(order):
    f = np.linspace(0.0, 480.0, 50)
    sos = signal.butter(order, 25.0, fs=1000.0, output="sos")
    expected = np.abs(signal.sosfreqz(sos, f, fs=1000.0)[1]) ** 2
    low_pass = LowPass(25.0, order)
    np.testing.assert_allclose(low_pass.gain(f, 1000.0), expected, rtol=1e-6, atol=1e-15)
    assert low_pass.gain(np.array([low_pass.bandwidth]), 1e6)[0] == pytest.approx(0.1, rel=1e-6)


def test_a_named_low_pass_is_undone_up_to_its_bandwidth_and_the_reach_of_gaps_is_not_valid():
    record, _ = drive_record()
    low = low_passed(record)
    low.a[1, 1000:1005] = np.nan
    found, valid, notes = mask_record(low, PAPER)
    assert found.low_pass == LowPass(LowPass(25.0).bandwidth, None)
    assert any("low-passed at 25 Hz: the filter is undone up to 33 Hz" in note for note in notes)
    inside = slice(400, -400)
    whole = np.array([0, 2])
    expected = below(30.0, record.a, record.fs)[whole, inside]
    undone, filtered = (below(30.0, x, record.fs)[whole, inside] for x in (found.a, low.a))
    assert np.std(undone - expected) < 0.1 * np.std(filtered - expected)
    assert not valid[1, 925:1080].any() and valid[0, 220:-220].all()
    assert not valid[:, :200].any() and not valid[:, -200:].any()
    ends = mask_record(moving(low, 1500, 3500), PAPER)
    left = (ends.record.a - found.a[:, 1500:3500])[ends.valid]
    assert np.std(left) < PAPER.noise_density * np.sqrt(33.0)
    again, same, _ = mask_record(found, PAPER)
    assert again is found and same.sum() > valid.sum()


@pytest.mark.parametrize(("f_c", "order"), [(25.0, 4), (25.0, 8), (40.0, 4), (60.0, 5)])
def test_a_low_pass_that_a_record_does_not_name_is_found(f_c, order):
    record, _ = drive_record()
    found = _find_low_pass(low_passed(record, f_c, order).a, record.fs, PAPER.noise_density)
    assert found is not None and found.f_c == pytest.approx(f_c, rel=0.15)
    f = np.linspace(0.0, 0.75 * f_c, 20)
    gain, expected = (one.gain(f, record.fs) for one in (found, LowPass(f_c, order)))
    np.testing.assert_allclose(gain, expected, atol=0.06)
    assert _find_low_pass(record.a, record.fs, PAPER.noise_density) is None


@pytest.mark.parametrize("instruments", ["paper", "phone"])
def test_smoothed_accelerations_are_told_and_raw_ones_are_not(instruments):
    record, _ = simulate_record(
        "iso_b", speed_kmh=36.0, mode="ride", seed=3, length=60.0, instruments=instruments
    )
    known = load_instruments(instruments)
    slow = signal.butter(2, 5.0, fs=record.fs, output="sos")
    cases = {
        "raw": record.a,
        "mean": signal.lfilter(np.full(5, 0.2), 1.0, record.a),
        "slow": signal.sosfilt(slow, record.a),
    }
    for name, a in cases.items():
        notes = mask_record(replace(record, a=a), known).notes
        assert any("seem to be smoothed" in note for note in notes) == (name != "raw"), name
        assert not any("is undone" in note for note in notes)


def test_a_measurement_says_nothing_above_its_bandwidth():
    record, _ = drive_record()
    objective = objective_of(mask_record(low_passed(record), PAPER).record)
    rng = np.random.default_rng(0)
    x, dx = 0.1 * rng.standard_normal((2, objective.size))
    lin = objective.linearize(x)
    means = rng.standard_normal(lin.residual[0].shape)
    assert np.sum(lin.tangent(dx)[0] * means) == pytest.approx(dx @ lin.adjoint([means]), rel=1e-9)
    step = 1e-6
    ahead, back = (objective.linearize(x + s * dx) for s in (step, -step))
    slope = (ahead.cost - back.cost) / (2.0 * step)
    assert lin.gradient() @ dx == pytest.approx(slope, rel=1e-4)
    (one,) = objective.passes
    f = np.fft.rfftfreq(means.shape[1], one.block_duration)
    for (means,) in (lin.residual, lin.tangent(dx)):
        power = np.abs(np.fft.rfft(means)) ** 2
        assert power[:, f > 33.0].max() < 1e-20 * power.max()
    road, information = objective.road, stationary_hessian(objective).passes[0].on_road
    high = road.n * one.inputs.v.mean() > one.model.bandwidth
    assert not information[high].any() and information[~high][1:].all()


def moving(record: Record, first: int, last: int) -> Record:
    """The samples `first` to `last` of a drive, as of a logger that is switched on in motion."""
    names = ("t", "v", "s", "spring_stiff", "damper_high")
    part = {name: getattr(record, name)[first:last] for name in names}
    return replace(record, a=record.a[:, first:last], **part)


def test_a_low_passed_drive_that_begins_in_motion_leaves_nothing_unexplained():
    car = load_vehicle("land_rover_defender_110")
    record, _ = simulate_record("iso_d", speed_kmh=36.0, mode="handling", length=60.0)
    part = moving(low_passed(record), 2000, 7000)
    found = create("map_smoother", draws=0, adapt=False).estimate(part, car)
    assert not any("unexplained" in note for note in found.notes)


def test_the_preconditioner_knows_what_is_told_of_the_state_of_a_drive_that_begins_in_motion():
    objective = objective_of(moving(drive_record()[0], 1500, 4500))
    start = stationary_hessian(objective).passes[0].on_start
    road, states = 2 * objective.road.size, objective.passes[0].initial_std.size
    lin = objective.linearize(np.zeros(objective.size))
    unit = np.eye(objective.size)[road : road + states]
    exact = np.array([np.sqrt(e @ lin.hessian_product(e)) for e in unit])
    expected = lin.offset_scale(objective.noise_variance, [start])[:states]
    assert exact.max() > 100.0
    np.testing.assert_allclose(np.log(expected / exact), 0.0, atol=np.log(4.0))


@pytest.mark.parametrize("is_named", [True, False], ids=["named", "found"])
def test_the_road_below_a_low_pass_is_found_with_nothing_left_unexplained(is_named):
    record, truth = drive_record()
    low = low_passed(record) if is_named else replace(low_passed(record), low_pass=None)
    car = load_vehicle("land_rover_defender_110")
    found = create("map_smoother", draws=0, adapt=False).estimate(low, car)
    assert error(found, truth, record) < 0.1
    assert not any("unexplained" in note for note in found.notes)


def test_files_and_messages_keep_the_low_pass(tmp_path):
    record, truth = drive_record()
    low = low_passed(record)
    write_record(tmp_path / "low.parquet", low, {})
    assert read_record(tmp_path / "low.parquet")[0].low_pass == low.low_pass
    write_record(tmp_path / "plain.parquet", record, {})
    assert read_record(tmp_path / "plain.parquet")[0].low_pass is None

    def received(message: bytes):
        stream = io.BytesIO(message)
        (size,) = messages.HEAD_SIZE.unpack(stream.read(messages.HEAD_SIZE.size))
        head = json.loads(stream.read(size))
        return head, messages.decode_arrays(head, stream.read)

    sent = messages.encode_drives("fit", [(low, truth), (low, None)])
    (first, road), (second, none) = messages.decode_drives(*received(sent))
    assert first.low_pass == second.low_pass == low.low_pass
    np.testing.assert_array_equal(road.z, truth.z)
    np.testing.assert_array_equal(second.a, low.a)
    assert none is None and second.sensors == low.sensors
