"""Molecules: atoms as Gaussian blobs of their van der Waals radii."""

from __future__ import annotations

import os
from typing import Any

from harnack.fields.blobs.blobs import Blobs
from harnack.fields.blobs.kernels import Gaussian
from harnack.files.molecules import Atoms, read_molecule


class Molecule(Blobs):
    """The surface of a molecule: the level 1 of a sum of A exp(-s (d/r)^2) over its atoms, less
    what makes each end (see `Gaussian`), where r is the van der Waals radius of the atom.

    source: a .pdb, .ent, .cif or .mmcif file, or `Atoms`.
    sharpness: s; the larger, the closer the surface follows the single atoms.
    tail: where an atom ends: where so much of its Gaussian is left, in parts of what it is at its
        radius. With 1/32 about ten atoms reach a point, with 1/1000 about twenty.

    The usual viewers cut Gaussians off where 1/32 is left: then f jumps by that, and the surface
    has seams. Here the tangent is taken off, so that atoms end smoothly and ranges of f along a
    ray are exact; a single atom is still a ball of its radius.

    Raises FileFormatError for what is no file of a molecule.
    """

    def __init__(
        self,
        source: str | os.PathLike[str] | Atoms,
        *,
        sharpness: float = 1.0,
        tail: float = 1 / 32,
    ) -> None:
        self.atoms = source if isinstance(source, Atoms) else read_molecule(source)
        super().__init__(self.atoms.positions, self.atoms.radii, kernel=Gaussian(sharpness, tail))

    def describe(self) -> dict[str, Any]:
        facts = super().describe()
        return {"atoms": facts.pop("blobs"), **facts}
