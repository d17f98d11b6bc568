"""Digests of tasks: what they depend on and what they do not."""

import dataclasses

import pytest
import yaml
from fakes import task

from leaderboard.evaluation import tasks
from leaderboard.evaluation.tasks import Condition, load_task
from road_envs.core.config import folder
from road_envs.roads import KINDS
from road_envs.sensing.perturbed_vehicle import load_plant_mismatch

TRAINING = {"roads": ["iso_d"], "seeds": [1, 2]}
FIELD = [{"mode": "ride", "speed_kmh": 30.0, "grade": grade} for grade in ("S0", "S1", "S3")]


def test_the_digest_depends_on_the_plant_mismatch(monkeypatch):
    field, plain = task(conditions=FIELD), task()
    digests = field.digest, plain.digest
    other = dataclasses.replace(load_plant_mismatch(), step=0.0001)
    monkeypatch.setattr(tasks, "load_plant_mismatch", lambda: other)
    assert task(conditions=FIELD).digest != digests[0] and task().digest == digests[1]


def test_the_digest_depends_on_all_inputs_of_the_drives_and_on_nothing_else(tmp_path):
    base = task()
    assert base.digest == task().digest and len(base.digest) == 64
    # the same roads in another notation
    same = {"roads": [{"kind": "iso8608", "road_class": "D"}], "seeds": [1, 2], "length": 40.0}
    assert task(training=same).digest == base.digest
    assert task(title="Another title", note="Read this.").digest == base.digest
    assert task(board="field").digest == task(board={"title": "Mine"}).digest == base.digest
    others = [
        task(version=2),
        task(bumps=True),
        base.with_test_drives(2),
        task(instruments="ideal"),
        task(training={**TRAINING, "length": 40.0, "noise": False}),
        task(training={"roads": ["iso_e"], "seeds": [1, 2], "length": 40.0}),
    ]
    digests = {base.digest, *(other.digest for other in others)}
    assert len(digests) == len(others) + 1


def test_the_digest_does_not_depend_on_names_of_classes_nor_on_options_at_their_defaults(
    monkeypatch,
):
    """A published commitment to hidden seeds holds digests of tasks: renames must not void it."""
    before = load_task("new_road").digest
    for kind, cls in list(KINDS.items()):
        monkeypatch.setitem(KINDS, kind, type(f"Renamed{cls.__name__}", (cls,), {}))
    with_option = dataclasses.make_dataclass(
        "OtherCondition", [("shade", str, "none")], bases=(Condition,), frozen=True, kw_only=True
    )
    t = load_task("new_road")
    assert type(t.test.roads[0]).__name__ == "RenamedRandomLevel"
    conditions = tuple(with_option(**vars(c)) for c in t.conditions)
    assert dataclasses.replace(t, conditions=conditions).digest == before
    shaded = (with_option(**vars(t.conditions[0]), shade="dark"), *conditions[1:])
    assert dataclasses.replace(t, conditions=shaded).digest != before


def test_two_kinds_of_road_with_the_same_settings_have_different_digests():
    inner = {"road": "iso_d"}
    digests = {
        task(test={"roads": [{"kind": kind, **inner}], "seeds": [11]}).digest
        for kind in ("scaled", "with_aprons", "offset")
    }
    assert len(digests) == 3


@pytest.mark.parametrize(
    ("field", "kind", "shipped", "number"),
    [
        ("car", "vehicles", "land_rover_defender_110", "m_b"),
        ("instruments", "sensors", "paper", "f_alias"),
    ],
)
def test_the_digest_depends_on_the_content_of_vehicle_and_instrument_files(
    tmp_path, field, kind, shipped, number
):
    settings = yaml.safe_load((folder() / kind / f"{shipped}.yaml").read_text())
    path = tmp_path / "mine.yaml"
    digests = set()
    for share in (1.0, 0.99):
        path.write_text(yaml.safe_dump({**settings, number: share * settings[number]}))
        digests.add(task(**{field: str(path)}).digest)
    assert len(digests) == 2


def test_the_digest_depends_on_the_order_of_the_accelerometers_but_not_of_other_settings(tmp_path):
    """Rows of a record, and the noise and the faults of each, follow the file of instruments."""
    settings = yaml.safe_load((folder() / "sensors" / "paper.yaml").read_text())
    sensors = settings["accelerometers"]
    orders = [
        settings,
        dict(reversed(settings.items())),
        {**settings, "accelerometers": dict(reversed(sensors.items()))},
    ]
    found = []
    for order in orders:
        (tmp_path / "paper.yaml").write_text(yaml.safe_dump(order, sort_keys=False))
        found.append(task(instruments=str(tmp_path / "paper.yaml")).digest)
    assert found[0] == found[1] != found[2]
