"""Arrays of .npz files, which are zip archives: a small one may hold arrays of any size."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

SIZE_MOST = 1e9  # bytes of arrays that may be packed as tightly as zeros can be
TIGHTNESS_MOST = 100  # beyond that size: images and forces are packed to a tenth at best, zeros to a thousandth


@contextmanager
def opened(file: str | Path) -> Iterator[Any]:
    """The arrays by name, without pickles. Raises ValueError where they are far larger than the file, before any is
    read, and whatever zipfile and numpy find in a damaged file."""
    with open(file, "rb") as raw:  # by name numpy leaves bad files open
        if zipfile.is_zipfile(raw):
            _fits(raw, Path(file).stat().st_size)
        raw.seek(0)
        with np.load(raw, allow_pickle=False) as arrays:
            yield arrays


def _fits(raw: Any, size: int) -> None:
    with zipfile.ZipFile(raw) as packed:
        whole = sum(one.file_size for one in packed.infolist())
    if whole > SIZE_MOST and whole > TIGHTNESS_MOST * size:
        raise ValueError(
            f"{whole / 1e9:.1f} GB of arrays in a file of {size / 1e6:.1f} MB; allowed: {TIGHTNESS_MOST} times the "
            "file's size; save them without compression"
        )
