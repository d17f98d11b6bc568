"""Rendered frames against the numbers they show, and rendering on demand only."""

import copy
import dataclasses
import pickle
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from PIL import Image

import road_envs  # registers the environment
from leaderboard.commands.animate import animate as animate_command
from leaderboard.report.animation import animate
from leaderboard.report.rendering import STATIC
from road_envs.core.config import ConfigError
from road_envs.envs.road_recon import RoadReconEnv
from road_envs.records.record import SENSORS
from road_envs.rendering import HEIGHT, WIDTH, Scene, panels, render_frame, style
from road_envs.roads import load_road
from road_envs.simulation.drive import DriveSimulator
from road_envs.vehicle.equations import AXLE, PHI, THETA, Z_B, build_plant
from road_envs.vehicle.parameters import load_vehicle
from road_envs.vehicle.suspension import MODES, encode_command

CAR = load_vehicle("land_rover_defender_110")
SIDE = (slice(40, 344), slice(0, 639))
REAR = (slice(40, 344), slice(640, 960))
CORNERS = (slice(345, 540), slice(640, 960))
SHORT = {"road": "iso_d", "length": 20.0, "speed_kmh": 54.0}


def make(**options):
    return gym.make(road_envs.ID, render_mode="rgb_array", **{**SHORT, **options})


def scene(road="flat", seconds=0.05, mode="ride", **changes):
    """Return the scene after a drive at 10 m/s, with some fields replaced."""
    surface = load_road(road).realise(np.random.default_rng(0))
    drive = DriveSimulator(build_plant(CAR), CAR, surface, 10.0, mode)
    trajectory = drive.advance(np.full(round(1000 * seconds), encode_command(mode), dtype=np.uint8))
    view = {"samples": np.zeros((3, 50)), "fs": 1000.0, "window": 4.0, "exaggeration": 1.0}
    default = Scene.from_drive(drive, trajectory, sensors=SENSORS, **view)
    return dataclasses.replace(default, **changes)


def moved(coordinate, amount):
    q = np.zeros(7)
    q[coordinate] = amount
    return scene(q=q)


def where(picture, colour, part=(slice(None), slice(None))):
    """Return which pixels of a part of the frame have exactly this colour."""
    value = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
    return (picture[part] == value).all(axis=2)


def top(mask):
    """Return the topmost row of a mask."""
    return int(np.flatnonzero(mask.any(axis=1))[0])


def test_equal_episodes_render_equal_frames():
    one, other = make(), make()
    one.reset(seed=1)
    other.reset(seed=1)
    before = one.render()
    assert before.shape == (HEIGHT, WIDTH, 3) and before.dtype == np.uint8
    np.testing.assert_array_equal(before, one.render())
    np.testing.assert_array_equal(before, other.render())
    one.step(1)
    other.step(1)
    np.testing.assert_array_equal(one.render(), other.render())
    assert (one.render() != before).any(axis=2).mean() > 0.02


def test_a_second_episode_shows_no_data_of_the_first():
    used, fresh = make(), make()
    used.reset(seed=1)
    for _ in range(20):
        used.step(0)
    used.reset(seed=2)
    fresh.reset(seed=2)
    np.testing.assert_array_equal(used.render(), fresh.render())


def test_rendering_does_not_change_the_episode():
    watched, alone = make(), make()
    watched.reset(seed=2)
    alone.reset(seed=2)
    for action in (0, 1, 0):
        watched.render()
        np.testing.assert_array_equal(watched.step(action)[0], alone.step(action)[0])


@pytest.mark.parametrize("road", ["flat", "bump_large_small"])
def test_the_same_road_under_both_sides_gives_a_symmetric_rear_view(road):
    picture = render_frame(scene(road, seconds=1.8))[REAR][30:225].astype(float)
    assert np.abs(picture - picture[:, ::-1]).mean() < 0.2


def test_different_wheel_paths_give_a_lopsided_rear_view():
    picture = render_frame(scene("bump_asymmetric", seconds=1.8))[REAR][30:225].astype(float)
    assert np.abs(picture - picture[:, ::-1]).mean() > 1.0


def test_positive_roll_lifts_the_left_side():
    roof = where(render_frame(moved(PHI, 0.05)), style.ROOF, REAR)
    left, right = top(roof[:, 90:96]), top(roof[:, 224:230])
    assert right - left == pytest.approx(0.05 * 1.3 * 104, abs=3)


def test_positive_axle_roll_lifts_the_left_wheel():
    tyres = where(render_frame(moved(AXLE + 3, 0.1)), style.RUBBER, REAR)
    left, right = top(tyres[:, 65:100]), top(tyres[:, 220:255])
    assert right - left == pytest.approx(0.1 * 1.5 * 104, abs=3)


def test_positive_pitch_lowers_the_nose():
    level, dipped = (where(render_frame(moved(THETA, a)), style.BODY, SIDE) for a in (0.0, 0.04))
    nose, tail = slice(440, 490), slice(100, 140)
    assert top(dipped[:, nose]) > top(level[:, nose]) + 3
    assert top(dipped[:, tail]) < top(level[:, tail]) - 3


def test_heave_is_drawn_to_scale_or_with_the_stated_exaggeration():
    rest = top(where(render_frame(scene()), style.ROOF, SIDE))
    raised = top(where(render_frame(moved(Z_B, 0.1)), style.ROOF, SIDE))
    large = dataclasses.replace(moved(Z_B, 0.1), exaggeration=3.0)
    assert rest - raised == pytest.approx(9.2, abs=1)
    assert rest - top(where(render_frame(large), style.ROOF, SIDE)) == pytest.approx(27.6, abs=1)
    assert (large.scale_caption, scene().scale_caption) == ("vertical motion ×3", "to scale")


@pytest.mark.parametrize("exaggeration", [1.0, 3.0])
def test_a_wheel_leaves_the_drawn_road_when_its_tyre_is_unloaded(exaggeration):
    rest = CAR.tyre_deflections[1]

    def sky_under_the_left_tyre(lift):
        q = np.zeros(7)
        q[AXLE + 2] = lift
        picture = render_frame(scene(q=q, exaggeration=exaggeration))
        return where(picture, style.SKY, REAR)[246:254, 82].any()

    assert not sky_under_the_left_tyre(rest - 0.005)
    assert sky_under_the_left_tyre(rest + 0.03)


def test_the_tyre_load_bar_vanishes_when_the_wheel_is_airborne():
    def bars(load):
        picture = render_frame(scene(load=np.full(4, load)))
        return where(picture, style.STEEL, CORNERS).sum(), where(
            picture, style.AIRBORNE, CORNERS
        ).sum()

    (light, _), (heavy, no_words), (nothing, words) = bars(2000.0), bars(4000.0), bars(0.0)
    assert heavy == pytest.approx(2 * light, rel=0.05)
    assert nothing < 0.1 * light
    assert no_words == 0 < words


def test_strut_colours_show_their_state():
    soft, stiff = (
        where(render_frame(scene(mode=mode)), style.STIFF) for mode in ("ride", "handling")
    )
    assert stiff[REAR].sum() > 500 and stiff[CORNERS].sum() > 200
    assert soft[REAR].sum() == soft[CORNERS].sum() == 0


@pytest.mark.parametrize("end", [0, 1])
def test_a_stop_changes_colour_when_the_strut_reaches_it(end):
    limit = CAR.free_travel[2][end]
    for share, lit in ((0.98, False), (1.02, True)):
        picture = render_frame(scene(extension=np.array([0.0, 0.0, share * limit, 0.0])))
        assert (where(picture, style.STOP_REACHED, REAR).sum() > 50) == lit
        # the gauge of RL: shortest on the left
        gauge = where(picture, style.STOP_REACHED, CORNERS)[:, 10:150]
        assert (gauge[:, 70 * end : 70 * end + 70].sum() > 50) == lit
        assert gauge[:, 70 * (1 - end) : 70 * (1 - end) + 70].sum() == 0


def test_the_road_moves_from_right_to_left():
    def column_of_the_bump(seconds):
        earth = where(render_frame(scene("bump_large_small", seconds)), style.EARTH, SIDE)
        return float(np.flatnonzero(earth[: top(earth) + 3].any(axis=0)).mean())

    # the bump is 10 m behind the end of the apron of 5 m: 92 pixels are a metre
    shift = column_of_the_bump(1.5) - column_of_the_bump(1.6)
    assert shift == pytest.approx(92.0, abs=3)


def test_wheel_rotation_matches_the_distance_travelled():
    def angle(seconds):
        """Return the angle of the mark on the right front rim, clockwise [rad]."""
        rows, columns = np.nonzero(
            where(render_frame(scene("flat", seconds)), style.DARK, under_the_body)
        )
        return np.arctan2(rows.mean() - 4.0, columns.mean() - 47.5)

    under_the_body = (slice(255, 330), slice(400, 490))
    assert angle(1.16) - angle(1.08) == pytest.approx(0.08 * 10.0 / 0.4, abs=0.1)


def test_traces_show_the_last_seconds_with_the_newest_at_the_right():
    a = np.zeros((3, 1000))
    a[:, -100:] = 8.0
    picture = render_frame(scene(samples=a))
    trace = where(picture, style.INK, (slice(455, 470), slice(62, 569)))
    assert trace[:8, -12:].any() and not trace[:8, :-20].any()


@pytest.mark.parametrize("road", ["belgian", "belgian_rough", "iso_d", "speed_bumps"])
def test_only_belgian_paving_is_drawn_with_stones(road):
    picture = render_frame(scene(road))
    stones = any(where(picture, colour, SIDE).any() for colour in style.STONES)
    assert stones == road.startswith("belgian")
    assert where(picture, style.PAINT, SIDE).any() == (not stones)


def test_the_picture_of_the_pages_is_the_side_view_of_a_frame():
    """After a change of the drawing, save this view again as the picture."""
    env = make(road="belgian", length=100.0, speed_kmh=30.0, control="axle")
    env.reset(seed=0)
    for _ in range(20):
        env.step(0)
    kept = np.asarray(Image.open(STATIC / "car.png").convert("RGB"), dtype=int)
    different = np.abs(kept - env.render()[SIDE]).max(axis=2) > 60
    assert different.mean() < 0.05


def test_a_command_is_described_in_words():
    assert panels._describe_command(encode_command("handling"), MODES) == "handling"
    front_rear = encode_command({"front": "ride", "rear": "stiff_low"})
    assert panels._describe_command(front_rear, MODES) == "front ride, rear stiff/low"
    each = encode_command({"FL": "ride", "FR": "handling", "RL": "ride", "RR": "ride"})
    assert panels._describe_command(each, MODES) == "individual wheels"


@pytest.mark.parametrize(
    ("value", "expected"), [(0.02, 0.02), (0.021, 0.05), (3.0, 5.0), (7.0, 10.0), (120.0, 200.0)]
)
def test_scales_end_at_round_numbers(value, expected):
    assert panels._round_up(value) == pytest.approx(expected)


@pytest.mark.parametrize("options", [{}, {"exaggeration": 2.0, "control_rate": 50.0}])
def test_both_env_checkers_pass_with_rendering(options):
    from stable_baselines3.common.env_checker import check_env as check_for_sb3

    check_env(make(**options).unwrapped)
    check_for_sb3(make(**options).unwrapped)


@pytest.mark.parametrize("clone", [copy.deepcopy, lambda e: pickle.loads(pickle.dumps(e))])
def test_a_copy_made_in_mid_episode_shows_the_same_picture(clone):
    env = make().unwrapped
    env.reset(seed=3)
    env.step(0)
    env.render()
    twin = clone(env)
    np.testing.assert_array_equal(env.render(), twin.render())


def test_a_nonfinite_episode_can_still_be_rendered():
    env = make().unwrapped
    env.reset(seed=0)
    env.fleet.state.q[0, 0, 0] = np.inf
    assert env.step(0)[2]
    assert env.render().shape == (HEIGHT, WIDTH, 3)


def test_render_fps_is_the_control_rate_of_the_instance():
    assert make(control_rate=50.0).metadata["render_fps"] == 50
    assert RoadReconEnv.metadata["render_fps"] == 20


def test_rendering_needs_a_render_mode_and_a_reset():
    env = RoadReconEnv(**SHORT)
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="unless render_mode is 'rgb_array'"):
        assert env.render() is None
    with pytest.raises(gym.error.ResetNeeded, match="call reset before render"):
        make().unwrapped.render()
    with pytest.raises(ConfigError, match="exaggeration: must be positive"):
        make(exaggeration=0.0)


def test_pillow_is_imported_lazily_and_named_when_missing():
    code = (
        "import sys, gymnasium, road_envs\n"
        "env = gymnasium.make('RoadRecon-v0', road='flat', length=20.0, render_mode='rgb_array')\n"
        "env.reset(seed=0); env.step(0)\n"
        "print('PIL' in sys.modules, 'matplotlib' in sys.modules)\n"
        "sys.modules['PIL'] = None\n"
        "try: env.render()\n"
        "except gymnasium.error.DependencyNotInstalled as error: print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    lines = done.stdout.splitlines()
    assert lines == ["False False", "run `pip install 'road-envs[render]'`"], done.stderr


def test_gymnasiums_human_rendering_wrapper_shows_the_frames(monkeypatch):
    pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env = gym.wrappers.HumanRendering(make())
    env.reset(seed=0)
    env.step(0)
    assert env.screen_size == (WIDTH, HEIGHT)
    env.close()


@pytest.mark.parametrize("suffix", [".gif", ".webp"])
def test_an_animation_runs_in_real_time(tmp_path, suffix):
    path, shares = tmp_path / f"drive{suffix}", []
    animate(SHORT, 0.2, path, lambda text, share: shares.append(share))
    with Image.open(path) as image:
        assert (image.size, image.n_frames) == ((WIDTH, HEIGHT), 4)
        image.seek(1)
        image.load()
        assert image.info["duration"] == 50
        assert image.info["loop"] == 0
    assert shares == sorted(shares) and shares[-1] == 1.0
    assert list(tmp_path.iterdir()) == [path]


def test_the_command_animates_the_vehicle_that_it_is_given(tmp_path, monkeypatch):
    seen = {}

    def write(options, seconds, out, progress):
        seen.update(options)
        out.write_bytes(b"GIF")

    monkeypatch.setattr("leaderboard.report.animation.animate", write)
    animate_command(out=tmp_path / "drive.gif", vehicle="bmw_320i")
    assert (seen["vehicle"], seen["road"]) == ("bmw_320i", "belgian")


def test_a_gif_reproduces_the_colours_of_the_frames(tmp_path):
    animate(SHORT, 0.4, tmp_path / "drive.gif")
    env = make()
    env.reset(seed=0)
    for action in (0, 0, 0, 0, 1, 1, 1):
        env.step(action)
    with Image.open(tmp_path / "drive.gif") as image:
        image.seek(7)
        shown = np.asarray(image.convert("RGB")).astype(float)
    off = np.abs(shown - env.render())
    assert off.mean() < 1.0
    assert (off.max(axis=2) > 0).mean() < 0.1


def test_a_failed_animation_leaves_the_old_file_unchanged(tmp_path, monkeypatch):
    with pytest.raises(ConfigError, match=r"at least 0\.1 s, got 0\.05 s"):
        animate(SHORT, 0.05, tmp_path / "drive.gif")
    (tmp_path / "drive.gif").write_bytes(b"old")
    monkeypatch.setattr(Image.Image, "save", lambda *a, **k: (_ for _ in ()).throw(OSError("full")))
    with pytest.raises(OSError, match="full"):
        animate(SHORT, 0.2, tmp_path / "drive.gif")
    assert [p.name for p in tmp_path.iterdir()] == ["drive.gif"]
    assert (tmp_path / "drive.gif").read_bytes() == b"old"
