"""Comparison of switching policies: metrics, drives, statistics, configuration."""

import io
import json
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from rich.console import Console
from scipy.stats import trim_mean

import estimators
from leaderboard.commands import policies as policies_command
from leaderboard.policies import comparison
from leaderboard.policies import page as policy_page
from leaderboard.policies.ride_metrics import (
    METRICS,
)
from leaderboard.policies.scenarios import Scenarios, load_scenarios
from leaderboard.policies.summary import case_mean, paired_difference, pareto, summarize_results
from leaderboard.policies.timeline import MODE_NAMES, Timeline, drive_chart
from road_envs.core.config import ConfigError, build, names
from road_envs.drives.recording import simulate_record
from road_envs.envs.options import EnvSetup
from road_envs.envs.vector import RoadReconVectorEnv
from road_envs.policies import create
from road_envs.policies.rollout import roll_out
from road_envs.vehicle.equations import Z_B
from road_envs.vehicle.parameters import load_vehicle

TURN = {"kind": "slalom", "begin": 0.0, "period": 1.0}
CAR = load_vehicle("land_rover_defender_110")


def scenarios(**changes) -> Scenarios:
    """Return scenarios with two cases of 25 m."""
    settings = {
        "name": "small",
        "title": "Two short cases",
        "cases": [
            {"road": "iso_d", "speed_kmh": 54.0},
            {"road": "iso_c", "speed_kmh": 54.0, "manoeuvre": TURN},
        ],
        "length": 25.0,
        "test": {"first": 101, "number": 3},
        "training": {"first": 1, "number": 2},
    }
    return build(Scenarios, {**settings, **changes}, "small")


@dataclass
class Wrong:
    """Policy that fails in the given way."""

    how: str

    def reset(self, context):
        self.context = context

    def act(self, observations):
        match self.how:
            case "raises":
                raise RuntimeError("no idea")
            case "outside":
                return np.full(len(observations), 99)
            case "hangs":
                while True:
                    time.sleep(0.01)
            case "reads the truth":
                return self.context.info["profile"]


# --- drives ---------------------------------------------------------------------------------------


def test_the_repeated_simulation_reproduces_the_costs_of_the_environment():
    """Simulated again with the same commands, also in a manoeuvre."""
    prepared = comparison.prepare_case(scenarios(), 1, [101, 102])
    rollout = roll_out(create("random"), prepared.options, prepared.seeds)
    envs = RoadReconVectorEnv(2, **prepared.options)
    envs.reset(seed=list(prepared.seeds))
    rattle, lasted = [], int(rollout.intervals[0])
    for actions in rollout.actions:
        rattle.append(envs.step(actions)[4]["rattle"])
    for k, moved in enumerate(comparison.trajectories(prepared, rollout)):
        e = moved.extension[20:].reshape(lasted, 20, 4)
        np.testing.assert_allclose(
            np.sqrt(np.mean(e**2, axis=(1, 2))), np.array(rattle)[:, k], rtol=1e-9
        )


def test_the_record_of_a_policy_equals_a_simulated_record_in_the_same_mode():
    straight = scenarios(cases=[{"road": "iso_d", "speed_kmh": 54.0}], sensors="ideal")
    prepared = comparison.prepare_case(straight, 0, [101])
    rollout = roll_out(create("fixed_ride"), prepared.options, prepared.seeds)
    record = comparison.record_of(prepared, rollout, 0)
    surface = prepared.starts[0].surface
    expected, truth = simulate_record(
        surface,
        vehicle=CAR,
        speed_kmh=54.0,
        mode="ride",
        instruments=prepared.setup.instruments,
        seed=0,
    )
    n = expected.t.size
    np.testing.assert_allclose(record.a[:, :n], expected.a, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(record.s[:n], expected.s, rtol=1e-6, atol=1e-5)
    np.testing.assert_array_equal(record.spring_stiff[:n], expected.spring_stiff)
    np.testing.assert_array_equal(prepared.truths[0].z, truth.z)


def test_a_record_has_the_commanded_states():
    prepared = comparison.prepare_case(scenarios(), 0, [101])
    rollout = roll_out(create("fixed_ride_handling"), prepared.options, prepared.seeds)
    record = comparison.record_of(prepared, rollout, 0)
    assert not record.spring_stiff[:20].any() and not record.spring_stiff[:, :2].any()
    assert record.spring_stiff[20:, 2:].all() and record.damper_high[20:, 2:].all()


def test_no_policy_receives_the_truth():
    for c, case in enumerate(scenarios().cases):
        options = scenarios().options(case)
        assert options["truth"] is False
        envs = RoadReconVectorEnv(1, **options)
        infos = envs.reset(seed=c)[1], envs.step(np.zeros(1, dtype=int))[4]
        for info in infos:
            assert not {"profile", "loads", "s"} & info.keys()


def test_a_failing_policy_is_a_row_and_does_not_affect_the_others():
    wrong = {
        "raises": "RuntimeError: no idea",
        "outside": "PolicyError: actions must be 0 to 15, got 99",
        "hangs": "TimeoutError: not finished after 3 s",
        "reads the truth": "AttributeError: 'PolicyContext' object has no attribute 'info'",
    }
    alone = comparison.compare(scenarios(), {"fixed_ride": create("fixed_ride")}, {})[0]
    entries = {how: Wrong(how) for how in wrong} | {"fixed_ride": create("fixed_ride")}
    *rows, ride = comparison.compare(scenarios(), entries, {}, seconds=3.0)
    for row in rows:
        assert row.failure == f"iso_d, 54 km/h, straight on: {wrong[row.policy]}"
    assert ride.failure is None
    for name, values in alone.metrics.items():
        np.testing.assert_array_equal(ride.metrics[name], values)
    data = summarize_results(scenarios(), [*rows, ride], [101, 102, 103], "fixed_ride")
    assert "no idea" in policy_page.render_page(data)


def test_handling_is_harsher_uses_less_travel_and_mixed_states_lower_the_bound():
    chosen = ("fixed_ride", "fixed_handling", "fixed_ride_handling")
    rows = comparison.compare(scenarios(), {n: create(n) for n in chosen}, {})
    ride, handling, mixed = (row.metrics for row in rows)
    assert (handling["comfort"] > ride["comfort"]).all()
    assert (handling["rattle"] < ride["rattle"]).all()
    assert (mixed["bound"] < np.minimum(ride["bound"], handling["bound"])).all()


def test_estimators_receive_the_records_and_a_failing_one_is_noted(monkeypatch):
    class Blind:
        def estimate(self, record, car):
            raise RuntimeError("too dark")

    readers = {"flat": estimators.create("flat"), "blind": Blind()}
    (row,) = comparison.compare(scenarios(), {"fixed_ride": create("fixed_ride")}, readers)
    np.testing.assert_allclose(row.errors["flat"], 1.0)
    assert np.isnan(row.errors["blind"]).all()
    assert len(row.notes) == 2 and "too dark" in row.notes[0]
    data = summarize_results(scenarios(), [row], [101, 102, 103], "fixed_ride")
    assert "too dark" in json.dumps(data["rows"])


def test_the_table_fits_80_columns_and_the_wide_one_has_more_metrics(monkeypatch):
    rng, names = np.random.default_rng(0), ("fir_ridge", "iterated_wiener")
    rows = [
        comparison.PolicyResult(
            name,
            {metric: rng.random((3, 2)) for metric in METRICS},
            {reader: rng.random((3, 2)) for reader in names},
        )
        for name in ("fixed_ride_handling", "greedy_information", "random")
    ]
    rows.append(comparison.PolicyResult("mine", failure="iso_d: RuntimeError: " + 30 * "no idea "))
    data = summarize_results(scenarios(), rows, [101, 102, 103], "greedy_information")
    cell = data["rows"][0]["metrics"]["comfort"]
    expected = paired_difference(rows[0].metrics["comfort"], rows[1].metrics["comfort"])
    assert list(cell["difference"].values()) == pytest.approx(expected, rel=1e-4)
    more = paired_difference(rows[0].metrics["return"], rows[1].metrics["return"])
    assert list(data["rows"][0]["more_than"]) == [
        "greedy_information"
    ]  # no tuned policy is compared
    assert list(data["rows"][0]["more_than"]["greedy_information"].values()) == pytest.approx(
        more, rel=1e-4
    )
    assert "paired differences" in policy_page.render_page(data)
    printed = []
    for columns in (policies_command.COLUMNS, policies_command.WIDE_COLUMNS):
        page = io.StringIO()
        monkeypatch.setattr(policies_command, "console", Console(width=80, file=page))
        policies_command._print(data, columns)
        printed.append(page.getvalue())
    narrow, wide = printed
    assert max(map(len, narrow.splitlines())) <= 80
    for row in data["rows"][:3]:
        line = next(x for x in narrow.splitlines() if x.startswith(row["policy"]))
        assert f"{row['errors']['iterated_wiener']['mean']:.3f} ±" in line
    assert "mine failed: iso_d: RuntimeError" in narrow
    assert "rattle" in wide and "rattle" not in narrow


# --- statistics -----------------------------------------------------------------------------------


def test_a_paired_difference_cancels_the_effect_of_the_roads():
    rng = np.random.default_rng(0)
    road = 10.0 * rng.random((40, 1))
    better = road + 0.1 * rng.standard_normal((40, 2))
    worse = road + 0.3 + 0.1 * rng.standard_normal((40, 2))
    found = paired_difference(better, worse)
    assert found.low < found.mean < found.high < 0.0
    assert found.mean == pytest.approx(-0.3, abs=0.5)
    assert paired_difference(better, better) == (0.0, 0.0, 0.0)
    by_hand = [np.mean([trim_mean(x[:, c], 0.25) for c in range(2)]) for x in (better, worse)]
    assert found.mean == pytest.approx(by_hand[0] - by_hand[1])


def test_cases_count_equally_and_outlier_roads_are_trimmed():
    easy = np.random.default_rng(0).random(40)
    hard = 10.0 + easy
    odd = np.where(np.arange(40) == 3, 1e6, hard)
    x = np.stack([easy, easy, easy, odd], axis=1)
    expected = np.mean([*[trim_mean(easy, 0.25)] * 3, trim_mean(hard, 0.25)])
    found = case_mean(x)
    assert found.mean == pytest.approx(expected, rel=0.01)
    assert found.low < found.mean < found.high < 4.0
    seeds = case_mean(np.stack([x, x], axis=2))
    assert seeds.mean == pytest.approx(found.mean)


def test_a_timeline_has_the_road_states_and_motion_of_the_drive():
    prepared = comparison.prepare_case(scenarios(), 1, [101])
    rollout = roll_out(create("fixed_ride_handling"), prepared.options, prepared.seeds)
    moved = next(comparison.trajectories(prepared, rollout))
    line = Timeline.from_trajectory(moved, prepared.starts[0].surface)
    assert np.diff(line.t) == pytest.approx(0.02)
    np.testing.assert_array_equal(line.acceleration, moved.acceleration[::20, Z_B])
    np.testing.assert_array_equal(line.road, prepared.starts[0].surface.height(moved.s[::20]))
    assert set(line.states[0]) == {0} and MODE_NAMES[line.states[1, -1]] == "handling"
    still = line._replace(states=np.zeros_like(line.states), roll=0.0 * line.roll)
    chart = drive_chart({"mine": line, "still": still})
    traces = {trace["name"]: trace for trace in chart["figures"]["mine"]["data"]}
    assert traces["roll"]["y"] == pytest.approx(np.degrees(line.roll), abs=0.006)
    bars = traces["handling"]
    assert bars["y"] == ["rear"] and bars["base"] == [pytest.approx(0.0, abs=0.03)]
    assert bars["x"][0] == pytest.approx(line.t[-1] - line.t[0], abs=0.05)
    assert not any(trace.get("base") for trace in chart["figures"]["still"]["data"])
    low, high = chart["layout"]["yaxis4"]["range"]
    assert -low == high > np.degrees(np.abs(line.roll).max())
    data = summarize_results(
        scenarios(), [comparison.PolicyResult("mine", failure="why")], [101], "mine"
    )
    page = policy_page.render_page(data, {"mine": line})
    assert 'data-source="drive"' in page and "<option selected>mine</option>" in page


@given(st.lists(st.tuples(*[st.integers(0, 3)] * 3), min_size=1, max_size=8))
def test_the_pareto_front_is_the_set_of_policies_that_none_dominates(points):
    rows = {
        f"p{i}": comparison.PolicyResult(
            f"p{i}",
            {"comfort": np.full((3, 1), x), "tyre_load": np.full((3, 1), y)},
            {"reader": np.full((3, 1), z)},
        )
        for i, (x, y, z) in enumerate(points)
    }
    found = pareto(rows, list(rows))
    for i, p in enumerate(points):
        beaten = any(q != p and all(b <= a for a, b in zip(p, q, strict=True)) for q in points)
        assert found[i] == (not beaten)


# --- configuration --------------------------------------------------------------------------------


@pytest.mark.parametrize("name", names("scenarios"))
def test_shipped_scenarios_are_valid_and_separate_training_from_test(name):
    shipped = load_scenarios(name)
    assert shipped.name == name
    assert all(isinstance(setup, EnvSetup) for setup in shipped.setups)
    assert not set(shipped.test.seeds) & set(shipped.training.seeds)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"training": {"first": 99, "number": 5}}, r"share the seeds 101 to 103"),
        ({"cases": []}, "cases: must have at least 1 element"),
        ({"cases": [{"road": "iso_d", "speed_kmh": 54.0}] * 2}, "cases must be distinct"),
        ({"test": {"first": 101, "number": 1}}, "test.number: must be at least 2, got 1"),
        ({"shown": 2}, "index of a case, 0 to 1, got 2"),
        ({"kases": []}, "unknown key, did you mean 'cases'"),
        ({"control": "wheel"}, "'vehicle', 'axle' or 'states'"),
    ],
)
def test_errors_of_invalid_scenarios_name_the_cause(changes, message):
    with pytest.raises(ConfigError, match=message):
        scenarios(**changes)


def test_the_error_of_an_invalid_case_names_the_case():
    bad = scenarios(cases=[{"road": "iso_d", "speed_kmh": 54.0, "manoeuvre": "loop"}])
    with pytest.raises(ConfigError, match=r"small: iso_d, 54 km/h, loop: .*'loop'"):
        _ = bad.setups
    with pytest.raises(ConfigError, match="number of roads must be 2 to 3"):
        scenarios().test_seeds(4)


def test_results_have_exactly_the_listed_metrics():
    (row,) = comparison.compare(scenarios(), {"fixed_ride": create("fixed_ride")}, {})
    assert row.metrics.keys() == METRICS.keys()
    assert row.metrics["comfort"].shape == (3, 2)
    assert Z_B == 0


def test_page_and_plot_are_drawn_again_from_kept_numbers(tmp_path, capsys):
    kept = Path(__file__).parents[2] / "docs/policies/policies.json"
    policies_command.policies(kept=kept, out=tmp_path / "plot.png")
    with Image.open(tmp_path / "plot.png") as plot:
        assert plot.width > 1000
    policies_command.policies(kept=kept, out=tmp_path)
    assert "greedy_information" in (tmp_path / "policies.html").read_text()
    (tmp_path / "broken.json").write_text('{"rows": [{}]}')
    with pytest.raises(ConfigError, match=r"is not the policies\.json of a comparison"):
        policies_command.policies(kept=tmp_path / "broken.json", out=tmp_path / "x.png")
    assert not (tmp_path / "x.png").exists()
