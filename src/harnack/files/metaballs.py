"""Reading metaball files: text that a person can write, a blob a line.

    # x y z radius [weight [group]]
    0.0  0.0  0.0  1.0
    1.2  0.0  0.0  0.8
    0.6  0.5  0.0  0.4  -1     # carves

The radius is that of the ball which the blob is alone. Weights are 1 unless given. Blobs of one
group flow together, groups meet in creases; without groups all flow together.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from harnack.backend import FloatArray, IntArray
from harnack.files.file_format import Place
from harnack.files.text_tables import content_lines, read_floats
from harnack.names import renamed

_COLUMNS = "x y z radius [weight [group]]"


@renamed(centres="centers")
@dataclass(frozen=True, eq=False)
class Metaballs:
    """Blobs from a file: centers (n, 3), radii (n,), weights (n,), and groups (n,) or None.

    said: what was found.
    """

    centers: FloatArray
    radii: FloatArray
    weights: FloatArray
    groups: IntArray | None
    said: str


def read_metaballs(path: Path, data: bytes) -> Metaballs:
    """The blobs of a .blobs file, one a line: x y z radius [weight [group]]. `#` begins a comment.

    Lines may have different numbers of columns: a weight left out is 1. Either all lines name a
    group or none does.

    Raises:
        FileFormatError: nothing in it; words, numbers that are not finite, fewer than four or more
            than six columns, a radius that is not positive, a group that is no integer, groups on
            some lines only.
    """
    lines = content_lines(path, data)
    if not len(lines):
        raise Place(path).error(f"it holds no blobs: write one a line, {_COLUMNS}")
    numbers, counts = read_floats(lines)
    wrong = np.flatnonzero((counts < 4) | (counts > 6))
    if wrong.size:
        raise lines.places[wrong[0]].error(
            f"a blob has four to six numbers, {_COLUMNS}, not {counts[wrong[0]]}"
        )
    table = np.ones((len(counts), 6))
    table[np.arange(6) < counts[:, None]] = numbers
    radii, groups = table[:, 3], table[:, 5]
    wrong = np.flatnonzero(~(radii > 0))
    if wrong.size:
        raise lines.places[wrong[0]].error(
            f"the radius of a blob must be positive, not {radii[wrong[0]]:g}; to carve, give a "
            "negative weight behind it"
        )
    named = counts == 6
    said = f"{len(table):,} blobs"
    if not named.any():
        return Metaballs(table[:, :3], radii, table[:, 4], None, f"{said}, one group")
    if not named.all():
        raise lines.places[int(np.argmin(named))].error(
            "this line names no group and others do: write the sixth number in all lines or in none"
        )
    wrong = np.flatnonzero((groups != np.rint(groups)) | (np.abs(groups) > 2**31))
    if wrong.size:
        raise lines.places[wrong[0]].error(f"a group must be an integer, not {groups[wrong[0]]:g}")
    whole = groups.astype(np.int64)
    said = f"{said} in {len(np.unique(whole))} groups"
    return Metaballs(table[:, :3], radii, table[:, 4], whole, said)
