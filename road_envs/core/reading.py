"""Reading of files that may be damaged or hostile: one kind of error, sizes known beforehand."""

import errno
import io
import math
import stat
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from road_envs.core.extras import MissingExtraError, import_pyarrow

MAX_COMPRESSION = 100  # largest ratio of uncompressed to stored bytes, against decompression bombs
MAX_CELLS = 2**28
"""Most cells of a Parquet file: ten hours of 70 columns at 100 Hz, 2 GiB of numbers. The size of a
file is no bound: run lengths make a constant column of any length a few bytes."""
MAX_MESSAGE = 300  # characters of a parser's message that are repeated


@contextmanager
def parsing(path: str | Path, error: type[Exception], reason: str) -> Iterator[None]:
    """Turn any exception inside the block into an `error` of one sentence that names the file.

    Parsers of other packages answer hostile bytes with exceptions of any class. An `error` raised
    inside gets the path alone, if it lacks it, others also the `reason`, such as "not valid YAML".
    """
    try:
        yield
    except MissingExtraError:
        raise
    except error as failure:
        text = str(failure)
        raise error(text if text.startswith(f"{path}: ") else f"{path}: {text}") from None
    except Exception as failure:
        said = " ".join(str(failure).split()) or type(failure).__name__
        if isinstance(failure, OSError):
            reason, said = "cannot be read", failure.strerror or said
        elif isinstance(failure, KeyError):
            said += " is missing"
        elif isinstance(failure, RecursionError):
            said = "nested too deeply"
        raise error(f"{path}: {reason}: {said[:MAX_MESSAGE]}") from None


def regular(path: str | Path) -> Path:
    """Return the path of a file or a folder. Raises OSError: a pipe and a device have no end."""
    mode = Path(path).stat().st_mode
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    return Path(path)


def read_npz(path: Path) -> dict[str, np.ndarray]:
    """Return the arrays of numbers or text in an .npz file, without pickle.

    Raises an exception of any class if the file is damaged: call it inside `parsing`.
    """
    return {name.removesuffix(".npy"): _parse_npy(data) for name, data in read_zip(path).items()}


def read_zip(path: Path) -> dict[str, bytes]:
    """Return the files in a zip archive by name; their stated sizes are checked before.

    Raises an exception of any class if it is damaged: call it inside `parsing`.
    """
    with zipfile.ZipFile(io.BytesIO(data := regular(path).read_bytes())) as archive:
        members = archive.infolist()
        # other methods than these two are unpacked without a limit
        if any(m.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) for m in members):
            raise ValueError("compressed by another method than deflate")
        if sum(m.file_size for m in members) > MAX_COMPRESSION * len(data):
            raise ValueError(f"more than {MAX_COMPRESSION} times as large when unpacked")
        return {m.filename: archive.read(m) for m in members}


def read_parquet(path: Path) -> Any:
    """Return the pyarrow table in a Parquet file, whose stated size is checked before.

    Raises an exception of any class if the file is damaged: call it inside `parsing`.
    """
    _, pq = import_pyarrow()
    with path.open("rb") as file:
        if file.read(4) != b"PAR1":
            raise ValueError("it does not begin with PAR1")
    size = path.stat().st_size
    limits = {"thrift_string_size_limit": size, "thrift_container_size_limit": size}
    with pq.ParquetFile(path, **limits) as file:
        about = file.metadata
        for k in range(about.num_row_groups):
            # an error in the metadata of a column raises here; `column` below would end Python
            next(file.iter_batches(1, row_groups=[k]), None)
        groups = [about.row_group(k) for k in range(about.num_row_groups)]
        cells = sum(g.column(k).num_values for g in groups for k in range(g.num_columns))
        cells = max(cells, about.num_rows * about.num_columns)
        if cells > MAX_CELLS:
            raise ValueError(f"{cells} cells; at most {MAX_CELLS} are read")
        return file.read()


def _parse_npy(data: bytes) -> np.ndarray:
    """Return the array in the bytes of an .npy file of format 1 or 2."""
    npy, file = np.lib.format, io.BytesIO(data)
    readers = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
    shape, fortran_order, dtype = readers[npy.read_magic(file)](file)
    left = len(data) - file.tell()
    if dtype.kind not in "biufU":
        raise ValueError(f"an array of type {dtype}, not of numbers or text")
    if min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize != left:
        raise ValueError(f"an array of shape {shape} and type {dtype} in {left} bytes")
    array = np.ndarray(shape, dtype, data, file.tell(), order="F" if fortran_order else "C")
    return array.copy(order="K")
