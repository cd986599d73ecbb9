"""Reading molecules: the atoms of .pdb and mmCIF files, by the library gemmi."""

from __future__ import annotations

import math
import os
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gemmi
import numpy as np

from harnack.backend import FloatArray
from harnack.files.file_format import FileFormatError, Place, read_bytes

PDB_FILES, CIF_FILES = (".pdb", ".ent"), (".cif", ".mmcif")
MOLECULE_FILES = (*PDB_FILES, *CIF_FILES)
_MOST_NAMED = 6


@dataclass(frozen=True, eq=False)
class Atoms:
    """Atoms from a file: positions (n, 3) and van der Waals radii (n,) in angstrom, elements (n,).

    said: what was found.
    """

    positions: FloatArray
    radii: FloatArray
    elements: tuple[str, ...]
    said: str


def read_molecule(path: str | os.PathLike[str]) -> Atoms:
    """The atoms of a molecule's file (.pdb, .ent, .cif, .mmcif): of its first model and of the
    first of alternative conformations, water and hydrogen as far as the file has them.

    Radii are gemmi's van der Waals radii of the elements (C 1.7, N 1.55, O 1.52, S 1.8, H 1.2).
    Atoms of an unknown element are left out, which `said` tells.

    Raises:
        FileFormatError: unreadable, malformed, another format, no atoms in it.
    """
    path = Path(path)
    if path.suffix.lower() not in MOLECULE_FILES:
        raise FileFormatError(f"{path}: molecules are read from {', '.join(MOLECULE_FILES)} files")
    return atoms_in(path, read_bytes(path))


def atoms_in(path: Path, data: bytes) -> Atoms:
    """The atoms of a file with these contents; see `read_molecule`."""
    place = Place(path)
    if b"\0" in data:
        raise place.error("this is binary data, not the text that its extension announces")
    text = data.decode("utf-8", "replace")
    try:
        if path.suffix.lower() in CIF_FILES:
            structure = gemmi.make_structure_from_block(gemmi.cif.read_string(text).sole_block())
        else:
            _check_coordinates(path, text)
            structure = gemmi.read_pdb_string(text)
    except FileFormatError:
        raise
    except (RuntimeError, ValueError, IndexError, UnicodeError) as error:
        first = " ".join(str(error).split())
        raise place.error(f"the molecule cannot be read ({first})") from None
    structure.remove_alternative_conformations()
    found = [site.atom for site in structure[0].all()] if len(structure) else []
    known = [atom for atom in found if atom.element.atomic_number > 0]
    if not known:
        raise place.error(
            "it holds no atoms of known elements: a molecule's file has lines ATOM or HETATM "
            "(.pdb) or a table _atom_site (.cif)"
        )
    positions = np.array([atom.pos.tolist() for atom in known], dtype=np.float64)
    wrong = np.flatnonzero(~np.isfinite(positions).all(axis=1))
    if wrong.size:
        raise place.error(f"atom {known[wrong[0]].serial} has coordinates that are not finite")
    radii = np.array([round(atom.element.vdw_r, 6) for atom in known], dtype=np.float64)
    elements = tuple(atom.element.name for atom in known)
    return Atoms(positions, radii, elements, _said(elements, len(found) - len(known), structure))


def _check_coordinates(path: Path, text: str) -> None:
    """That columns 31 to 54 of all atoms are three numbers: gemmi takes what is none for 0, and the
    digits before what is none for the number. It knows atoms by the first four letters of a line,
    small or capital: serial numbers above 99,999 may begin right behind them.

    Raises:
        FileFormatError: naming the first line where they are not.
    """
    for number, line in enumerate(text.splitlines(), start=1):
        if line[:4].upper() not in ("ATOM", "HETA"):
            continue
        try:
            finite = all(math.isfinite(float(line[k : k + 8])) for k in (30, 38, 46))
        except ValueError:
            finite = False
        if not finite or "_" in line[30:54]:  # Python reads 1_0 as 10
            raise Place(path, f"line {number}").error(
                f"columns 31 to 54 must be the three coordinates of an atom, not {line[30:54]!r}"
            )


def _said(elements: tuple[str, ...], left_out: int, structure: Any) -> str:
    common = Counter(elements).most_common(_MOST_NAMED)
    names = ", ".join(f"{count:,} {name}" for name, count in common)
    said = f"{len(elements):,} atoms ({names}{', ...' if len(set(elements)) > len(common) else ''})"
    if len(structure) > 1:
        said += f", the first of {len(structure)} models"
    if left_out:
        said += f"; {left_out:,} of unknown elements left out"
    return said
