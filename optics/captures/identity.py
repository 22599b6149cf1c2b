"""What identifies captures: hashes of the images and of the lines of a table, whatever the files are called.

A set that was copied, renamed, split, or described by another captures.toml has the same prints."""

from __future__ import annotations

import hashlib
from collections.abc import Collection

import numpy as np

from optics.captures.capture_set import Captures

DIGITS = 12  # of a print, hexadecimal: 48 bits; of 64 prints and 100 000 others two agree by accident once in 4e7 sets
SKETCH = 64  # prints that stand for a set: the smallest, which any large part of the set has some of
SAME_ROWS = 0.5  # of the rows of the smaller of two tables: short numbers repeat between sessions, by accident


def prints_of(captures: Captures) -> list[str]:
    """A hash of each frame's image, or of each line of the table, in their order.

    An image of one value, such as a frame in the dark, and an empty line identify nothing: they have none.
    """
    if captures.table is not None:
        file = captures.folder / captures.table.file
        if file.is_file():
            lines = (b" ".join(line.split()) for line in file.read_bytes().splitlines())
            return list(dict.fromkeys(_hash(line) for line in lines if line))
    found = []
    for frame in captures.frames:
        image = np.ascontiguousarray(frame.image, np.float32)
        if image.size and (np.ptp(image) > 0 or captures.table is not None):
            found.append(_hash(str(image.shape).encode() + image.tobytes()))
    return list(dict.fromkeys(found))


def digest_of(captures: Captures) -> str:
    """One hash of a whole set; the order of its frames does not matter."""
    return "sha256:" + hashlib.sha256(" ".join(sorted(prints_of(captures))).encode()).hexdigest()


def sketch_of(captures: Captures) -> list[str]:
    """The SKETCH smallest prints of a set, by which `shared` knows it again."""
    return sorted(prints_of(captures))[:SKETCH]


def shared(sketch: Collection[str], prints: Collection[str], table: bool) -> bool:
    """Whether a set holds data of the one that a sketch was made of: an image in common, or more than half of the
    lines of the smaller table, as far as the sketch reaches.

    sketch   `sketch_of` the one set;   prints: `prints_of` the other
    """
    ours = set(sketch)
    theirs = {p for p in prints if len(ours) < SKETCH or p <= max(ours)}
    both, smaller = len(ours & theirs), min(len(ours), len(theirs))
    return both > SAME_ROWS * smaller if table else both > 0


def _hash(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:DIGITS]
