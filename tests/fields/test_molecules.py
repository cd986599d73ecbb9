"""Molecules and metaballs from files: reading, errors, opening, and the surface of atoms."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import harnack as hk
from harnack.cli import main
from harnack.field_from_file import field_from_file
from harnack.fields.blobs.blobs import Blobs, Molecule
from harnack.files import Atoms, FileFormatError, Metaballs, read_geometry, read_molecule

ATOM = "ATOM  {:>5d}  {:<3s} GLY A{:>4d}    {:8.3f}{:8.3f}{:8.3f}  1.00  0.00          {:>2s}\n"
CIF = """data_small
loop_
_atom_site.group_PDB
_atom_site.id
_atom_site.type_symbol
_atom_site.label_atom_id
_atom_site.label_alt_id
_atom_site.label_comp_id
_atom_site.label_asym_id
_atom_site.label_seq_id
_atom_site.auth_asym_id
_atom_site.auth_seq_id
_atom_site.Cartn_x
_atom_site.Cartn_y
_atom_site.Cartn_z
ATOM 1 C CA . GLY A 1 A 1 0.0 0.0 0.0
ATOM 2 O O . GLY A 1 A 1 1.2 0.0 0.0
"""


def pdb(atoms: Any) -> str:
    return "".join(
        ATOM.format(k + 1, name, k + 1, *position, name)
        for k, (name, position) in enumerate(atoms)
    ) + "END\n"  # fmt: skip


def written(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.write_text(text)
    return path


def test_atoms_of_both_formats(tmp_path: Path) -> None:
    atoms = [("C", (0.0, 0.0, 0.0)), ("O", (1.2, 0.0, 0.0))]
    for path in (written(tmp_path, "a.pdb", pdb(atoms)), written(tmp_path, "a.cif", CIF)):
        found = read_molecule(path)
        np.testing.assert_allclose(found.positions, [[0, 0, 0], [1.2, 0, 0]])
        assert found.elements == ("C", "O")
        np.testing.assert_allclose(found.radii, [1.7, 1.52])
        assert found.summary == "2 atoms (1 C, 1 O)"


def test_one_model_and_one_conformation(tmp_path: Path) -> None:
    lines = pdb([("C", (0, 0, 0)), ("C", (9, 0, 0)), ("Xx", (5, 0, 0))]).splitlines()
    lines[0] = lines[0][:16] + "A" + lines[0][17:]
    lines[1] = lines[0][:6] + "    2" + lines[0][11:16] + "B" + lines[0][17:30] + lines[1][30:]
    text = "MODEL        1\n" + "\n".join(lines[:3]) + "\nENDMDL\nMODEL        2\n"
    found = read_molecule(written(tmp_path, "b.ent", text + "\n".join(lines[:1]) + "\nENDMDL\n"))
    np.testing.assert_allclose(found.positions, [[0, 0, 0]])
    assert "first of 2 models" in found.summary
    assert "1 alternatives, 1 of unknown elements left out" in found.summary


def test_atoms_of_one_name_all_count(tmp_path: Path) -> None:
    """As Open Babel writes them: six atoms C in one residue UNL."""
    lines = [
        f"HETATM{k:>5d}  C   UNL     1    {1.4 * k:8.3f}   0.000   0.000  1.00  0.00{'C':>12s}"
        for k in range(1, 7)
    ]
    found = read_molecule(written(tmp_path, "a.pdb", "\n".join([*lines, "END", ""])))
    np.testing.assert_allclose(found.positions[:, 0], 1.4 * np.arange(1, 7))
    assert found.summary == "6 atoms (6 C)"
    ended = read_molecule(written(tmp_path, "b.pdb", "\n".join([*lines, "END", *lines[:2], ""])))
    assert ended.summary == "6 atoms (6 C); 2 behind the line END left out"
    many = [CIF.splitlines()[-2].replace("1.0", f"{k}.0") for k in range(6)]
    head = "\n".join(CIF.splitlines()[:-2])
    read = read_molecule(written(tmp_path, "a.cif", "\n".join([head, *many, ""])))
    assert read.summary == "6 atoms (6 C)"


def test_alternatives_are_what_the_file_marks(tmp_path: Path) -> None:
    """Of SER A or THR B in one place SER counts; atoms of altLoc B alone and unmarked ones do."""
    atoms = [("CA", " ", "SER"), ("CB", "A", "SER"), ("OG", "A", "SER"), ("CB", "B", "THR"),
             ("CG2", "B", "THR"), ("CA", " ", "SER")]  # fmt: skip
    text = "".join(
        f"ATOM  {k + 1:>5d}  {name:<3s}{mark}{residue} A   1    {k:8.3f}   0.000   0.000"
        f"  1.00  0.00{name[0]:>12s}\n"
        for k, (name, mark, residue) in enumerate(atoms)
    )
    found = read_molecule(written(tmp_path, "a.pdb", text))
    np.testing.assert_allclose(np.sort(found.positions[:, 0]), [0, 1, 2, 5])
    assert found.summary.endswith("; 2 alternatives left out")


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.pdb", "HEADER    nothing\nEND\n", "no atoms"),
        ("a.cif", "loop_\n_atom_site.id\n", "cannot be read"),
        ("a.cif", "data_x\n_cell.length_a 1\n", "no atoms"),
        (
            "a.pdb",
            "\nATOM      1  C   GLY A   1       x.000   0.000   0.000\n",
            "line 2: columns 31",
        ),
        ("a.pdb", "ATOM\0\n", "binary"),
        ("a.pdb", "", "empty"),
        ("a.txt", "ATOM\n", "read from .pdb"),
        ("a.blobs", "# nothing\n", "no blobs"),
        ("a.blobs", "0 0 0\n", "line 1: a blob has four to six numbers"),
        ("a.blobs", "0 0 0 1 1 1 1\n", "not 7"),
        ("a.blobs", "0 0 0 1\n\n0 0 0 -1\n", "line 3: the radius of a blob must be positive"),
        ("a.blobs", "0 0 0 one\n", "not a number"),
        ("a.blobs", "0 0 inf 1\n", "finite"),
        ("a.blobs", "0 0 0 1 1 2\n0 0 0 1\n", "line 2: this line names no group"),
        ("a.blobs", "0 0 0 1 1 0.5\n", "must be an integer"),
    ],
)
def test_what_cannot_be_read(tmp_path: Path, name: str, text: str, message: str) -> None:
    path = written(tmp_path, name, text)
    with pytest.raises(FileFormatError, match=message):
        read_molecule(path) if name == "a.txt" else read_geometry(path)


def test_metaballs_of_a_file(tmp_path: Path) -> None:
    text = "# a pair\n0 0 0 1\n1.5 0 0 0.8 -0.5 # carves\n"
    found = read_geometry(written(tmp_path, "a.blobs", text))
    assert isinstance(found, Metaballs)
    np.testing.assert_allclose(found.centers, [[0, 0, 0], [1.5, 0, 0]])
    np.testing.assert_allclose(found.radii, [1, 0.8])
    np.testing.assert_allclose(found.weights, [1, -0.5])
    assert found.groups is None
    grouped = read_geometry(written(tmp_path, "b.blobs", "0 0 0 1 1 7\n1 0 0 1 1 3\n"))
    assert isinstance(grouped, Metaballs)
    assert grouped.groups is not None
    assert grouped.groups.tolist() == [7, 3]
    with pytest.raises(FileFormatError, match="blobs only"):
        read_geometry(tmp_path / "b.blobs", "winding")


def test_opening_turns_the_axis_up(tmp_path: Path) -> None:
    opened = field_from_file(written(tmp_path, "a.blobs", "1 2 3 0.5\n"), up="x")
    assert isinstance(opened.field, Blobs)
    np.testing.assert_allclose(opened.field.centers, [[2, 3, 1]])
    opened = field_from_file(written(tmp_path, "a.pdb", pdb([("N", (1, 2, 3))])))
    assert isinstance(opened.field, Molecule)
    assert opened.field.describe()["atoms"] == 1
    assert opened.show == "shaded"


def test_drawn_from_the_command_line(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    written(tmp_path, "pair.blobs", "0 0 0 1\n1.5 0 0 1\n")
    assert main(["render", "pair.blobs", "--size", "32x24", "--spp", "1", "--quiet"]) == 0
    assert (tmp_path / "pair.png").stat().st_size > 200


def test_atoms_are_balls_of_their_radii() -> None:
    atoms = Atoms(np.zeros((1, 3)), np.array([1.7]), ("C",), "one atom")
    hits = hk.trace(hk.fields.Molecule(atoms), [[0, 0, -9.0]], [[0, 0, 1.0]], tolerance=1e-5)
    np.testing.assert_allclose(hits.t, 7.3, atol=1e-4)


def test_the_surface_is_that_of_gaussians_but_for_their_tails() -> None:
    """Where no atom ends, the sum differs from that of Gaussians by what was taken off."""
    rng = np.random.default_rng(0)
    positions = rng.uniform(0, 12, (200, 3))
    atoms = Atoms(positions, np.full(200, 1.7), ("C",) * 200, "some atoms")
    x = rng.uniform(0, 12, (500, 3))
    q = ((x[:, None] - positions) ** 2).sum(-1) / 1.7**2
    gaussians = np.exp(1 - q).sum(1)
    off = []
    for tail in (1 / 32, 1e-3, 1e-5):
        field = hk.fields.Molecule(atoms, tail=tail)
        value = field.value(x, precision="double")
        off.append((np.abs(value - gaussians) / gaussians)[gaussians > 0.5].max())
    assert 0.1 < off[0] < 0.6
    assert off[1] < 0.1
    assert off[2] < 0.003


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["single", pytest.param("double", marks=pytest.mark.slow)])
def test_a_helix_of_atoms(precision: Any) -> None:
    """First hits in a grid against a dense sum, and few looks."""
    turn = np.arange(400) * 0.35
    positions = np.column_stack([5 * np.cos(turn), 5 * np.sin(turn), 0.25 * turn])
    radii = np.where(np.arange(400) % 3 == 0, 1.52, 1.7)
    field = hk.fields.Molecule(Atoms(positions, radii, ("C",) * 400, "a helix"))
    assert "grid" in field.describe()
    rng = np.random.default_rng(1)
    o = rng.normal(size=(400, 3))
    o *= 60 / np.linalg.norm(o, axis=1)[:, None]
    d = positions[rng.integers(0, 400, 400)] + rng.uniform(-3, 3, (400, 3)) - o
    d /= np.linalg.norm(d, axis=1)[:, None]
    o, d = (one.astype(np.float32).astype(np.float64) for one in (o, d))
    hits = hk.trace(field, o, d, precision=precision, tolerance=hk.tracer.HitTolerance(1e-4))
    assert np.mean(hits.evaluations) < 7
    found = hits.status == hk.RayStatus.HIT
    assert 0.5 < found.mean() < 1
    end = np.where(found, np.nan_to_num(hits.t, posinf=0), 120.0)
    s = np.linspace(0, 1, 2500) * end[:, None]
    kernel = field.kernel
    for k in range(len(o)):
        x = o[k] + s[k][:, None] * d[k]
        x = x[(np.linalg.norm(x - positions.mean(0), axis=1) < 25) | (np.arange(2500) == 2499)]
        q = ((x[:, None] - positions) ** 2).sum(-1) / (radii * kernel.support) ** 2
        value = (kernel.amplitude * kernel.height(q)).sum(1)
        assert value.max() < 1 + 1e-3
        assert not found[k] or abs(value[-1] - 1) < 1e-3
