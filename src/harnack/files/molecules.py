"""Reading molecules: the atoms of .pdb and mmCIF files, by the library gemmi. A file may hold
several "models" of a molecule; a molecule consists of chains of "residues" (groups of atoms).
"Alternatives" are several positions of the same atom, or several residues at the same place.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from harnack.backend import FloatArray
from harnack.files.file_geometry import FileFormatError, FileLocation, read_bytes

PDB_FILES, CIF_FILES = (".pdb", ".ent"), (".cif", ".mmcif")
MOLECULE_FILES = (*PDB_FILES, *CIF_FILES)
_ATOM_LINES = ("ATOM", "HETA")
_MAX_LISTED_ELEMENTS = 6


@dataclass(frozen=True, eq=False)
class Atoms:
    """Atoms of a molecule from a file: positions (n, 3) and van der Waals radii (n,) in angstrom,
    and the names of the elements (n,).

    summary: the contents of the file, and which of its atoms were left out.
    """

    positions: FloatArray
    radii: FloatArray
    elements: tuple[str, ...]
    summary: str


def read_molecule(path: str | os.PathLike[str]) -> Atoms:
    """Read the atoms of a molecule (.pdb, .ent, .cif, .mmcif): the atoms of the first model,
    without alternatives, water and hydrogen.

    Alternatives are atoms that the file marks as such (altLoc in .pdb, label_alt_id in .cif): of
    each atom the first alternative counts, and of residues at the same position the first. Atoms
    without the mark all count, whatever their names. Radii are gemmi's van der Waals radii of the
    elements (C 1.7, N 1.55, O 1.52, S 1.8, H 1.2). `summary` lists the parts left out: atoms of
    other models, alternatives, unknown elements, and the text after the line END.

    Raises:
        FileFormatError: unreadable, malformed, another format, no atoms in it.
    """
    path = Path(path)
    if path.suffix.lower() not in MOLECULE_FILES:
        raise FileFormatError(f"{path}: molecules are read from {', '.join(MOLECULE_FILES)} files")
    return parse_molecule(path, read_bytes(path))


def parse_molecule(path: Path, data: bytes) -> Atoms:
    """Parse the bytes `data` of a molecule's file: the atoms of the first model, without
    alternatives, water and hydrogen (`read_molecule`). path: of the file, whose extension gives the
    format.

    Raises:
        FileFormatError: malformed data, no atoms of known elements, or coordinates that are not
            finite.
    """
    import gemmi  # imported here, as few programs read molecules

    place = FileLocation(path)
    if b"\0" in data:
        raise place.error("this is binary data, not the text that its extension announces")
    is_cif = path.suffix.lower() in CIF_FILES
    text = _text(data, is_cif=is_cif)
    try:
        if is_cif:
            structure = gemmi.make_structure_from_block(gemmi.cif.read_string(text).sole_block())
        else:
            _check_coordinates(path, text)
            structure = gemmi.read_pdb_string(text, split_chain_on_ter=True)
    except FileFormatError:
        raise
    except (RuntimeError, ValueError, IndexError, UnicodeError) as error:
        first = " ".join(str(error).split())
        raise place.error(f"the molecule cannot be read ({first})") from None
    # The number of atoms of each model, alternatives included.
    sizes = [model.count_atom_sites() for model in structure]
    # Only the first model counts.
    atoms = _drop_alternate_locations(structure[0]) if sizes else []
    known_atoms = [atom for atom in atoms if atom.element.atomic_number > 0]
    if not known_atoms:
        raise place.error(
            "it holds no atoms of known elements: a molecule's file has lines ATOM or HETATM "
            "(.pdb) or a table _atom_site (.cif)"
        )
    positions = np.array([atom.pos.tolist() for atom in known_atoms], dtype=np.float64)
    invalid = np.flatnonzero(~np.isfinite(positions).all(axis=1))
    if invalid.size:
        raise place.error(
            f"atom {known_atoms[invalid[0]].serial} has coordinates that are not finite"
        )
    # gemmi's radii are rounded to single precision: 1.7 is 1.70000005 there.
    radii = np.array([round(atom.element.vdw_r, 6) for atom in known_atoms], dtype=np.float64)
    elements = tuple(atom.element.name for atom in known_atoms)
    left_out = {
        "alternatives": sizes[0] - len(atoms),
        "of unknown elements": len(atoms) - len(known_atoms),
        "behind the line END": 0 if is_cif else _count_atom_lines(text) - sum(sizes),
    }
    return Atoms(positions, radii, elements, _summarize(elements, left_out, len(structure)))


def _text(data: bytes, *, is_cif: bool) -> str:
    r"""Decode the bytes of a molecule's file to text, without byte order mark. In the text of a
    .pdb file, lines end with "\n", and each non-ASCII letter is replaced by a single byte: the
    format is given by columns, which gemmi counts in bytes."""
    data = data.removeprefix(b"\xef\xbb\xbf")
    if is_cif:
        return data.decode("utf-8", "replace")
    try:
        text = data.decode("utf-8")
    except UnicodeDecodeError:
        text = data.decode("latin-1")
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    return text.encode("ascii", "replace").decode("ascii")


def _drop_alternate_locations(model: Any) -> list[Any]:
    """Return the atoms of a model of a molecule, without alternatives. Only atoms that the file
    marks by a letter can be alternatives.

    Of marked atoms with the same name in a residue, only those are kept that have the letter of the
    first one in the file. Residues with different names may be at the same position in a chain.
    Then marked atoms of the later residues are dropped, unless they have the letter of the first
    marked atom at this position. A line TER in the file ends a chain; the same residue number after
    it stands for another position.
    """
    # The first marked residue at each position (its name and its letter); and the first letter of
    # each marked atom.
    residues: dict[tuple[int, str], tuple[str, str]] = {}
    first_altlocs: dict[tuple[int, str, str, str], str] = {}
    atoms: list[Any] = []
    for chain, residue in ((k, entry) for k, part in enumerate(model) for entry in part):
        for atom in residue:
            if atom.has_altloc():
                position = (chain, str(residue.seqid))
                name, letter = residues.setdefault(position, (residue.name, atom.altloc))
                is_other = name != residue.name and letter != atom.altloc
                first_altloc = first_altlocs.setdefault(
                    (*position, residue.name, atom.name), atom.altloc
                )
                if is_other or first_altloc != atom.altloc:
                    continue
            atoms.append(atom)
    return atoms


def _count_atom_lines(text: str) -> int:
    """Return the number of lines of a .pdb file that describe an atom."""
    return sum(line[:4].upper() in _ATOM_LINES for line in text.split("\n"))


def _check_coordinates(path: Path, text: str) -> None:
    """Check that columns 31 to 54 of each line of a .pdb file that describes an atom are three
    numbers, of eight columns each. gemmi does not check this: it reads a word as 0, and "12x" as
    12.

    As in gemmi, a line describes an atom if its first four letters, in upper or lower case, say so,
    since a serial number above 99,999 may follow directly.

    Raises:
        FileFormatError: some line has other columns; the message names the first one.
    """
    for number, line in enumerate(text.split("\n"), start=1):
        if line[:4].upper() not in _ATOM_LINES:
            if line.lstrip()[:6].upper().strip() in ("ATOM", "HETATM"):
                raise FileLocation(path, f"line {number}").error(
                    "ATOM and HETATM begin in column 1"
                )
            continue
        # The decimal points of the three numbers must be in the same column of each. Counted from
        # 0, the numbers begin in columns 30, 38 and 46.
        dot_columns = {line[k : k + 8].find(".") for k in (30, 38, 46)}
        if len(dot_columns) > 1 and not any(c.isspace() for c in line[30:54]):
            raise FileLocation(path, f"line {number}").error(
                f"coordinates run out of their columns 31 to 54: {line[30:54]!r}"
            )
        try:
            is_finite = all(math.isfinite(float(line[k : k + 8])) for k in (30, 38, 46))
        except ValueError:
            is_finite = False
        if not is_finite or "_" in line[30:54]:  # Python reads 1_0 as 10
            raise FileLocation(path, f"line {number}").error(
                f"columns 31 to 54 must be the three coordinates of an atom, not {line[30:54]!r}"
            )


def _summarize(elements: tuple[str, ...], left_out: dict[str, int], model_count: int) -> str:
    """Return the summary of a molecule as a text: the number of atoms, the commonest elements, and
    how many atoms were left out.

    elements: the name of each atom's element.
    left_out: the number of atoms that were left out, by reason.
    model_count: the number of models in the file.
    """
    common = Counter(elements).most_common(_MAX_LISTED_ELEMENTS)
    names = ", ".join(f"{count:,} {name}" for name, count in common)
    summary = (
        f"{len(elements):,} atoms ({names}{', ...' if len(set(elements)) > len(common) else ''})"
    )
    if model_count > 1:
        summary += f", the first of {model_count} models"
    reasons = [f"{number:,} {reason}" for reason, number in left_out.items() if number]
    return f"{summary}; {', '.join(reasons)} left out" if reasons else summary
