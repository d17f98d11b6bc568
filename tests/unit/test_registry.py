"""Registry of estimators, plug-ins of other packages, and storage of estimators."""

import json
import os
import sys
import zipfile
from dataclasses import dataclass
from importlib import metadata
from typing import ClassVar

import numpy as np
import pytest

import road_envs
from estimators import (
    ENTRY_POINT_GROUP,
    REGISTRY,
    PluginWarning,
    available,
    create,
)
from estimators.api import NotFittedError
from estimators.baselines.flat import FlatEstimator
from estimators.baselines.mean import Mean
from estimators.weights_io import StorageError, load, save
from leaderboard.entries.entry import EntryError, get_settings
from leaderboard.sandbox import estimator_handler
from road_envs.core.config import ConfigError
from road_envs.records.record import Estimate, Profile, profile_stations


@dataclass(frozen=True, kw_only=True)
class Plateau:
    """An estimator of another package: constant height."""

    causal: ClassVar[bool] = True

    height: float = 1.0

    def estimate(self, record, car) -> Estimate:
        stations = profile_stations(record.length)
        return Estimate(stations, np.full((2, stations.size), self.height))


class NoDataclass:
    causal = True

    def estimate(self, record, car): ...


@dataclass(frozen=True)
class NoEstimate:
    causal: ClassVar[bool] = True


@dataclass(frozen=True)
class NoCausality:
    def estimate(self, record, car): ...


def offer(monkeypatch, **values: str) -> None:
    """Declare these entry points in the place of installed packages."""
    entries = [
        metadata.EntryPoint(name, value, ENTRY_POINT_GROUP) for name, value in values.items()
    ]
    monkeypatch.setattr(
        metadata, "entry_points", lambda group: [e for e in entries if e.group == group]
    )


def trained_mean() -> Mean:
    """A fitted estimator without a drive."""
    stations = profile_stations(2.0)
    truth = Profile(stations, np.array([np.sin(stations), np.cos(stations)]))
    return Mean().fit([], [truth], None, 0)


def test_the_registry_holds_the_estimators_of_this_package():
    learning = {"static_lm", "narx", "fir_ridge", "tcn"}
    assert learning | {"flat", "mean", "unrelated_road", "map_smoother"} <= set(REGISTRY)
    assert available().keys() >= REGISTRY.keys()


@pytest.mark.parametrize("name", REGISTRY)
def test_every_name_creates_its_estimator(name):
    assert type(create(name)) is REGISTRY[name]


def test_settings_reach_the_estimator():
    network = create("static_lm", hidden=7, division="block")
    assert (network.hidden, network.division) == (7, "block")


@pytest.mark.parametrize(
    ("name", "settings", "sentence"),
    [
        ("static_ml", {}, r"unknown estimator 'static_ml' \(did you mean 'static_lm'\?\)"),
        ("static_lm", {"hiden": 7}, r"unknown setting of static_lm 'hiden' .*known: .*hidden"),
        ("static_lm", {"fitted_state": 7}, "unknown setting of static_lm 'fitted_state'"),
        ("flat", {"height": 1.0}, "unknown setting of flat 'height'"),
        ("static_lm", {"hidden": "many"}, "static_lm.*hidden: .*a whole number, got 'many'"),
        ("static_lm", {"hidden": 0}, "hidden: must be at least 1, got 0"),
        ("static_lm", {"division": "odd"}, "static_lm.*division: .*'random' or 'block'"),
        ("fir_ridge", {"reach": -1.0}, "reach: must be positive, got -1.0 m"),
    ],
)
def test_a_wrong_name_or_setting_is_reported_with_the_choices(name, settings, sentence):
    with pytest.raises(ConfigError, match=sentence):
        create(name, **settings)


def test_an_estimator_of_another_package_is_available_by_name(monkeypatch):
    offer(monkeypatch, plateau=f"{__name__}:Plateau")
    assert available()["plateau"] is Plateau
    assert create("plateau", height=2.0) == Plateau(height=2.0)
    with pytest.raises(ConfigError, match="unknown setting of plateau 'hight'"):
        create("plateau", hight=2.0)


def test_an_installed_package_is_found_by_its_metadata(tmp_path, monkeypatch):
    """A package as installed by pip: a module, and a dist-info with an entry point."""
    (tmp_path / "somebodys_hill.py").write_text(
        "from dataclasses import dataclass\n"
        "from typing import ClassVar\n"
        "@dataclass(frozen=True)\n"
        "class Hill:\n"
        "    causal: ClassVar[bool] = True\n"
        "    def estimate(self, record, car): ...\n"
    )
    about = tmp_path / "somebodys_hill-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: somebodys-hill\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(f"[{ENTRY_POINT_GROUP}]\nhill = somebodys_hill:Hill\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert available()["hill"].__name__ == "Hill"
    monkeypatch.delitem(sys.modules, "somebodys_hill")


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        ("no_such_package:Thing", "ModuleNotFoundError: No module named 'no_such_package'"),
        (f"{__name__}:NoSuchClass", "AttributeError: .*NoSuchClass"),
        (f"{__name__}:NoDataclass", "it must be a dataclass of settings"),
        (f"{__name__}:NoEstimate", "it has no method estimate"),
        (f"{__name__}:NoCausality", "it does not declare causality"),
        (f"{__name__}:trained_mean", "it must be a dataclass of settings"),
    ],
)
def test_a_broken_plug_in_is_reported_and_disables_no_other(monkeypatch, value, reason):
    offer(monkeypatch, broken=value, plateau=f"{__name__}:Plateau")
    with pytest.warns(PluginWarning, match=f"'broken' of {value} is skipped: .*{reason}"):
        found = available()
    assert set(found) == {*REGISTRY, "plateau"}


def test_a_plug_in_may_not_take_the_name_of_another_estimator(monkeypatch):
    offer(monkeypatch, flat=f"{__name__}:Plateau")
    with pytest.raises(
        ConfigError, match=r"'flat' of .*Plateau is already taken by estimators.baselines.flat"
    ):
        available()


def test_a_stored_file_is_an_entry_of_a_board_with_its_own_settings(tmp_path):
    save(create("fir_ridge", reach=2.5).with_weights(window()), tmp_path / "window.npz")
    known = get_settings(load(tmp_path / "window.npz"))
    _, found = estimator_handler.load("/elsewhere/window.npz", known, str(tmp_path))
    assert known["reach"] == found.reach == 2.5


def test_a_stored_file_of_a_plug_in_is_no_entry_because_its_code_is_not_in_the_file(
    tmp_path, monkeypatch
):
    offer(monkeypatch, plateau=f"{__name__}:Plateau")
    save(Plateau(height=2.0), tmp_path / "mine.npz")
    assert load(tmp_path / "mine.npz") == Plateau(height=2.0)
    with pytest.raises(EntryError, match="lacks the code of a plug-in"):
        estimator_handler.load("/elsewhere/mine.npz", {}, str(tmp_path))


def test_a_stored_file_holds_format_name_settings_and_version(tmp_path):
    save(create("fir_ridge", reach=2.5).with_weights(window()), tmp_path / "window.npz")
    with np.load(tmp_path / "window.npz", allow_pickle=False) as file:
        header = json.loads(str(file["header"]))
        assert set(file.files) == {"header", *(f"weights.{name}" for name in window())}
    assert header == {
        "format": "roadrecon estimator 1",
        "version": road_envs.__version__,
        "name": "fir_ridge",
        "settings": {"reach": 2.5, "shipped": True},
    }


def window() -> dict[str, np.ndarray]:
    """Weights that fit a reach of 2.5 m."""
    numbers = {"stride": np.array(3), "speed": np.array(4.0), "ridge": np.array(1e-3)}
    return {"taps": np.ones((2, 3, 67)), **numbers}


def test_taps_that_do_not_fill_the_window_are_rejected():
    with pytest.raises(ValueError, match=r"67 taps do not fit a window of 3\.0 m"):
        create("fir_ridge", reach=3.0).with_weights(window())


def test_settings_are_restored_with_the_estimator(tmp_path):
    save(create("fir_ridge", reach=2.5).with_weights(window()), tmp_path / "window.npz")
    assert load(tmp_path / "window.npz") == create("fir_ridge", reach=2.5)


def test_a_plug_in_can_be_stored_while_it_is_installed(tmp_path, monkeypatch):
    path = tmp_path / "plateau.npz"
    with pytest.raises(StorageError, match="Plateau is not a registered estimator"):
        save(Plateau(), path)
    offer(monkeypatch, plateau=f"{__name__}:Plateau")
    save(Plateau(height=3.0), path)
    assert load(path) == Plateau(height=3.0)
    offer(monkeypatch)
    with pytest.raises(StorageError, match="unknown estimator 'plateau'"):
        load(path)


def test_an_unfitted_estimator_is_not_stored(tmp_path):
    with pytest.raises(NotFittedError):
        save(Mean(), tmp_path / "mean.npz")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("module", "function"), [(np, "savez"), (os, "replace")])
def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(
    tmp_path, monkeypatch, module, function
):
    path = tmp_path / "kept.npz"
    save(FlatEstimator(), path)
    before = path.read_bytes()

    def full(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(module, function, full)
    with pytest.raises(OSError, match="No space left"):
        save(trained_mean(), path)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["kept.npz"]


def test_a_missing_file_is_reported(tmp_path):
    with pytest.raises(StorageError, match=r"nowhere.npz: cannot be read: No such file"):
        load(tmp_path / "nowhere.npz")


@pytest.mark.parametrize("size", [0, 10, 300, -10])
def test_a_truncated_file_is_rejected(tmp_path, size):
    path = tmp_path / "mean.npz"
    save(trained_mean(), path)
    path.write_bytes(path.read_bytes()[:size])
    with pytest.raises(StorageError, match=r"mean\.npz: damaged or not an .npz file"):
        load(path)


def test_a_flipped_byte_is_detected(tmp_path):
    path = tmp_path / "mean.npz"
    save(trained_mean(), path)
    data = bytearray(path.read_bytes())
    with zipfile.ZipFile(path) as file:
        inside = file.getinfo("weights.z.npy").header_offset + 400
    data[inside] ^= 0xFF
    path.write_bytes(data)
    with pytest.raises(StorageError, match=r"mean\.npz: damaged"):
        load(path)


def stored(path, **arrays) -> None:
    """Write a foreign .npz."""
    with path.open("wb") as file:
        np.savez(file, **arrays)


HEADER = {"format": "roadrecon estimator 1", "version": "0", "name": "flat", "settings": {}}


@pytest.mark.parametrize(
    ("arrays", "sentence"),
    [
        ({"x": np.ones(3)}, "not a usable RoadRecon estimator: 'header' is missing"),
        ({"header": np.array("no JSON")}, "not a usable RoadRecon estimator"),
        ({"header": np.array("[1, 2]")}, "not a usable RoadRecon estimator"),
        (
            {"header": np.array('{"name": "flat"}')},
            "not a usable RoadRecon estimator: 'format' is missing",
        ),
        (
            {"header": np.array(json.dumps({**HEADER, "format": "roadrecon estimator 9"}))},
            "format 'roadrecon estimator 9' is not supported, expected 'roadrecon estimator 1'",
        ),
        (
            {"header": np.array(json.dumps({**HEADER, "name": "mean"}))},
            r"expected weights \['z'\], got \[\]",
        ),
        (
            {"header": np.array(json.dumps({**HEADER, "settings": {"height": 1.0}}))},
            "unknown setting of flat 'height'",
        ),
    ],
)
def test_a_foreign_file_is_rejected_with_the_reason(tmp_path, arrays, sentence):
    path = tmp_path / "foreign.npz"
    stored(path, **arrays)
    with pytest.raises(StorageError, match=rf"foreign.npz: .*{sentence}"):
        load(path)


def test_pickled_objects_are_never_loaded(tmp_path):
    path = tmp_path / "pickle.npz"
    with path.open("wb") as file:
        np.savez(file, header=np.array([{"a": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(StorageError, match="an array of type object, not of numbers"):
        load(path)


def test_a_text_file_is_rejected(tmp_path):
    path = tmp_path / "notes.npz"
    path.write_text("no archive")
    with pytest.raises(StorageError, match=r"damaged or not an \.npz file"):
        load(path)
