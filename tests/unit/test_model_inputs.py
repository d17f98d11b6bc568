"""Block means of the samples, inputs of the vehicle model, and the road's spline."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from vehicle_fixtures import DEFENDER

from estimators.common.block_means import block_means
from estimators.common.model_inputs import antialias_delay, build_model_inputs
from estimators.common.spline import evaluate_spline, sample_under_wheels
from estimators.preprocessing import mask_record
from road_envs.drives.recording import simulate_record
from road_envs.records.record import Record
from road_envs.roads.iso8608 import Iso8608
from road_envs.sensing.instruments import load_instruments
from road_envs.vehicle.suspension import encode_command

PAPER = load_instruments("paper")


@cache
def drive() -> Record:
    """A record of a short drive."""
    surface = Iso8608(road_class="D", length=40.0).realise(np.random.default_rng(5))
    record, _ = simulate_record(
        surface, vehicle=DEFENDER, speed_kmh=54.0, mode="handling", instruments=PAPER, seed=1
    )
    return record


def test_the_spline_reproduces_cubics_and_their_slopes():
    """Coefficients of a cubic are its values less a sixth of its second derivative."""
    k = np.arange(30.0)
    cubic = np.polynomial.Polynomial([0.3, -0.2, 0.05, -0.001])
    c = np.stack([cubic(k) - cubic.deriv(2)(k) / 6.0, np.zeros(30)])
    x = np.linspace(6.0, 26.0, 77)
    np.testing.assert_allclose(evaluate_spline(c, x)[0], cubic(x), atol=1e-12)
    road = np.empty((x.size, 2, 4))
    sample_under_wheels(c, x, np.full(x.size, 3.0), 4.5, road)
    np.testing.assert_allclose(road[:, 1, 0], 3.0 * cubic.deriv()(x), atol=1e-12)
    np.testing.assert_allclose(road[:, 0, 2], cubic(x - 4.5), atol=1e-12)
    assert not road[:, :, [1, 3]].any()


def test_missing_samples_are_left_out_of_a_block_mean():
    a = np.array([[1.0, 2.0, 99.0, 4.0, 5.0, 6.0, 7.0]])
    valid = np.array([[True, True, False, False, False, False, True]])
    means = block_means(a, valid, 3)
    np.testing.assert_allclose(means.y, [[1.5, 0.0]])
    np.testing.assert_array_equal(means.sample_count, [[2.0, 0.0]])
    np.testing.assert_allclose(means.average(2.0 * a[:, :6]), [[3.0, 0.0]])


def test_samples_near_a_clipped_one_are_invalid_and_those_near_a_lost_one_are_not():
    record = drive()
    a = record.a.copy()
    a[0, 100], a[1, 200] = np.nan, -PAPER.range
    valid = mask_record(replace(record, a=a), PAPER).valid
    assert (~valid[0]).nonzero()[0].tolist() == [100]
    assert (~valid[1]).nonzero()[0].tolist() == list(range(197, 204))
    assert valid[2].all()


def test_model_inputs_lead_the_samples_by_the_anti_alias_delay():
    assert antialias_delay(PAPER) == pytest.approx(2.613 / (2.0 * np.pi * 333.0), rel=1e-3)
    record = drive()
    inputs = build_model_inputs(record, PAPER, DEFENDER, max_step=0.0004)
    assert inputs.decimation == 3 and inputs.h == pytest.approx(1e-3 / 3)
    at = np.interp(record.t[50] - antialias_delay(PAPER), record.t, record.s)
    assert inputs.s[2 * 50 * 3] == pytest.approx(at, abs=1e-9)


def test_a_command_reaches_the_valves_after_their_delay():
    record = drive()
    stiff = np.zeros_like(record.spring_stiff)
    stiff[500:, 2] = True
    inputs = build_model_inputs(
        replace(record, spring_stiff=stiff, damper_high=stiff), PAPER, DEFENDER, max_step=0.001
    )
    first = int(np.argmax(inputs.commands))
    assert inputs.commands[first] == encode_command(
        {"FL": "ride", "FR": "ride", "RL": "handling", "RR": "ride"}
    )
    assert record.t[first] - record.t[500] == pytest.approx(
        DEFENDER.valve.delay + antialias_delay(PAPER), abs=0.001
    )
