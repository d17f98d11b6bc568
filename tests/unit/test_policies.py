"""Switching policies against their laws, for each vehicle, and networks stored without pickle."""

import itertools
import pickle
from importlib import metadata

import numpy as np
import pytest
from gymnasium.utils import seeding
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import butter, sosfiltfilt

import road_envs.policies as policies
from road_envs.core.config import ConfigError
from road_envs.envs.options import EnvSetup
from road_envs.envs.vector import RoadReconVectorEnv
from road_envs.policies import REGISTRY, available, create
from road_envs.policies.api import PolicyContext, PolicyError, validate_actions
from road_envs.policies.body_motion import BodyMotionEstimator, RunningRms
from road_envs.policies.features import N_FEATURES
from road_envs.policies.greedy_information import GreedyInformation
from road_envs.policies.network_policy import NetworkPolicy, PolicyNetwork
from road_envs.policies.rollout import roll_out
from road_envs.policies.wheelbase_preview import WheelbasePreview

OPTIONS = {
    "road": "iso_d",
    "length": 8.0,
    "speed_kmh": 54.0,
    "control": "states",
    "control_rate": 50.0,
    "manoeuvre": {"kind": "slalom", "begin": 0.0, "period": 0.8},
    "observe": ["accelerations", "planar", "struts"],
}
SETUP = EnvSetup(dict(OPTIONS))
LAWS = ("skyhook", "groundhook", "add", "sh_add")


def context(number: int = 1) -> PolicyContext:
    return PolicyContext.from_setup(SETUP, number, seed=0)


def observed(number: int = 1, **parts) -> np.ndarray:
    """Return observations (number, d) that are zero except for `parts`."""
    x = np.zeros((number, SETUP.observation_space.shape[0]), dtype=np.float32)
    for name, value in parts.items():
        x[:, SETUP.observation_slices[name]] = value
    return x


def pair_of(action) -> tuple[str, str]:
    return context().actions[int(action)]


@pytest.mark.parametrize("name", REGISTRY)
@pytest.mark.costly
def test_every_policy_runs_and_vehicles_do_not_affect_each_other(name):
    policy = create(name)
    three = roll_out(policy, OPTIONS, [5, 6, 7])
    if name == "random":  # one generator draws for all vehicles
        return
    alone = roll_out(policy, OPTIONS, [6])
    np.testing.assert_array_equal(three.actions[:, 1], alone.actions[:, 0])
    np.testing.assert_array_equal(three.observations[:, 1], alone.observations[:, 0])
    assert three.returns[1] == alone.returns[0]


@pytest.mark.parametrize(
    ("name", "pair"),
    [
        ("fixed_ride", ("ride", "ride")),
        ("fixed_handling", ("handling", "handling")),
        ("fixed_ride_handling", ("ride", "handling")),
        ("fixed_handling_ride", ("handling", "ride")),
    ],
)
def test_fixed_policies_keep_their_pair_of_states(name, pair):
    assert {pair_of(a) for a in roll_out(create(name), OPTIONS, [1, 2]).actions.ravel()} == {pair}


def test_random_switching_holds_each_draw_and_draws_all_actions():
    policy = create("random", hold=0.04)
    policy.reset(context(500))
    actions = np.array([policy.act(observed(500)) for _ in range(4)])
    np.testing.assert_array_equal(actions[0], actions[1])
    assert (actions[1] != actions[2]).any()
    assert set(actions.ravel().tolist()) == set(range(16))


@given(st.integers(0, 2**32 - 1))
def test_the_control_laws_are_the_published_ones(seed):
    """v and a are positive upwards, e' in extension; the damper force on the body is along -e'."""
    v, a, e_dot = np.random.default_rng(seed).standard_normal((3, 4))
    alpha = 2.0 * np.pi * 1.9
    wheel = v - e_dot
    expected = {
        "skyhook": v * -e_dot < 0,  # the force decelerates the body
        "groundhook": wheel * e_dot < 0,  # the force along e' decelerates the wheel
        "add": a * -e_dot < 0,
        "sh_add": np.where(a**2 - alpha**2 * v**2 <= 0, v * e_dot > 0, a * e_dot > 0),
    }
    for name in LAWS:
        law = REGISTRY[name]().law(v, a, e_dot) > 0
        np.testing.assert_array_equal(law, expected[name], err_msg=name)


def test_a_two_state_damper_switches_the_axle_with_positive_work():
    policy = create("add", high="soft_high", bias=0.0)
    policy.reset(context())
    up = dict.fromkeys(("RF", "LR", "RR"), 1.0)  # the body accelerates upwards
    rates = np.array([0.1, 0.1, -0.1, -0.1])  # the front struts extend
    assert pair_of(policy.act(observed(**up, extension_rate=rates))[0]) == ("soft_high", "ride")


def test_body_rates_are_recovered_from_accelerations():
    """For a sine of heave far above the leak the rate is the integral, a quarter period late."""
    one, w, dt = context(), 2.0 * np.pi * 2.0, SETUP.interval
    body, rates = BodyMotionEstimator(one, leak=0.05), []
    t = dt * np.arange(500)
    for k in t:
        heave = np.cos(w * (k + 0.001 * np.arange(SETUP.samples_per_interval)))
        body.update(observed(RF=heave, LR=heave, RR=heave))
        rates.append(body.v[0].copy())
    rates = np.array(rates)
    inside = t > 6.0
    expected = np.sin(w * (t + dt)) / w
    assert np.abs(rates[inside, 0] - expected[inside]).max() < 0.06 / w
    assert np.abs(rates[:, 1:]).max() < 1e-9


def test_heave_roll_and_pitch_are_separated():
    one = context()
    body = BodyMotionEstimator(one, leak=0.1)
    motion = np.array([0.7, -0.4, 0.3])
    locations = one.instruments.locations(one.car)
    signals = {n: motion[0] + y * motion[1] - x * motion[2] for n, (x, y, _) in locations.items()}
    body.update(observed(**signals))
    np.testing.assert_allclose(body.a[0], motion, rtol=1e-5)
    corners = body.at_strut_mounts(body.a)[0]
    front, rear = one.car.axles
    assert corners[0] == pytest.approx(0.7 - 0.4 * front.y_s - 0.3 * front.x, rel=1e-5)
    assert corners[3] == pytest.approx(0.7 + 0.4 * rear.y_s - 0.3 * rear.x, rel=1e-5)


@given(st.lists(st.floats(-5, 5), min_size=1, max_size=40))
def test_the_running_rms_equals_the_rms_of_the_window(values):
    running = RunningRms(context(), 0.2)
    x = np.concatenate([np.zeros(10), values])
    for k, value in enumerate(values):
        expected = np.sqrt(np.mean(x[k + 1 : k + 11] ** 2))
        assert running.add(np.array([value]))[0] == pytest.approx(expected, abs=1e-12)


def test_rrms_compares_lateral_with_vertical_acceleration():
    policy = create("rrms", window=0.1, ratio=2.0)
    policy.reset(context(3))
    up = dict.fromkeys(("RF", "LR", "RR"), 1.0)
    planar = np.array([[0.0, 1.9], [0.0, -2.1], [9.0, 0.0]])
    for _ in range(6):
        actions = policy.act(observed(3, **up, planar=planar))
    assert [pair_of(a)[0] for a in actions] == ["ride", "handling", "ride"]


@pytest.mark.costly
def test_greedy_information_takes_the_pair_of_least_cost():
    slow = observed(speed=15.0)
    chosen = []
    for weight in (0.0, 1e6):
        policy = create("greedy_information", weight=weight)
        policy.reset(context())
        action = int(policy.act(slow)[0])
        assert action == int(np.argmin(policy.action_costs(15.0)))
        chosen.append(pair_of(action))
    assert chosen[0] == ("ride", "ride")
    assert chosen[1][0] != chosen[1][1]


@pytest.mark.costly
def test_expected_comfort_agrees_with_simulated_drives():
    """The closed form of the linear vehicle against simulation on class D; friction causes 15 %."""
    straight = {**OPTIONS, "manoeuvre": None, "length": 300.0}
    for name, pair in (("fixed_ride", ("ride", "ride")), ("fixed_handling", ("handling",) * 2)):
        envs = RoadReconVectorEnv(4, **straight, truth=False)
        envs.reset(seed=20)
        policy = create(name)
        policy.reset(PolicyContext.from_setup(envs.setup, 4, 0))
        squares = []
        for _ in range(900):
            step = envs.step(policy.act(np.zeros((4, 1))))
            squares.append(step[4]["comfort"] ** 2)
        measured = np.sqrt(np.mean(squares[50:]))
        costs = GreedyInformation(weight=0.0)
        costs.reset(PolicyContext.from_setup(envs.setup, 4, 0))
        expected = costs.action_costs(15.0)[costs.context.action_index(*pair)]
        assert expected == pytest.approx(measured, rel=0.15)


def test_a_policy_of_another_package_is_available_by_its_name(monkeypatch):
    class Entry:
        name, value = "mine", "somewhere:Mine"

        def load(self):
            return REGISTRY["fixed_ride"]

    monkeypatch.setattr(metadata, "entry_points", lambda group: [Entry()])
    assert available()["mine"] is REGISTRY["fixed_ride"]
    Entry.name = "random"
    with pytest.raises(ConfigError, match="'random' of somewhere:Mine is already taken by"):
        available()
    Entry.name, Entry.load = "mine", lambda self: print
    with pytest.warns(policies.PluginWarning, match="must be a dataclass"):
        assert "mine" not in available()


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("skihook", {}, "did you mean 'skyhook'"),
        ("skyhook", {"lek": 1.0}, "did you mean 'leak'"),
        ("skyhook", {"leak": -1.0}, "leak: must be positive, got -1.0 Hz"),
        ("skyhook", {"high": "hard"}, "'handling' or 'soft_high'"),
        ("rrms", {"window": 0.0}, "window: must be positive"),
        ("learned", {"file": "none.npz"}, "none.npz: cannot be read: No such file"),
    ],
)
def test_an_unknown_policy_or_invalid_setting_is_named(name, settings, message):
    with pytest.raises(ConfigError, match=message):
        create(name, **settings)


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        (np.array([0, 16]), "0 to 15, got 16"),
        (np.array([-1, 0]), "0 to 15, got -1"),
        (np.array([0.5, 0.0]), "2 whole numbers, got float64"),
        (np.zeros(3, dtype=int), r"shape \(3,\)"),
        (None, "2 whole numbers, got object"),
    ],
)
def test_invalid_actions_are_named(actions, message):
    with pytest.raises(PolicyError, match=message):
        validate_actions(actions, context(2))


def test_a_missing_observation_or_action_is_named():
    plain = EnvSetup({**OPTIONS, "observe": ["accelerations"], "control": "vehicle"})
    policy = create("skyhook")
    policy.reset(PolicyContext.from_setup(plain, 1, 0))
    with pytest.raises(ConfigError, match="'extension_rate' is not observed"):
        policy.act(np.zeros((1, 65)))
    with pytest.raises(ConfigError, match="no action commands ride in front and handling"):
        create("fixed_ride_handling").reset(PolicyContext.from_setup(plain, 1, 0))


# --- wheelbase preview ----------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["fixed_ride", "random"])
def test_estimated_heights_under_the_front_axle_follow_the_road(name):
    """In the scored band and without delay, in one state and with random switching."""
    options = {**OPTIONS, "length": 60.0, "speed_kmh": 30.0, "manoeuvre": None}
    rollout = roll_out(create(name), options, [21, 22])
    setup = EnvSetup(dict(options))
    preview = WheelbasePreview(PolicyContext.from_setup(setup, 2, 0))
    heights = []
    for observations in rollout.observations:
        preview.update(observations)
        heights.append(preview.wheel_heights[:, :2].copy())
    v = 30.0 / 3.6
    station = -5.0 + v * setup.interval * np.arange(1, len(heights) + 1)
    sos = butter(2, [0.2, 1.8], "bandpass", fs=1.0 / (v * setup.interval), output="sos")
    for k, seed in enumerate((21, 22)):
        rng = seeding.np_random(seed)[0]
        surface = setup.prepare(rng, setup.options).drive.surface
        inside = (station > 0.0) & (station < 60.0)
        truth = sosfiltfilt(sos, surface.height(station[inside]), axis=1)
        estimate = sosfiltfilt(sos, np.array(heights)[inside, k].T, axis=1)
        assert np.sqrt(np.mean((estimate - truth) ** 2) / np.mean(truth**2)) < 0.4


def test_front_axle_heights_move_towards_the_rear_axle():
    """A step under the front wheels moves towards the rear axle at the speed of the vehicle."""
    preview, observations = WheelbasePreview(context(2)), observed(2, speed=15.0)
    step = 15.0 * SETUP.interval  # 0.3 m per interval
    for _ in range(20):
        preview.update(observations)
    preview.history[preview.newest, 1] = [0.02, -0.01]
    for k in range(9):
        at = preview.wheelbase - step * k
        heights = preview.heights_at(np.array([at - step, at, at - 0.5 * step]))[1]
        np.testing.assert_allclose(heights[1], [0.02, -0.01], atol=1e-12)
        if k:
            np.testing.assert_allclose(heights[2], [0.01, -0.005], atol=1e-12)
            assert np.abs(heights[0]).max() < 1e-12
        assert not preview.heights_at(np.array([at]))[0].any()
        preview.update(observations)


# --- networks -------------------------------------------------------------------------------------


def network(rng=None) -> PolicyNetwork:
    rng = rng or np.random.default_rng(0)
    sizes = (N_FEATURES, 8, 16)
    layers = tuple(
        (rng.standard_normal((b, a)).astype(np.float32), rng.standard_normal(b).astype(np.float32))
        for a, b in itertools.pairwise(sizes)
    )
    return PolicyNetwork(layers, {"activation": "tanh", "control": "states", "held": 1})


def test_a_stored_network_round_trips_and_computes_the_formula(tmp_path):
    path = tmp_path / "n.npz"
    path.write_bytes(network().to_bytes())
    again = NetworkPolicy(file=str(path)).network
    x = np.random.default_rng(1).standard_normal((5, N_FEATURES))
    (W_0, b_0), (W_1, b_1) = network().layers
    expected = [W_1 @ np.tanh(W_0 @ row + b_0) + b_1 for row in x]
    np.testing.assert_allclose(again.forward(x), expected, rtol=1e-6)
    driven = roll_out(NetworkPolicy(file=str(path)), OPTIONS, [3])
    assert driven.actions.shape[1] == 1


def test_a_shipped_policy_is_its_shipped_file_whatever_lies_in_the_working_folder(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    shipped = create("learned").network
    with pytest.raises(ConfigError, match=r"^learned\.npz: cannot be read: No such file"):
        NetworkPolicy(file="learned.npz")
    (tmp_path / "learned.npz").write_bytes(network().to_bytes())
    assert create("learned").network.to_bytes() == shipped.to_bytes()
    assert NetworkPolicy(file="learned.npz").network.to_bytes() == network().to_bytes()


def test_an_untrusted_file_is_never_unpickled(tmp_path):
    ran = tmp_path / "ran"

    class Trap:
        def __reduce__(self):
            return (open, (str(ran), "w"))

    path = tmp_path / "trap.npz"
    np.savez(path, about=np.array(Trap(), dtype=object))
    with pytest.raises(ConfigError, match="not a stored policy"):
        NetworkPolicy(file=str(path))
    path.write_bytes(pickle.dumps(Trap()))
    with pytest.raises(ConfigError, match="not a stored policy"):
        NetworkPolicy(file=str(path))
    assert not ran.exists()


@pytest.mark.parametrize("fault", ["shape", "nan", "format", "missing", "cut"])
def test_a_damaged_network_is_rejected(tmp_path, fault):
    good, path = network(), tmp_path / "n.npz"
    (W, b), last = good.layers
    if fault == "shape":
        data = PolicyNetwork(((W[:, :-1], b), last), good.metadata).to_bytes()
    elif fault == "nan":
        data = PolicyNetwork(((W * np.nan, b), last), good.metadata).to_bytes()
    elif fault == "format":
        data = PolicyNetwork(good.layers, {**good.metadata, "activation": "sine"}).to_bytes()
    elif fault == "missing":
        data = PolicyNetwork(((W, b),), good.metadata).to_bytes()
    else:
        data = good.to_bytes()[:-40]
    path.write_bytes(data)
    reason = "unknown activation 'sine'" if fault == "format" else "not a stored policy"
    with pytest.raises(ConfigError, match=rf"n\.npz: {reason}"):
        NetworkPolicy(file=str(path))
