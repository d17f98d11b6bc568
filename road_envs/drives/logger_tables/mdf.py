"""Channels of measurement files (ASAM MDF 3 and 4), read by asammdf in a process of its own.

Of damaged files some end the parser by a segmentation fault, some keep it busy for very long, and
most make it print. None of this reaches the program that reads a drive.
"""

import os
import re
import subprocess
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from road_envs.core.config import ConfigError
from road_envs.core.extras import MissingExtraError, import_pandas, import_pyarrow, missing_extra
from road_envs.core.reading import MAX_MESSAGE

MAX_SECONDS = 600.0  # longest time [s] for one file


def read_mdf(path: Path) -> Any:
    """Return the channels of an MDF file as a table of pyarrow with the column `t` [s].

    Cells are empty where a channel was not sampled. Raises ConfigError, MissingExtraError.
    """
    if find_spec("asammdf") is None:
        missing = ModuleNotFoundError(name="asammdf")
        raise MissingExtraError(missing_extra(missing, "a measurement file (MDF)"))
    _, parquet = import_pyarrow()
    with tempfile.TemporaryDirectory() as folder:
        made, failure = Path(folder, "channels.parquet"), Path(folder, "failure.txt")
        try:
            ended = subprocess.run(
                [sys.executable, "-P", "-m", __name__, path, made, failure],
                env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
                capture_output=True,
                timeout=MAX_SECONDS,
            )
        except subprocess.TimeoutExpired:
            raise ConfigError(f"no MDF file that is read within {MAX_SECONDS:g} s") from None
        if failure.exists():
            raise ConfigError(f"no readable MDF file: {failure.read_text(encoding='utf-8')}")
        if not made.exists():
            raise ConfigError(f"no readable MDF file: its parser failed ({ended.returncode})")
        return parquet.read_table(made, memory_map=False)


def read_channels(path: Path) -> Any:
    """Return the table of `read_mdf` as a data frame. Raises what the parser raises."""
    from asammdf import MDF

    pd = import_pandas()
    channels: dict[str, Any] = {}
    with MDF(path) as file:
        for signal in file.iter_channels():
            samples = np.asarray(signal.samples)
            if samples.ndim > 1 or samples.dtype.names:
                continue
            if samples.dtype.kind == "S":
                samples = np.char.decode(samples, "utf-8", "replace")
            name = f"{signal.name} [{signal.unit}]" if signal.unit else signal.name
            channel = channels.setdefault(name, pd.Series(samples, signal.timestamps))
            if channel.index.has_duplicates:
                raise ValueError(f"two samples of the channel {name!r} have one time")
    frame = pd.DataFrame(channels)
    if "t" not in map(str.lower, frame.columns):
        frame.insert(0, "t", frame.index.to_numpy(dtype=float))
    return frame


def _main(source: str, made: str, failure: str) -> None:
    try:
        read_channels(Path(source)).to_parquet(made, index=False)
    except Exception as error:
        said = re.sub(r"^['\"](<mmap|/).*['\"] is not", "not", str(error))
        said = " ".join(said.split())[:MAX_MESSAGE] or type(error).__name__
        Path(failure).write_text(said, encoding="utf-8", errors="replace")


if __name__ == "__main__":
    _main(*sys.argv[1:])
