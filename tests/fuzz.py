"""Fuzzing of every reader: `make fuzz`; arguments: seconds for each (600), processes (1), names.

The seconds are of the processor, not of the clock, so that other work on the machine counts for
nothing.

Samples are mutated by operations of this file alone, which has no part in the tests: on bytes, on
lines, on the tree of a JSON or YAML text, and on the members of a ZIP archive. A file must be read
or refused by the documented error in one sentence, within 5 s of processor time. What ends
otherwise is kept in `out/fuzz`, and the counts of each reader's last run in `docs/runs/fuzz.txt`.
"""

import collections
import copy
import functools
import hashlib
import io
import json
import multiprocessing
import os
import random
import sys
import tempfile
import traceback
import zipfile
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pandas
import yaml

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "support"), str(ROOT / "tests" / "oracles")]

from board_runs import run, small  # noqa: E402
from hostile_files import Reader, readers  # noqa: E402
from oracles_roads import crg_file, erd_file  # noqa: E402
from phone_recordings import SAMPLES, sample  # noqa: E402
from ros_recordings import write_mcap  # noqa: E402

from leaderboard.api import load_task as load_arrays  # noqa: E402
from leaderboard.drive_report.export import read_heights  # noqa: E402
from leaderboard.entries import entry_files  # noqa: E402
from leaderboard.entries.entry import Entry, EntryError  # noqa: E402
from leaderboard.evaluation import store  # noqa: E402
from leaderboard.method_card import load_method_card  # noqa: E402
from leaderboard.report.tables import board_views  # noqa: E402
from leaderboard.running import jobs  # noqa: E402
from leaderboard.running.board import load_board  # noqa: E402
from leaderboard.running.jobs import Job  # noqa: E402
from leaderboard.sandbox import messages  # noqa: E402
from leaderboard.submission.rules import load_rules  # noqa: E402
from leaderboard.submission.submission import SUBMISSION, load_submission  # noqa: E402
from leaderboard.task_tables import score_file, write_task  # noqa: E402
from road_envs.core.artifacts import HEADER, _text_checksum  # noqa: E402
from road_envs.core.config import ConfigError  # noqa: E402
from road_envs.drives.logger_tables.description import DriveDescription  # noqa: E402
from road_envs.drives.recordings.formats import read_source, read_track  # noqa: E402
from road_envs.roads.formats.opencrg import WIDTHS, SurfaceFileError  # noqa: E402
from road_envs.roads.measured import Measured  # noqa: E402

KEPT = ROOT / "out" / "fuzz"
NUMBERS = (0, -1, 1e308, -1e-308, 2**31, 2**63, 10**40, 1.5, True, None)
TEXTS = ("", "\u202e", "\\input{x}", "../x", "\x00", "=1", "a" * 3000, "nan", "1e5", "é")
KINDS = (list, dict)
CARD = "method: a\ndata: none\nlicence: MIT\nauthors: [b]\ncitation: none\n"
RULES = "tasks: [class]\nroads: 6\nseeds: 3\n"
RECORD = {
    "name": "a", "code": "b", "package_version": "1", "hardware": {"blas": "c"}, "cpu_seconds": 1.5,
    "files": {"card.yaml": hashlib.sha256(CARD.encode()).hexdigest()},
}  # fmt: skip


def mutated_tree(value: Any, rng: random.Random) -> Any:
    """Return a tree in which one to four nodes are replaced, removed, repeated or nested."""
    top = [copy.deepcopy(value)]
    for _ in range(rng.randint(1, 4)):
        places = list(_places(top))
        holder, key = rng.choice(places)
        match rng.randrange(7):
            case 0:
                holder[key] = rng.choice(NUMBERS)
            case 1:
                holder[key] = rng.choice(TEXTS)
            case 2:
                other, name = rng.choice(places)
                holder[key] = copy.deepcopy(other[name])
            case 3 if isinstance(holder, dict):
                holder[rng.choice([*TEXTS, str(key) + "_"])] = holder.pop(key)
            case 4 if len(holder) > 1 and holder is not top:
                del holder[key]
            case 5:
                for _ in range(rng.choice((1, 5, 300))):
                    holder[key] = [holder[key]]
            case _ if isinstance(holder[key], int | float):
                holder[key] = holder[key] * rng.choice((-1, 1e3, 1e9, 1e-9, 0.5))
    return top[0]


def _places(value: Any) -> Iterator[tuple[Any, Any]]:
    """Yield container and key of each node, level by level."""
    left = collections.deque([value])
    while left:
        holder = left.popleft()
        for key in list(holder) if isinstance(holder, dict) else range(len(holder)):
            yield holder, key
            if isinstance(holder[key], KINDS):
                left.append(holder[key])


def mutated_bytes(data: bytes, rng: random.Random) -> bytes:
    """Return a copy with blocks overwritten, moved, cut, or taken as lines or columns."""
    content = bytearray(data)
    for _ in range(rng.randint(1, 6)):
        at, size = rng.randrange(len(content) + 1), rng.choice((1, 2, 4, 8, 64, 500))
        match rng.randrange(6):
            case 0:
                content[at : at + size] = rng.randbytes(size)
            case 1:
                content[at : at + size] = b"\xff" * size
            case 2:
                to = rng.randrange(len(content) + 1)
                content[to:to] = content[at : at + size]
            case 3:
                del content[at : at + size]
            case 4:
                lines = bytes(content).split(b"\n")
                lines[rng.randrange(len(lines))] = rng.choice(lines)
                content = bytearray(b"\n".join(lines))
            case _ if at < len(content):
                content[at] ^= 1 << rng.randrange(8)
    return bytes(content)


def mutated_archive(data: bytes, rng: random.Random) -> bytes:
    """Return a ZIP archive, valid as such, of which one member is mutated, renamed or missing."""
    with zipfile.ZipFile(io.BytesIO(data)) as file:
        members = [(name, file.read(name)) for name in file.namelist()]
    k = rng.randrange(len(members))
    name, content = members[k]
    if rng.random() < 0.8:
        members[k] = (name, mutated(content, name, rng))
    else:
        others = [other.strip("\0") or "_" for other in rng.sample(TEXTS, rng.randrange(3))]
        members[k : k + 1] = [(other, content) for other in others]
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in members:
            file.writestr(name, content)
    return buffer.getvalue()


def mutated(sample: bytes, name: str, rng: random.Random) -> bytes:
    """Return a mutation of a sample; of its tree or members two times in three, if it has any."""
    if name.endswith(("zip", "npz", "whl")) and rng.random() < 0.67:
        return mutated_archive(sample, rng)
    if name.endswith(("yaml", "json")) and rng.random() < 0.67:
        tree = yaml.safe_load(sample) if name.endswith("yaml") else json.loads(sample)
        with suppress(RecursionError):
            return json.dumps(mutated_tree(tree, rng), default=str).encode()  # YAML contains JSON
    return mutated_bytes(sample, rng)


def more_readers(folder: Path) -> dict[str, Reader]:
    """Return readers of rows of a board, jobs, replies of guests, wheels and submissions."""
    board, _ = run(folder / "board")
    row = store.row_path(folder / "board", small().name, "reader")
    entry = Entry(name="x", reference="flat")
    job = jobs.to_text(Job(task=small(), condition=0, entries=(entry,), seeds=(1,)))
    reply = b'{"settings": {"a": [1, "b", null]}, "causal": true, "lag": 0.5, "seconds": 1.0}'
    wheel = folder / "x-1.0-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr("x.py", "x = 1")

    def read_row(path: Path) -> None:
        """Read a row resealed with its checksum, and the tables of its board."""
        text = path.read_text(encoding="utf-8", errors="replace")
        with suppress(ValueError, AttributeError):
            data = json.loads(text)
            data.pop("sha256", None)
            blank = '{\n "sha256": "' + "0" * 64 + '",\n' + json.dumps(data)[1:]
            text = blank.replace("0" * 64, _text_checksum(blank), 1)
        row.write_text(text, encoding="utf-8")
        views = board_views(load_board(board.tasks, folder / "board"))
        broken = [x.message for view in views for s in view.sections for x in s.rows if x.message]
        if any("cannot be read" in text for text in broken):
            raise ConfigError(f"{path}: refused")

    def read_reply(path: Path) -> None:
        head = messages.parse_head(path.read_bytes())
        messages.settings(head.get("settings"))
        messages.number(head, "seconds", 10.0)

    def read_submission(path: Path) -> None:
        """Read a record resealed with its checksum, in a folder of its name with its card."""
        record = path.parent / RECORD["name"] / path.name
        record.parent.mkdir(exist_ok=True)
        record.with_name("card.yaml").write_text(CARD)
        record.write_bytes(path.read_bytes())
        with suppress(ValueError, AttributeError, TypeError, RecursionError):
            data = json.loads(path.read_bytes())
            content = {key: x for key, x in data.items() if key not in HEADER}
            SUBMISSION.write(record, content, str(data.get("identity")))
        load_submission(record.parent)

    def one(read: Callable[[Path], Any], sample: bytes, name: str, error: type[Exception]):
        return Reader(read, sample, name, error)

    return {
        "row of a board": one(read_row, row.read_bytes(), "row.json", ConfigError),
        "job": one(
            lambda path: jobs.from_text(path.read_text(encoding="utf-8"), str(path), path.parent),
            job.encode(), "job.json", ValueError,
        ),
        "reply of a guest": one(read_reply, reply, "reply.json", EntryError),
        "snapshot of a wheel": one(
            lambda path: entry_files.snapshot(str(path), None),
            wheel.read_bytes(), "x.whl", EntryError,
        ),
        "submission": one(
            read_submission, SUBMISSION.to_text(RECORD).encode(), "submission.json", ConfigError
        ),
        "card": one(load_method_card, CARD.encode(), "card.yaml", ConfigError),
        "rules": one(load_rules, RULES.encode(), "rules.yaml", ConfigError),
        **recordings(folder),
        **surfaces(),
        **tables_of_heights(folder),
    }  # fmt: skip


def surfaces() -> dict[str, Reader]:
    """Return a reader of each kind of surface file."""
    z = 0.001 * np.arange(40.0).reshape(2, 20) % 0.007
    rows = [f"{0.25 * k},{a},{b}" for k, (a, b) in enumerate(z.T)]
    files = {f"{form}.crg": crg_file(z.T, form) for form in WIDTHS}
    files["surface.erd"] = b"".join(erd_file(z))
    files["surface.csv"] = "\n".join(["distance,left,right", *rows]).encode()
    return {
        f"surface {name}": Reader(
            lambda path: Measured(path=str(path), track=0.4, min_length=0.1),
            content, name, SurfaceFileError,
        )
        for name, content in files.items()
    }  # fmt: skip


def tables_of_heights(folder: Path) -> dict[str, Reader]:
    """Return readers of heights to be scored and of the heights in a report."""
    task = load_arrays("class", roads=1)
    write_task(task, folder, form="csv")
    profiles = pandas.read_csv(folder / "test_profiles.csv")
    scored = profiles.fillna(0.01).to_csv(index=False).encode()
    table = {"station_m": 0.05 * np.arange(50), "mean_m": 0.001 * np.arange(50)}
    report = io.BytesIO()
    pandas.DataFrame(table).to_parquet(report)
    return {
        "heights to score": Reader(
            lambda path: score_file(task, path), scored, "heights.csv", ConfigError
        ),
        "heights of a report": Reader(
            read_heights, report.getvalue(), "a_heights.parquet", ConfigError
        ),
    }


def recordings(folder: Path) -> dict[str, Reader]:
    """Return a reader of each kind of recording; of MDF4 where its extra is installed."""
    found = {name: write(sample()) for name, write in SAMPLES.items() if name != "drive.gpx"}
    with suppress(ImportError):
        from asammdf import MDF, Signal

        t = np.arange(200) / 100.0
        with MDF(version="4.10") as file:
            file.append([Signal(np.sin(t), t, name=f"acc_{k}", unit="m/s²") for k in "xyz"])
            file.append(Signal(36.0 + t, t, name="speed", unit="km/h"))
            file.save(folder / "drive.mf4")
        found["drive.mf4"] = (folder / "drive.mf4").read_bytes()
    found["drive.mcap"] = write_mcap(folder / "drive.mcap", sample()).read_bytes()
    return {
        "track drive.gpx": Reader(
            lambda path: read_track(path, DriveDescription()),
            SAMPLES["drive.gpx"](sample()),
            "drive.gpx",
            ConfigError,
        ),
        **{
            f"recording {name}": Reader(
                lambda path: read_source(path, DriveDescription()), content, name, ConfigError
            )
            for name, content in found.items()
        },
    }


def processor_time() -> float:
    """Return the time [s] that the processor worked for this process and its children."""
    return sum(os.times()[:4])


def fuzz(name: str, seconds: float) -> tuple[int, int, int, float]:
    """Return the numbers of files, of refusals, of other ends, which are kept, and the CPU time."""
    folder, found = samples()
    reader = found[name]
    rng = random.Random(f"fuzz {name}")
    count, refused, faults = 0, 0, 0
    path = folder / reader.name
    path.write_bytes(reader.sample)
    reader.read(path)  # else all are refused for one reason
    start = processor_time()
    while processor_time() < start + seconds:
        content = mutated(reader.sample, reader.name, rng)
        path.write_bytes(content)
        count, began = count + 1, processor_time()
        try:
            reader.read(path)
        except reader.error as error:
            refused += 1
            fault = "\n" in str(error)
        except BaseException:
            fault = True
            traceback.print_exc(limit=-3)
        else:
            fault = False
        if fault or processor_time() - began > 5.0:
            faults += 1
            KEPT.mkdir(parents=True, exist_ok=True)
            (KEPT / f"{name.replace(' ', '_')}_{count}_{reader.name}").write_bytes(content)
    return count, refused, faults, processor_time() - start


@functools.cache
def samples() -> tuple[Path, dict[str, Reader]]:
    """Return a folder of this process, for mutated files, and all readers."""
    folder = Path(tempfile.mkdtemp())
    made = folder / "samples"
    made.mkdir()
    return folder, {**readers(made), **more_readers(made)}


def main() -> None:
    """Fuzz every reader, print and keep the counts, in the order of the readers."""
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 600.0
    jobs = int(sys.argv[2]) if len(sys.argv) > 2 else 1
    head = f"{'reader':<28}{'files':>9}{'read':>9}{'refused':>9}{'faults':>8}{'processor':>11}"
    about = [
        "$ make fuzz",
        "",
        "The last run of each reader, and how long the processor worked.",
        "",
    ]
    total = 0
    with tempfile.TemporaryDirectory() as temp:
        os.environ["TMPDIR"] = temp  # of all processes
        tempfile.tempdir = None
        os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = "1"
        chosen = sys.argv[3:] or list(samples()[1])
        kept = ROOT / "docs" / "runs" / "fuzz.txt"
        lines = {line[:28].strip(): line for line in kept.read_text("utf-8").splitlines()}
        lines = {name: lines.get(name, f"{name:<28}    not run") for name in samples()[1]}
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(jobs, context) as pool:
            counts = pool.map(fuzz, chosen, [seconds] * len(chosen))
            for name, (count, refused, faults, worked) in zip(chosen, counts, strict=True):
                total += faults
                read = count - refused - faults
                lines[name] = (
                    f"{name:<28}{count:>9}{read:>9}{refused:>9}{faults:>8}{worked:>9.0f} s"
                )
                print(lines[name], flush=True)
                text = "\n".join([*about, head, *lines.values(), ""])
                kept.write_text(text, encoding="utf-8")
    sys.exit(total > 0)


if __name__ == "__main__":
    main()
