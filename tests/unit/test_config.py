"""Errors in configurations are one sentence; shipped configurations load and have sources."""

import copy
import datetime
from dataclasses import dataclass, field, replace
from typing import Literal

import pytest

from leaderboard.drive_report.conditions import Conditions
from leaderboard.evaluation.boards import BoardDefinition
from leaderboard.evaluation.tasks import Task
from road_envs.core import config
from road_envs.core.config import (
    ConfigError,
    Positive,
    Settings,
    build,
    load,
    names,
    read_yaml,
    validate_choice,
)
from road_envs.policies import _PolicySettings
from road_envs.sensing.data_logger import Instruments
from road_envs.sensing.perturbed_vehicle import PlantMismatch
from road_envs.vehicle.parameters import VehicleParameters
from road_envs.vehicle.struts import Valve

DEFENDER = read_yaml(config.find("vehicles", "land_rover_defender_110"))
PAPER = read_yaml(config.find("sensors", "paper"))
GONE = object()


def changed(data, path, value):
    """Return a copy of `data` with `value` at the dotted `path`; GONE removes the key."""
    data = copy.deepcopy(data)
    *parents, last = path.split(".") if isinstance(path, str) else (path,)
    owner = data
    for key in parents:
        owner = owner[key]
    if value is GONE:
        del owner[last]
    else:
        owner[last] = value
    return data


def sentence(caught) -> str:
    """Return the message of an error, which must be one sentence without a cause."""
    error = caught.value
    assert error.__cause__ is None and (error.__context__ is None or error.__suppress_context__)
    assert "\n" not in str(error)
    return str(error)


VEHICLE_FAULTS = [
    (
        "front.kt",
        1.0,
        "car.yaml: front.kt: unknown key, did you mean 'k_t'; known: I_xx, c_t",
    ),
    ("frnt", {}, "car.yaml: frnt: unknown key, did you mean 'front'; known: I_xx, I_yy, front"),
    ("strut.damper.ride.G", [1.0], "car.yaml: strut.damper.ride.G: unknown key; known: F, x"),
    (2024, 1.0, "car.yaml: 2024: unknown key; known: I_xx"),
    (datetime.date(2024, 1, 1), 1.0, "car.yaml: a key must be text or a number"),
    ("m_b", GONE, "car.yaml: m_b: missing"),
    ("strut.damper.ride.F", GONE, "car.yaml: strut.damper.ride.F: missing"),
    ("m_b", "16e-6", "car.yaml: m_b: must be a number, got '16e-6' (text)"),
    ("m_b", True, "car.yaml: m_b: must be a number, got True (true or false)"),
    ("m_b", None, "car.yaml: m_b: must be a number, got None (nothing)"),
    ("m_b", [1.0], "car.yaml: m_b: must be a number, got [1.0] (a list)"),
    ("name", 110, "car.yaml: name: must be text, got 110 (a whole number)"),
    ("strut", None, "car.yaml: strut: must be a mapping of keys to values, got None (nothing)"),
    ("strut.bushing.x", "abc", "car.yaml: strut.bushing.x: must be a list"),
    ("m_b", -1.0, "car.yaml: m_b: must be positive, got -1.0 kg (sprung mass)"),
    ("m_b", float("nan"), "car.yaml: m_b: must be finite, got nan kg"),
    ("I_yy", float("inf"), "car.yaml: I_yy: must be finite, got inf kg m²"),
    ("rear.y_t", 0.0, "car.yaml: rear.y_t: must be positive, got 0.0 m (half"),
    ("front.c_t", -1.0, "car.yaml: front.c_t: must not be negative, got -1.0 N s/m"),
    ("front.c_t", float("nan"), "car.yaml: front.c_t: must be finite, got nan"),
    ("valve.delay", -0.01, "car.yaml: valve.delay: must not be negative, got -0.01 s (pure delay)"),
    ("valve.lag", 0.0, "car.yaml: valve.lag: must be positive, got 0.0 s"),
    ("strut.column_min", 0.06, "car.yaml: strut: column_min 0.06 must be below x_1 0.0509"),
    ("rear.x", 1.4, "the front axle must be ahead of the centre of mass"),
    ("front.x", float("inf"), "car.yaml: front.x: must be finite, got inf m"),
    ("tyre_static_deflection", -0.01, "tyre_static_deflection: must not be negative, got -0.01 m"),
    ("tyre_static_deflection", "static", "must be 'equilibrium', got 'static'"),
    (
        "strut.bushing.x",
        [0.0, 1.0],
        "strut.bushing: x and F must have the same length, at least 2, got 2 and 12",
    ),
    ("strut.damper.ride.F", [float("nan")] * 11, "strut.damper.ride.F.0: must be finite"),
]


@pytest.mark.parametrize(("path", "value", "message"), VEHICLE_FAULTS)
def test_an_invalid_vehicle_value_is_named_in_one_sentence(path, value, message):
    with pytest.raises(ConfigError) as caught:
        build(VehicleParameters, changed(DEFENDER, path, value), "car.yaml")
    assert sentence(caught).startswith("car.yaml: ")
    assert message in sentence(caught)


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("accelerometers.LF", {"axle": "front", "forward": 0.0, "y": 0.5}, "known: ahead, axle"),
        (
            "accelerometers.rr",
            {"y": 0.5},
            "names must differ in more than case, got RF, LR, RR, rr",
        ),
        ("accelerometers.a b", {"y": 0.5}, "letters, digits or underscores, got 'a b'"),
        ("accelerometers.RF.y", 600.0, "must be at most 2, got 600.0 m (left of the centre line)"),
        ("accelerometers.RF.mounted", "front axle", "has no 'axle' and no 'ahead'"),
        ("accelerometers.RF.range", 0.0, "must be positive, got 0.0 m/s²"),
        ("accelerometers", {}, "give 1 to 32 accelerometers, got 0"),
        ("accelerometers.RF.axle", "middle", "must be 'front' or 'rear', got 'middle'"),
        ("accelerometers.RF.y", float("nan"), "accelerometers.RF.y: must be finite, got nan m"),
        ("fs", 600.0, "f_alias 333.0 must be below fs / 2 = 300.0"),
        ("fs", -1.0, "fs: must be positive, got -1.0 Hz (sampling rate)"),
        ("range", 0.0, "range: must be positive, got 0.0 m/s²"),
        ("noise_density", -0.1, "noise_density: must not be negative, got -0.1"),
        ("speed_error", float("inf"), "speed_error: must be finite, got inf"),
    ],
)
def test_an_invalid_instrument_value_is_named_in_one_sentence(path, value, message):
    with pytest.raises(ConfigError) as caught:
        build(Instruments, changed(PAPER, path, value), "set.yaml")
    assert message in sentence(caught)


def test_direct_construction_refuses_a_value_with_the_same_message():
    for make in (
        lambda: replace(build(VehicleParameters, DEFENDER, "car.yaml"), m_b=-1.0),
        lambda: build(VehicleParameters, changed(DEFENDER, "m_b", -1.0), "car.yaml"),
    ):
        with pytest.raises(ConfigError) as caught:
            make()
        message = sentence(caught).removeprefix("car.yaml: ")
        assert message == "m_b: must be positive, got -1.0 kg (sprung mass)"


def test_an_error_inside_a_list_a_mapping_or_a_union_is_located():
    @dataclass(frozen=True, kw_only=True)
    class Outer(Settings):
        tyres: tuple[Valve, ...] = ()
        either: Literal["none"] | Valve = "none"
        numbers: dict[str, Positive] = field(default_factory=dict)

    good = {"delay": 0.0, "lag": 0.1, "equalisation": 0.1}
    for data, message in (
        ({"tyres": [good, {**good, "lag": 0.0}]}, "tyres.1.lag: must be positive, got 0.0 s"),
        ({"tyres": [{**good, "lga": 0.0}]}, "tyres.0.lga: unknown key, did you mean 'lag'"),
        ({"either": {**good, "lag": 0.0}}, "lag: must be positive, got 0.0 s"),
        ({"numbers": {"a": 0.0}}, "here: numbers.a: must be positive, got 0.0"),
    ):
        with pytest.raises(ConfigError) as caught:
            build(Outer, data, "here")
        assert message in sentence(caught)


def test_of_several_errors_the_unknown_key_comes_first():
    data = changed(changed(DEFENDER, "m_b", GONE), "mb", 1734.0)
    with pytest.raises(ConfigError, match=r"car.yaml: mb: unknown key.*\(and 1 more\)"):
        build(VehicleParameters, data, "car.yaml")


def test_a_mapping_that_contains_itself_is_rejected():
    data = copy.deepcopy(DEFENDER)
    data["sources"]["all"] = data["sources"]
    with pytest.raises(ConfigError, match=r"car.yaml: Circular reference"):
        build(VehicleParameters, data, "car.yaml")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: [1, 2", "not valid YAML"),
        ("a: b: c", "not valid YAML"),
        ("- 1\n- 2", "expected a mapping of keys to values, got a list"),
        ("just words", "expected a mapping of keys to values, got text"),
        ("", "expected a mapping of keys to values, got nothing"),
        ("a: !!map x", "not valid YAML"),
        ("m_b: 1.0\nname: x\nm_b: 2.0", "the key 'm_b' is duplicated, in lines 1 and 3"),
        ("front: {x: 1.0, m: 2.0,\n  x: 1.0}", "the key 'x' is duplicated, in lines 1 and 2"),
        ("- a: 1\n  a: 2", "the key 'a' is duplicated, in lines 1 and 2"),
        ("!!python/object:os.system {}", "not valid YAML"),
        (b"\xff\xfe\x00", "not valid YAML"),
    ],
)
def test_an_invalid_configuration_file_is_rejected_with_its_path(tmp_path, text, message):
    path = tmp_path / "car.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ConfigError) as caught:
        load(VehicleParameters, "vehicles", path)
    assert sentence(caught).startswith(str(path)) and message in sentence(caught)


def test_a_key_may_occur_in_several_mappings(tmp_path):
    path = tmp_path / "sides.yaml"
    path.write_text("left: {x: 1.0}\nright: {x: 2.0, '1': 0, 1: 0}\nx: 3.0\nboth: &b {y: 1}\nc: *b")
    expected = {"left": {"x": 1.0}, "right": {"x": 2.0, "1": 0, 1: 0}, "x": 3.0}
    assert read_yaml(path) == expected | {"both": {"y": 1}, "c": {"y": 1}}


def test_what_a_caller_changes_in_a_file_that_was_read_changes_nothing_for_the_next():
    path = config.find("vehicles", "land_rover_defender_110")
    before = copy.deepcopy(read_yaml(path))
    read_yaml(path)["front"]["m"] = 0.0
    assert read_yaml(path) == before


def test_a_missing_file_or_a_folder_is_rejected(tmp_path):
    (tmp_path / "folder.yaml").mkdir()
    for name, message in (("none.yaml", "No such file"), ("folder.yaml", "Is a directory")):
        with pytest.raises(ConfigError, match=message) as caught:
            load(VehicleParameters, "vehicles", tmp_path / name)
        assert sentence(caught).startswith(str(tmp_path / name))


def test_an_unknown_name_is_rejected_with_the_existing_names():
    with pytest.raises(ConfigError) as caught:
        load(VehicleParameters, "vehicles", "land_rover_defender_11")
    assert sentence(caught) == (
        "unknown vehicle 'land_rover_defender_11' (did you mean 'land_rover_defender_110'?); "
        f"known: {', '.join(names('vehicles'))}"
    )
    with pytest.raises(ConfigError, match="unknown colour 7; known: blue, red"):
        validate_choice("colour", 7, ["red", "blue"])


def test_numbers_are_checked_strictly_and_lists_become_tuples():
    @dataclass(frozen=True)
    class Thing:
        __pydantic_config__ = config.STRICT
        x: float
        y: tuple[float, ...]
        n: int = 3

    thing = build(Thing, {"x": 2, "y": [1, 2.5]}, "here")
    assert thing == Thing(x=2.0, y=(1.0, 2.5)) and isinstance(thing.x, float)
    with pytest.raises(ConfigError, match=r"here: n: must be a whole number, got 2\.0"):
        build(Thing, {"x": 2, "y": [], "n": 2.0}, "here")


WRONG = ("text", 3, -7.5, True, None, [], {}, [1, 2], {"a": 1}, [[1.0]], 1e400)
KINDS = {
    "vehicles": VehicleParameters,
    "sensors": Instruments,
    "field": PlantMismatch,
    "tasks": Task,
    "boards": BoardDefinition,
    "conditions": Conditions,
    "policies": _PolicySettings,
}
FOREIGN_WORDS = ("input should", "valid ", "pydantic", "dict", "tuple", "str ", "nonetype")
"""Of Pydantic and of Python, which a user of YAML files need not know."""


def places(data, where=()):
    inside = data if isinstance(data, list) else ()
    for key, value in data.items() if isinstance(data, dict) else enumerate(inside):
        yield (*where, key)
        yield from places(value, (*where, key))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.costly
def test_a_wrong_value_at_any_key_is_described_in_words_of_a_yaml_file(kind):
    data = read_yaml(config.find(kind, names(kind)[-1]))
    every = max(1, sum(1 for _ in places(data)) // 60)
    described = 0
    for where in list(places(data))[::every]:
        for value in WRONG:
            wrong = copy.deepcopy(data)
            owner = wrong
            for key in where[:-1]:
                owner = owner[key]
            owner[where[-1]] = value
            try:
                build(KINDS[kind], wrong, "file.yaml")
            except ConfigError as error:
                text = str(error).lower()
                assert [word for word in FOREIGN_WORDS if word in text] == [], text
                described += 1
    assert described > 10


# --- shipped configurations -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("cls", "kind"),
    [(VehicleParameters, "vehicles"), (Instruments, "sensors"), (PlantMismatch, "field")],
)
def test_all_shipped_configurations_load_by_name_and_by_path(cls, kind):
    assert names(kind)
    for name in names(kind):
        by_name = load(cls, kind, name)
        assert by_name == load(cls, kind, config.folder() / kind / f"{name}.yaml")
        assert by_name.name == name


def leaves(data, where=""):
    """Yield the dotted paths of all values that are not mappings."""
    for key, value in data.items():
        path = f"{where}{key}"
        yield from leaves(value, f"{path}.") if isinstance(value, dict) else [path]


@pytest.mark.parametrize("kind", ["vehicles", "sensors", "field"])
def test_every_shipped_number_has_a_source_and_every_source_a_number(kind):
    for name in names(kind):
        data = read_yaml(config.folder() / kind / f"{name}.yaml")
        sources = data.pop("sources")
        assert all(t["source"] for t in data.pop("tolerances", {}).values())
        paths = [p for p in leaves(data) if p.split(".")[-1] not in ("name", "kind")]
        for path in paths:
            assert any(path == s or path.startswith(f"{s}.") for s in sources), (name, path)
        for source, text in sources.items():
            assert any(p == source or p.startswith(f"{source}.") for p in paths), (name, source)
            assert text.strip()


def test_curves_given_only_as_figures_are_marked_as_assumed():
    for path in ("damper.ride", "damper.handling", "friction.ride", "friction.handling", "bushing",
                 "bump_stop.front", "bump_stop.rear"):  # fmt: skip
        assert DEFENDER["sources"][f"strut.{path}"].startswith("assumed")
