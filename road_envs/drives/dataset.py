"""Data set of simulated drives with their true roads: Parquet files, splits, card, checksums."""

import hashlib
import json
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from road_envs._version import __version__
from road_envs.core.atomic_io import write_text
from road_envs.core.extras import import_pyarrow
from road_envs.drives.training_corpus import Corpus
from road_envs.records.accelerometers import column
from road_envs.records.record import Profile, Record

FORMAT = "roadrecon dataset 1"
CYCLE = ("train",) * 8 + ("validation", "test")
"""Split of the drives k = 0, 1, ..., repeated: every prefix of a data set has 80, 10 and 10 %."""

CARD = Path(__file__).with_name("dataset_card.txt")


def write_dataset(
    corpus: Corpus,
    folder: Path,
    *,
    command: str = "road_envs.drives.dataset.write_dataset",
    progress: Callable[[str, float], None] = lambda text, share: None,
) -> dict[str, Any]:
    """Write the drives of a corpus with card and checksums into `folder`; return the facts.

    The card says by which `command`; `progress` is called with a description and the share done.
    Raises MissingExtraError without pyarrow.
    """
    pa, pq = import_pyarrow()
    rows: list[dict[str, Any]] = []
    for split in dict.fromkeys(CYCLE):
        chosen = [k for k in range(corpus.number) if CYCLE[k % len(CYCLE)] == split]
        writers: dict[str, Any] = {}
        with ExitStack() as stack:
            for k in chosen:
                progress(f"simulating drive {k}", len(rows) / corpus.number)
                record, truth, _ = corpus.simulate_drive(k)
                rows.append({
                    "drive": k, "split": split, "length_m": float(record.length),
                    "speed_kmh": 3.6 * float(np.median(record.v)), "samples": record.t.size,
                })  # fmt: skip
                for name, columns in _tables(k, record, truth).items():
                    table = pa.table(columns)
                    if name not in writers:
                        path = folder / f"{split}_{name}.parquet"
                        writers[name] = stack.enter_context(pq.ParquetWriter(path, table.schema))
                    writers[name].write_table(table)
    rows.sort(key=lambda row: row["drive"])
    pq.write_table(pa.Table.from_pylist(rows), folder / "drives.parquet")
    facts = {
        "format": FORMAT,
        "version": __version__,
        "corpus": corpus.digest,
        "drives": corpus.number,
        "metres": float(sum(row["length_m"] for row in rows)),
        "licence": "CC-BY-4.0",
    }
    size = "n<1K" if corpus.number < 1000 else "1K<n<10K"
    card = CARD.read_text(encoding="utf-8").format(**facts, size=size, command=command)
    (folder / "README.md").write_text(card, encoding="utf-8")
    paths = sorted(folder.iterdir())
    files = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in paths}
    about = {**facts, "settings": asdict(corpus), "files": files}
    write_text(folder / "dataset.json", json.dumps(about, indent=2) + "\n")
    return facts


def _tables(k: int, record: Record, truth: Profile) -> dict[str, dict[str, Any]]:
    a = record.a.astype(np.float32)
    return {
        "records": {
            "drive": np.full(record.t.size, k, dtype=np.int32),
            "t": record.t,
            **dict(zip(map(column, record.channels), a, strict=True)),
            "v": record.v.astype(np.float32),
            "s": record.s,
            "commands": record.commands,
        },
        "profiles": {
            "drive": np.full(truth.s.size, k, dtype=np.int32),
            "station": truth.s,
            "left": truth.z[0].astype(np.float32),
            "right": truth.z[1].astype(np.float32),
        },
    }
