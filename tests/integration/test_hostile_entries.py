"""A board with dozens of hostile entries: each gets its row, and an honest row does not change.

Most come as wheels, as submissions do; what attacks only while it runs is a class of
`tests/support/hostile`. The test roads have the seeds of a season.
"""

import secrets
from pathlib import Path

import hostile
import pytest
from agreement import disagreements
from fake_estimators import Reader
from fake_results import run_scores
from fakes import task
from hostile import Hostile, poisoned_kernels
from in_process import InProcessExecutor
from wheels import encrypt, module, write_wheel

from estimators import create
from leaderboard.entries.entries import RESERVED, fold, make_entry, resolve_entries
from leaderboard.entries.entry import NAME
from leaderboard.evaluation.tasks import load_task
from leaderboard.metrics.baselines import BASELINES
from leaderboard.report.notes import isolation_notice
from leaderboard.running.board import RunRequest, run_board
from leaderboard.running.executors import ProcessExecutor
from leaderboard.sandbox import bubblewrap
from leaderboard.sandbox.client import ONE_TRAINING, SandboxClient
from leaderboard.sandbox.limits import Limits
from leaderboard.sandbox.retest import LOOKS_AHEAD, REMEMBERS
from leaderboard.submission import hidden_seeds

pytestmark = pytest.mark.skipif(
    bubblewrap.obstacle() is not None, reason=str(bubblewrap.obstacle())
)

LIMITS = Limits(seconds=5.0, memory=0.5, processes=40, file=0.05, isolation="bubblewrap")
LOST = "its process ended without a response, by "
INVALID = "its reply is invalid: "
TOOLS = ("hostile_tools.py", Path(hostile.__file__).read_text())

CHEAT = module(  # the first accelerometers' means over the rest of the drive
    "ahead = np.cumsum(record.a[0][::-1])[::-1]\n"
    "z[:] = 1e-3 * np.interp(stations, record.s, ahead)",
    causal="True",
)
STATEFUL = module(
    "SEEN.append(record.a[0].std())\nz[:] = np.sin(stations) * sum(SEEN)", "SEEN = []"
)
DEAF = module("z[:] = 0.01 * np.sin(stations)") + (
    "    def fit(self, records, truths, car, seed): return Fitted()\n"
    "    def weights(self):\n"
    "        from estimators.api import NotFittedError\n"
    "        raise NotFittedError('call fit')\n"
    "    def with_weights(self, weights): return self\n"
    "class Fitted(Entry):\n"
    "    def weights(self): return {'w': np.zeros(3)}\n"
)
SOLVER = module(  # looks for seeds in what it can read, and for the objects of the host
    "paths = [*pathlib.Path('/proc').glob('*/cmdline'), *pathlib.Path('/proc').glob('*/environ')]\n"
    "paths += [*pathlib.Path('/tmp').rglob('*.json'), *pathlib.Path('/var').rglob('*.json')]\n"
    "texts = [p.read_bytes() for p in paths if p.is_file() and os.access(p, os.R_OK)]\n"
    "found = [t for t in texts if b'road_seed' in t or b'\"seeds\"' in t]\n"
    "found += [x for x in gc.get_objects() if isinstance(x, dict) and 'road_seed' in x]\n"
    "if found: raise RuntimeError(f'found {found}')",
    "import gc, os, pathlib",
)
FORGED = (
    '{"reference": "builtin", "code": "0", "causal": true, "lag": 0, "settings": {}, "name": null}'
)


def forged(text):
    """Return a module that answers the request to describe itself with a text of its own."""
    return f"""
import os, time
from hostile_tools import head, reply_pipe
data = head({text!r})
while data:
    data = data[os.write(reply_pipe(), data):]
time.sleep(1000)
"""


DESCRIBED = {  # what fails before it is run: code of the module, entry points, sentence
    "builtin": (module(), None, "the name builtin is reserved"),
    "wiener": (module(), None, "the name wiener is reserved"),
    "alike": (module(), "W1ener = alike:Entry", "the name W1ener is reserved, or looks like one"),
    "bound": (module(), None, "the name bound is reserved"),
    "escape": (module(), "../../escape = escape:Entry", "a name has up to 40 letters"),
    "endless": (module(), f"{'n' * 300} = endless:Entry", "a name has up to 40 letters"),
    "double": (module(), "deaf = double:Entry", "another entry has the name deaf"),
    "two": (module(), "a = two:Entry\nb = two:Entry", "must declare one entry point"),
    "none": (module(), "", "must declare one entry point"),
    "exits": ("import os; os._exit(0)", None, LOST + "exit status 0"),
    "kills": ("import os; os.kill(-1, 9)", None, "AttributeError"),
    "deep": (forged("[" * 30_000), None, INVALID + "not JSON"),
    "listed": (forged("[]"), None, INVALID + "not a JSON object"),
    "long": (forged("x" * 900_000), None, INVALID + "a head of 900000 bytes"),
    "claims": (forged(FORGED), None, ""),
    "yes": (forged(FORGED.replace("true", '"yes"')), None, "causal must be True or False"),
    "huge": (forged(FORGED.replace("{}", '{"n": 1e400}')), None, "beyond 1e+100"),
    "nan": (forged(FORGED.replace("{}", '{"n": NaN}')), None, INVALID + "not JSON"),
    "digits": (forged(FORGED.replace("{}", "9" * 5000)), None, INVALID + "not JSON"),
    "nested_settings": (
        forged(FORGED.replace("{}", '{"n": %s}' % ("[" * 900 + "]" * 900))),
        None,
        INVALID + "nested more than 5 deep",
    ),
    "wide": (forged(FORGED.replace("{}", '{"n": "%s"}' % ("x" * 50_000))), None, "longer than"),
    "behind": (module(causal="True", lag="50.0"), None, "at most 10 m behind the front axle"),
    "texts": (module(head="raise ValueError('<b>' + '\\n\\x1b' * 10**6)"), None, "ValueError: <b>"),
}

WHEELS = {  # what is run: code of the module, sentence of the failure or None
    "pth": (module(), None),
    "cheat": (CHEAT, None),
    "stateful": (STATEFUL, None),
    "deaf": (DEAF, None),
    "solver": (SOLVER, None),
    "forger": (module("z[:] = np.nan"), "every value must be finite"),
    "absurd": (module("z[:] = 1e300"), "heights up to 1e+300 m"),
    "complex_numbers": (module("z = z + 1j"), "expected an array of real numbers"),
    "objects": (module("z = z.astype(object)"), "expected an array of real numbers"),
    "interrupts": (module("raise KeyboardInterrupt"), LOST + "exit status 1"),
    "newlines": (module("raise RuntimeError('a\\nb' * 10**6)"), "RuntimeError: a ba b"),
    "root": (module("import os; os.setuid(0)"), "Operation not permitted"),
    "memory_of_1": (module("open('/proc/1/mem', 'r+b')"), "Permission denied"),
}

REPLY = "head({'seconds': 0.1, 'std': False}) + "
RUN = {  # how an entry attacks while it runs, its argument, sentence of the failure or None
    "exit_softly": ("", LOST + "exit status 0"),
    "crash": ("", LOST + "SIGSEGV"),
    "hoard_in_children": ("", "the memory limit"),
    "multiply": ("", "more than 40 processes"),
    "fill": ("", ""),
    "leave_children": ("", None),
    "patch_evaluation": ("", "every value must be finite"),
    "tamper": ("OUT", None),
    "poison_kernels": ("", None),
    "kill_evaluation": ("", ""),
    "connect": ("1", ""),
    "write_elsewhere": ("OUT", ""),
    "look_for_truth": ("OUT", "found [], root "),
}
REPLIES = {  # `test_guest_replies.py` has many more
    "negative": ("head({'seconds': -1.0})", "seconds must be a number from 0"),
    "bytes": ("b'\\xff' * 1000", INVALID + "a head of 4294967295 bytes"),
    "nans": (REPLY + "np.full((2, stations.size), np.nan).tobytes()", "must be finite"),
    "flood": (REPLY + "bytes(10**7)", INVALID + "not JSON"),
}

PACKED = {  # what is wrong with the wheel itself
    "nested": "cannot be constructed: ",
    "bomb": "cannot be constructed: OSError",
    "climbs": None,
    "locked": "cannot be constructed: RuntimeError",
    "text": "cannot be constructed: BadZipFile",
}

SENTENCES = {
    **{name: end for name, (_, _, end) in DESCRIBED.items()},
    **{name: end for name, (_, end) in WHEELS.items()},
    **PACKED,
    **{f"run_{name}": end for name, (_, end) in RUN.items()},
    **{f"reply_{name}": end for name, (_, end) in REPLIES.items()},
}
"""Sentence of the failure of every hostile entry, None for one that gets a row with scores."""

KINDS = {
    *("claims", "cheat", "stateful", "deaf", "run_tamper", "reply_flood"),
    *("exits", "forger", "builtin", "double", "nested_settings", "texts", "pth", "bomb"),
    *("run_kill_evaluation", "run_poison_kernels"),
}
"""One entry of each kind; each takes up to three processes."""


def small(folder):
    """A task of 16 m roads with the seeds of a season, committed and revealed in `folder`."""
    salt = secrets.token_urlsafe(24)
    hidden_seeds.save(hidden_seeds.commit(salt, [load_task("new_road")]), folder)
    season = load_task(hidden_seeds.reveal(salt, folder)[0])
    short = {"roads": ["iso_d"], "length": 16.0}
    return task(
        conditions=[{"mode": "ride", "speed_kmh": 36.0}],
        training={**short, "seeds": [1]},
        test={**short, "seeds": season.test.seeds[:2]},
    )


def write_wheels(folder):
    """Write all wheels; return their paths."""
    points = {name: points for name, (_, points, _) in DESCRIBED.items()}
    code = {name: text for name, (text, *_) in {**WHEELS, **DESCRIBED}.items()}
    wheels = {
        name: write_wheel(folder, name, text, points.get(name), [TOOLS])
        for name, text in code.items()
    }
    pth = [("evil.pth", f"import pathlib; pathlib.Path({str(folder / 'pth ran')!r}).touch()\n")]
    wheels["pth"] = write_wheel(folder, "pth", module(), files=pth)
    nested = [("/".join(["n"] * 3000) + "/x.py", "")]
    wheels["nested"] = write_wheel(folder, "nested", module(), files=nested)
    bomb = [("zeros.bin", bytes(2**26))]
    wheels["bomb"] = write_wheel(folder, "bomb", module(), files=bomb)
    wheels["climbs"] = write_wheel(folder, "climbs", module(), files=[("../../../out.txt", "x")])
    wheels["locked"] = write_wheel(folder, "locked", module())
    encrypt(wheels["locked"])
    wheels["text"] = folder / "text-1.0-py3-none-any.whl"
    wheels["text"].write_text("no zip file")
    return wheels


HONEST = {"inverse_quarter_car": create("inverse_quarter_car"), "reader": Reader(gain=0.7)}


def files_in(folder):
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(
    scope="module",
    params=[
        pytest.param(KINDS, marks=pytest.mark.processes),
        pytest.param(set(SENTENCES), marks=pytest.mark.slow),
    ],
    ids=["kinds", "all"],
)
def names(request):
    """Names of the hostile entries."""
    return request.param


@pytest.fixture(scope="module")
def boards(names, tmp_path_factory):
    """The board with all entries, that of the honest ones alone, guests by name of their wheel."""
    folder, out = tmp_path_factory.mktemp("wheels"), tmp_path_factory.mktemp("out")
    t = small(tmp_path_factory.mktemp("season"))
    entries = [make_entry(name, estimator) for name, estimator in HONEST.items()]
    alone = run_board(
        RunRequest([t], entries, seeds=(1, 2)),
        tmp_path_factory.mktemp("alone"),
        InProcessExecutor(estimators=HONEST),
    )
    wheels = {name: path for name, path in write_wheels(folder).items() if name in names}
    before = files_in(folder)
    with SandboxClient(LIMITS) as sandbox:
        guests = resolve_entries(list(map(str, wheels.values())), sandbox.describe)
    attacks = [
        make_entry(f"run_{how}", Hostile(how=how, where=str(out) if where == "OUT" else where))
        for how, (where, _) in RUN.items()
        if f"run_{how}" in names
    ]
    attacks += [
        make_entry(f"reply_{name}", Hostile(how="reply", where=reply))
        for name, (reply, _) in REPLIES.items()
        if f"reply_{name}" in names
    ]
    mixed = [entries[0], *guests, *attacks, entries[1]]
    board = run_board(RunRequest([t], mixed, seeds=(1, 2), limits=LIMITS), out, ProcessExecutor(1))
    assert files_in(folder) == before  # "pth ran" is not among them
    assert not poisoned_kernels()
    return board, alone, dict(zip(wheels, guests, strict=True))


def row_of(board, name):
    (task,) = board.tasks
    (row,) = [row for row in board.results[task.name] if row.estimator == name]
    return row


def test_no_content_of_an_honest_row_changes(boards):
    board, alone, _ = boards
    for name in (*HONEST, *BASELINES):
        # guests and this process have the same kernels, if not the same number of threads
        assert disagreements(row_of(board, name), row_of(alone, name)) == []
    assert row_of(board, "reader").isolation == "bubblewrap"
    assert isolation_notice(board.results[board.tasks[0].name]) is None


def test_every_entry_has_its_row_and_every_failure_its_sentence(boards, names):
    board, _, guests = boards
    expected = {guests[name].name if name in guests else name: SENTENCES[name] for name in names}
    assert len(expected) == len(names) >= 6
    found = {row.estimator: row.failure for row in board.results[board.tasks[0].name]}
    assert found.keys() == {*expected, *HONEST, *BASELINES}
    for name, sentence in expected.items():
        failure = found[name]
        assert (failure is None) == (sentence is None), (name, failure)
        assert failure is None or (sentence in failure and failure.isprintable()), (name, failure)
        assert failure is None or len(failure) < 500
        assert NAME.fullmatch(name) and fold(name) not in RESERVED


def test_no_entry_has_solved_the_road(boards):
    board, _, _ = boards
    for row in board.results[board.tasks[0].name]:
        if row.estimator not in (*HONEST, *BASELINES):
            assert row.failure or run_scores(row, "nrmse").min() > 0.5, row.estimator


def test_what_an_entry_claims_falsely_is_shown(boards):
    board, _, guests = boards
    cheat, stateful, deaf = (row_of(board, name) for name in ("cheat", "stateful", "deaf"))
    assert guests["cheat"].causal and not cheat.causal
    assert cheat.notes == (f"cheat: {LOOKS_AHEAD}",)
    assert stateful.notes == (f"stateful: {REMEMBERS}",) and stateful.causal is False
    assert deaf.notes == (f"deaf: {ONE_TRAINING}",) and len(deaf.train_seconds) == 1
    claims = guests["claims"]
    assert claims.reference.endswith("claims-1.0-py3-none-any.whl") and len(claims.code) == 16


def test_reserved_names_include_those_of_all_baselines():
    assert RESERVED.issuperset(map(fold, BASELINES))
