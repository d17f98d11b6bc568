"""Whatever bytes a guest sends, a call ends in a valid estimate or in an EntryError."""

import json
import os
import select
import sys
import time
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from estimators import REGISTRY
from estimators.api import EstimateError
from estimators.baselines.flat import FlatEstimator
from leaderboard.entries.entry import EntryError
from leaderboard.sandbox import client, estimator_handler, messages
from leaderboard.sandbox import guest as guest_module
from leaderboard.sandbox.client import _RemoteSession, call
from leaderboard.sandbox.guest import Guest
from leaderboard.sandbox.limits import Limits
from leaderboard.sandbox.worker import _reply
from road_envs.records.record import Profile, Record, profile_stations

READY = messages.encode({})
ECHO = """
import os, sys
os.write(1, bytes.fromhex(sys.argv[1]))
os.read(0, 1)
with open(sys.argv[2], "rb") as file:
    data = file.read()
while data:
    data = data[os.write(1, data):]
os.close(1)
while os.read(0, 1 << 20):
    pass
"""


def guest_that_sends(data, tmp_path):
    """Return a guest that sends `data` as soon as it has been asked, and reads on."""
    (tmp_path / "data").write_bytes(data)
    words = [sys.executable, "-I", "-S", "-c", ECHO, READY.hex(), str(tmp_path / "data")]
    return Guest(words, {}, tmp_path)


def a_record():
    t = np.arange(40) / 400.0
    state = np.zeros((40, 4), dtype=bool)
    return Record(t, np.zeros((3, 40)), np.full(40, 10.0), 10.0 * t, state, state, 0.9)


def head(text):
    data = text.encode() if isinstance(text, str) else text
    return messages.HEAD_SIZE.pack(len(data)) + data


SIZE = profile_stations(a_record().length).size
FINE = json.dumps({"seconds": 0.0, "std": False})
WITH_STD = json.dumps({"seconds": 0.0, "std": True})
HEIGHTS = np.full((2, SIZE), 0.01).tobytes()

MALFORMED = {
    "nothing": b"",
    "half a head": head(FINE)[:10],
    "a size of 4 GiB": b"\xff" * 8,
    "no JSON": head("z = 0"),
    "no text": head(b"\xff\xfe\x00"),
    "an empty head": head(""),
    "a list": head("[]"),
    "a number": head("1"),
    "deep lists": head("[" * 60_000),
    "deep objects": head('{"a":' * 12_000),
    "NaN": head('{"seconds": NaN}') + HEIGHTS,
    "infinite": head('{"seconds": 1e999}') + HEIGHTS,
    "minus infinity": head('{"seconds": -Infinity}') + HEIGHTS,
    "negative": head('{"seconds": -1e-9}') + HEIGHTS,
    "a truth": head('{"seconds": true}') + HEIGHTS,
    "a text": head('{"seconds": "0"}') + HEIGHTS,
    "an object": head('{"seconds": {}}') + HEIGHTS,
    "missing": head("{}") + HEIGHTS,
    "400 digits": head('{"seconds": 1%s}' % ("0" * 400)),
    "5000 digits": head('{"seconds": 1%s}' % ("0" * 5000)),
    "a surrogate": head('{"failure": "\\ud800"}'),
    "a list as failure": head('{"failure": [[[[]]]]}'),
    "no heights": head(FINE),
    "too few heights": head(FINE) + HEIGHTS[:-1],
    "no deviations": head(WITH_STD) + HEIGHTS,
    "NaN heights": head(FINE) + np.full((2, SIZE), np.nan).tobytes(),
    "infinite heights": head(FINE) + np.full((2, SIZE), -np.inf).tobytes(),
    "huge heights": head(FINE) + np.full((2, SIZE), 1e7).tobytes(),
    "negative deviations": head(WITH_STD) + HEIGHTS + np.full((2, SIZE), -1.0).tobytes(),
    "NaN deviations": head(WITH_STD) + HEIGHTS + np.full((2, SIZE), np.nan).tobytes(),
    "huge deviations": head(WITH_STD) + HEIGHTS + np.full((2, SIZE), 1e300).tobytes(),
}


@pytest.mark.parametrize("name", MALFORMED)
@pytest.mark.costly
def test_a_malformed_reply_is_one_sentence(name, tmp_path):
    guest = guest_that_sends(MALFORMED[name], tmp_path)
    guest.start_run(Limits(seconds=20.0))
    with pytest.raises((EntryError, EstimateError)) as error:
        _RemoteSession(guest, False, False).estimate(a_record())
    guest.close()
    text = str(error.value)
    assert text.isprintable() and len(text) < 500, text
    assert name != "a size of 4 GiB" or text == "its reply is invalid: a head of 4294967295 bytes"


@pytest.mark.costly
def test_random_replies_never_raise_anything_else(tmp_path):
    rng = np.random.default_rng(1)
    good = head(FINE) + HEIGHTS
    outcomes = set()
    for _ in range(40):
        data = bytearray(good)
        for at in rng.integers(len(good) if rng.random() < 0.5 else 40, size=rng.integers(1, 4)):
            data[at] = rng.integers(256)
        guest = guest_that_sends(bytes(data), tmp_path)
        guest.start_run(Limits(seconds=20.0))
        try:
            outcomes.add(
                np.isfinite(_RemoteSession(guest, False, False).estimate(a_record())[0].z).all()
            )
        except (EntryError, EstimateError):
            outcomes.add("refused")
        finally:
            guest.close()
    assert outcomes == {True, "refused"}


def test_a_valid_reply_is_taken_as_it_is(tmp_path, monkeypatch):
    monkeypatch.setattr(client, "UNSEEN_TIME", 60.0)  # also on a machine that does much else
    z = np.random.default_rng(0).standard_normal((2, SIZE))
    guest = guest_that_sends(head(WITH_STD) + z.tobytes() + (z * z).tobytes(), tmp_path)
    guest.start_run(Limits(seconds=20.0))
    estimate, seconds = _RemoteSession(guest, False, False).estimate(a_record())
    guest.close()
    np.testing.assert_array_equal(estimate.z, z)
    np.testing.assert_array_equal(estimate.z_std, z * z)
    assert seconds == 0.0


def test_no_seed_tells_an_entry_that_is_not_trained_which_guest_it_is_in():
    asked = []

    class Answering:
        limits = Limits()

        def cpu_seconds(self):
            return 0.0

        def call(self, request, *size):
            asked.append(request)
            return {"parameters": 0, "seconds": 0.0}, b""

    for seed in (1, 2, 3):
        _RemoteSession(Answering(), False, False).fit([], seed)
    assert len(set(asked)) == 1
    _RemoteSession(Answering(), True, False).fit([(a_record(), None)], 2)
    assert b'"seed": 2' in asked[-1]


def test_a_learner_is_sent_as_many_training_drives_as_its_task_has():
    drives = [(a_record(), Profile(np.arange(3.0), np.zeros((2, 3))))] * 1000
    request = messages.encode_drives("fit", drives, seed=1)
    (size,) = messages.HEAD_SIZE.unpack(request[: messages.HEAD_SIZE.size])
    told = json.loads(request[messages.HEAD_SIZE.size :][:size])
    assert size > messages.MAX_HEAD and len(told["lengths"]) == 1000


def test_a_reply_that_is_too_long_becomes_a_failure():
    receives, sends = os.pipe()
    _reply(sends, {"settings": "x" * messages.MAX_HEAD})
    told = messages.parse_head(os.read(receives, messages.MAX_HEAD)[messages.HEAD_SIZE.size :])
    assert told["failure"].startswith("cannot be reported: a message of 655")
    os.close(receives)
    os.close(sends)


def test_a_guest_that_does_not_read_cannot_block_the_host(tmp_path):
    code = f"import os, time; os.write(1, {READY}); time.sleep(99)"
    guest = Guest([sys.executable, "-I", "-S", "-c", code], {}, tmp_path)
    guest.start_run(Limits(seconds=0.5))
    with pytest.raises(EntryError, match="the time limit"):
        call(guest, bytes(10**7))
    guest.close()


def stop_host(monkeypatch, seconds, *, waiting):
    """Let each wait for a guest, or else each later check of its memory, end `seconds` later."""
    stopped = [0.0]

    def check(self):
        measure(self)
        if not self._unsent:
            select.select([self._replies], [], [], 1.0)
            stopped[0] += seconds

    def wait(*args):
        result = select.select(*args)
        stopped[0] += seconds
        return result

    measure, clock = Guest._measure, lambda: time.monotonic() + stopped[0]
    monkeypatch.setattr(guest_module, "time", SimpleNamespace(monotonic=clock))
    if waiting:
        monkeypatch.setattr(guest_module, "select", SimpleNamespace(select=wait))
    else:
        monkeypatch.setattr(Guest, "_measure", check)


def guest_that_runs(code, tmp_path):
    code = f"import os, time; os.write(1, {READY}); os.read(0, 9); {code}; time.sleep(20)"
    guest = Guest([sys.executable, "-I", "-S", "-c", code], {}, tmp_path)
    guest.start_run(Limits(seconds=20.0))
    return guest


@pytest.mark.parametrize("waiting", [True, False])
def test_time_in_which_the_host_was_stopped_is_not_that_of_an_entry(tmp_path, monkeypatch, waiting):
    """As by Ctrl-Z: the reply that lies there is read, and a later one is waited for."""
    reply = head(FINE)
    guest = guest_that_runs(
        f"time.sleep(0.3); os.write(1, {reply[:20]}); time.sleep({0.3 * waiting}); "
        f"os.write(1, {reply[20:]})", tmp_path,
    )  # fmt: skip
    stop_host(monkeypatch, 30.0, waiting=waiting)
    try:
        assert guest.call(b"x")[0]["seconds"] == 0.0
        assert not waiting or 15.0 < guest._seconds_left < 20.0
    finally:
        guest.close()


def test_the_time_that_a_guest_reports_is_at_most_that_of_the_host(tmp_path):
    """It is no invalid reply, as the machine may have been stopped, and no row has a false time."""
    data = head(json.dumps({"seconds": 9e8, "std": False})) + HEIGHTS
    guest = guest_that_sends(data, tmp_path)
    guest.start_run(Limits(seconds=20.0))
    assert 0.0 < _RemoteSession(guest, False, False).estimate(a_record())[1] < 20.0
    guest.close()


def test_a_reply_that_comes_byte_by_byte_ends_at_the_limit_of_time(tmp_path):
    drops = "[(os.write(1, b'x'), time.sleep(0.05)) for _ in range(200)]"
    guest = guest_that_runs(f"os.write(1, {messages.HEAD_SIZE.pack(1000)}); {drops}", tmp_path)
    guest.start_run(Limits(seconds=1.0))
    begin = time.monotonic()
    with pytest.raises(EntryError, match="the time limit"):
        call(guest, b"x")
    guest.close()
    assert time.monotonic() - begin < 5.0


@pytest.mark.costly
@pytest.mark.parametrize("waiting", [True, False])
def test_an_entry_that_slows_its_host_gains_no_time(tmp_path, monkeypatch, waiting):
    """Neither by a little in each wait nor by much in the checks of its memory."""
    guest = guest_that_runs("pass", tmp_path)
    stop_host(monkeypatch, 0.9 if waiting else 30.0, waiting=waiting)
    begin = time.monotonic()
    with pytest.raises(EntryError, match="the time limit"):
        call(guest, b"x")
    guest.close()
    assert time.monotonic() - begin < 10.0


@pytest.mark.parametrize(
    ("value", "sentence"),
    [
        ([], "must be a JSON object"),
        ({"two words": 1}, "must be a JSON object with names as keys"),
        ({"a": "x" * 5000}, "longer than 4000 characters"),
        ({"a": 10**200}, "beyond 1e+100"),
        ({"a": -1e300}, "beyond 1e+100"),
    ],
)
def test_settings_are_a_small_object(value, sentence):
    with pytest.raises(EntryError) as error:
        messages.settings(value)
    assert sentence in str(error.value)


def test_texts_are_one_short_printable_line():
    assert messages.text("a\nb\x1b[31m\u202ec\t<b>") == "a b [31m c <b>"
    assert len(messages.text("x" * 10**6)) == messages.MAX_TEXT + 4
    assert messages.text(None) == messages.text("\0") == "no message"


@pytest.mark.parametrize("word", ["\t", " ", "a\nb", "a  b", "x" * 301, "\u202e"])
@pytest.mark.parametrize(
    "where", [lambda x: x, lambda x: [x], lambda x: {x: 1}, lambda x: {"a": x}]
)
def test_settings_are_run_as_they_are_or_refused(word, where):
    with pytest.raises(EntryError, match="a text in its settings is not one printable line of up"):
        messages.settings({"a": where(word)})
    plain = {"a": where("one word"), "b": "", "n": [1, 2.5, None, True]}
    assert messages.settings(plain) == plain


class Mode(StrEnum):
    A = "a"


@dataclass(frozen=True, kw_only=True)
class Carried(FlatEstimator):
    """Settings that JSON carries, or that their annotations bring back."""

    whole: float = 1
    level: float = np.sqrt(2.0)
    bands: tuple[tuple[float, float], ...] = ((1, 2.5), (3.0, 4))
    modes: dict[str, list] = field(default_factory=lambda: {"b": [1, None, True], "a": ["x", []]})
    gains: dict[int, float] = field(default_factory=lambda: {1: 1.0})
    mode: Mode = Mode.A
    file: Path | None = Path("weights.npz")
    free: Any = field(default_factory=lambda: {"n": [1, 2.5, {"c": False}]})


@dataclass(frozen=True, kw_only=True)
class Free(FlatEstimator):
    """A setting that may have any type."""

    free: Any = 1.0


@dataclass(frozen=True, kw_only=True)
class Converting(FlatEstimator):
    """A setting that is converted by its own class."""

    gain_db: float = -6.0

    def __post_init__(self):
        object.__setattr__(self, "gain_db", 10 ** (self.gain_db / 20))


def described(reference, **settings):
    request = {"do": "start", "reference": reference, "settings": settings, "car": None}
    return estimator_handler.make_handler(None)(request, [])[0]


@pytest.mark.parametrize("reference", [*REGISTRY, f"{__name__}:Carried"])
def test_settings_that_come_back_from_json_as_they_are_are_accepted(reference):
    known = described(reference)["settings"]
    assert described(reference, **json.loads(json.dumps(known)))["settings"] == known


@pytest.mark.parametrize(
    "value",
    [
        {1: 1.0}, {"a": {None: 1}}, [{True: 1}], (1, 2), [{"a": (1,)}], Path("a"),
        Mode.A, [Mode.A], {"a": Mode.A}, {Mode.A: 1},
    ],
)  # fmt: skip
def test_settings_that_json_would_change_are_refused_and_named(value, monkeypatch):
    monkeypatch.setattr(estimator_handler, "load", lambda *_: (None, Free(free=value)))
    with pytest.raises(EntryError, match=r"JSON turns its setting free from .* into .*: annotate"):
        described("free")


def test_settings_that_are_converted_twice_are_refused_and_named():
    with pytest.raises(EntryError, match=r"setting gain_db from 0\.501.* into 1\.059.*: annotate"):
        described(f"{__name__}:Converting")


@pytest.mark.parametrize("depth", [5, 900, 100_000])
def test_a_reply_that_is_nested_deeply_is_one_sentence(depth):
    nested = "[" * depth + "]" * depth
    with pytest.raises(EntryError, match="its reply is invalid: "):
        messages.parse_head(f'{{"settings": {nested}}}'.encode())
    assert messages.parse_head(b'{"settings": {"a": [[[]]]}}') == {"settings": {"a": [[[]]]}}
