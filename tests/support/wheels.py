"""Wheels of estimators, written without a build tool, so that they may be malformed."""

import zipfile
from pathlib import Path

MODULE = """
from dataclasses import dataclass
from typing import Any, ClassVar
import numpy as np
from road_envs.records.record import Estimate, profile_stations
{head}

@dataclass(frozen=True, kw_only=True)
class Entry:
    causal: ClassVar[Any] = {causal}
    lag: ClassVar[Any] = {lag}
    {settings}

    def estimate(self, record, car):
        stations = profile_stations(record.length)
        z = np.zeros((2, stations.size))
        {body}
        return Estimate(stations, z)
"""


def module(body="pass", head="", causal="False", lag="0.0", settings="pass"):
    """Return the source of a module with an estimator of a flat road, and more."""
    return MODULE.format(
        body=body.replace("\n", "\n        "), head=head, causal=causal, lag=lag, settings=settings
    )


def write_wheel(folder, name, code, entry_points=None, files=()):
    """Write the wheel `name`-1.0 with one module of that name; return its path.

    `files` are further members, name and content. The entry point has the name of the wheel unless
    the text `entry_points` says something else.
    """
    path = Path(folder) / f"{name}-1.0-py3-none-any.whl"
    entry = entry_points if entry_points is not None else f"{name} = {name}:Entry"
    about = f"{name}-1.0.dist-info"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(f"{name}.py", code)
        archive.writestr(
            f"{about}/METADATA", f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n"
        )
        archive.writestr(f"{about}/WHEEL", "Wheel-Version: 1.0\nTag: py3-none-any\n")
        archive.writestr(f"{about}/entry_points.txt", f"[road_envs.estimators]\n{entry}\n")
        for member, content in files:
            archive.writestr(member, content)
    return path


def encrypt(path):
    """Mark all members of a zip file as encrypted."""
    data = bytearray(path.read_bytes())
    for signature, offset in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        at = data.find(signature)
        while at >= 0:
            data[at + offset] |= 1
            at = data.find(signature, at + 4)
    path.write_bytes(data)


def write_policies(folder, **references):
    """Write the metadata of an installed package whose entry points are policies, by name."""
    about = Path(folder) / "others-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: others\nVersion: 1.0\n")
    lines = "\n".join(f"{name} = {reference}" for name, reference in references.items())
    (about / "entry_points.txt").write_text(f"[road_envs.policies]\n{lines}\n", encoding="utf-8")
