"""The shape of the code: which room may import from which, and how long things may get."""

from __future__ import annotations

import ast
import inspect
import re
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

from harnack.enclosures.selection import ENCLOSURE_NAMES, choose_enclosures

ROOT = Path(__file__).resolve().parents[2]
SOURCE = ROOT / "src" / "harnack"
FILES = sorted(SOURCE.rglob("*.py"))

# Each room imports from itself and from the rooms before it.
ROOMS = (
    "name_suggestions",
    "optional_packages",
    "progress",
    "backend",
    "webgpu",
    "geometry",
    "files",
    "cluster",
    "tree",
    "arithmetic",
    "tape",
    "enclosures",
    "fmm",
    "fields",
    "literature",
    "tracer",
    "distance",
    "meshing",
    "rendering",
    "inverse",
    "mesh_to_file",
    "field_from_file",
    "gallery",
    "live",
    "cli",
)
# Within `fields`: the interface, what families share, and the families.
FIELD_ROOMS = (
    "capabilities",
    "parameters",
    "operators",
    "batch_evaluation",
    "evaluator",
    "number_table",
    "attached_numbers",
    "attached_arrays",
    "field",
    "formula_evaluator",
    "vm_formulas",
    "batched_fields",
    "tape_evaluator",
    "formula",
    "clearance",
    "weights",
    "operands",
    "sum_jumps",
    "sum_extents",
    "sums",
    "products",
    "combining",
    "patch_boxes",
    "solid_angles",
    "analytic",
    "expressions",
    "solids",
    "blobs",
    "networks",
)
# Bases of `Field`, which answer with fields and so name them: in their types, or in their methods.
BASES = {
    "capabilities": ("evaluator", "field"),
    "operators": ("field", "combining"),
}
# Families do not know each other. A new one is added above and in docs/architecture.md.
FAMILIES = FIELD_ROOMS[FIELD_ROOMS.index("solid_angles") :]
# Modules at the top that only gather names of any rooms, for users; no room imports from them.
NAMESPACES = ("io", "kernels", "lattice", "math", "printing", "proofs", "solids")
# At the top: may import from any room.
FREE = ("__init__", "__main__", "testing", *NAMESPACES)


def room_of(parts: tuple[str, ...]) -> str:
    """The room of a dotted module name below harnack, given as its parts."""
    return parts[0] if parts else "__init__"


def imported_modules(tree: ast.Module, package: tuple[str, ...]) -> list[tuple[str, ...]]:
    """Modules below harnack that a file of `package` imports, at its top or within a function."""
    modules: list[tuple[str, ...]] = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            modules += [tuple(alias.name.split(".")) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            stem = tuple(node.module.split(".")) if node.module else ()
            if node.level:
                stem = package[: len(package) - node.level + 1] + stem
            # "from harnack import tracer" names a module behind "import".
            names = [(alias.name,) for alias in node.names] if stem == ("harnack",) else [()]
            modules += [stem + name for name in names]
    return [module[1:] for module in modules if module[:1] == ("harnack",)]


def misplaced_imports(path: Path, source: str) -> list[str]:
    """Imports of the file at `path` (relative to harnack) that go against the order of rooms."""
    parts = path.with_suffix("").parts
    room = room_of(parts)
    if room in FREE or room == "_version":
        return []
    if room not in ROOMS:
        return [f"{path} is in no known room: {', '.join(ROOMS)}"]
    package = ("harnack", *parts[:-1])
    wrong: list[str] = []
    for module in imported_modules(ast.parse(source), package):
        target = room_of(module)
        if target == "_version":
            continue
        if target not in ROOMS or ROOMS.index(target) > ROOMS.index(room):
            wrong.append(f"{path} imports harnack.{'.'.join(module)}")
    return wrong


@pytest.mark.few(5)
@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(SOURCE)))
def test_file_imports_from_earlier_rooms(path: Path) -> None:
    source = path.read_text(encoding="utf-8")
    assert misplaced_imports(path.relative_to(SOURCE), source) == []


@pytest.mark.parametrize("name", NAMESPACES)
def test_namespaces_define_nothing(name: str) -> None:
    docstring, *rest = ast.parse((SOURCE / f"{name}.py").read_text(encoding="utf-8")).body
    *imports, public = rest
    assert isinstance(docstring, ast.Expr)
    assert all(isinstance(statement, ast.ImportFrom) for statement in imports)
    assert isinstance(public, ast.Assign)
    assert [ast.unparse(target) for target in public.targets] == ["__all__"]
    imported = {
        alias.asname or alias.name
        for statement in imports
        if isinstance(statement, ast.ImportFrom) and statement.module != "__future__"
        for alias in statement.names
    }
    assert imported == set(ast.literal_eval(public.value))


def test_families_of_fields_do_not_know_each_other() -> None:
    wrong: list[str] = []
    for path in sorted((SOURCE / "fields").rglob("*.py")):
        parts = path.relative_to(SOURCE / "fields").with_suffix("").parts
        if parts == ("__init__",):
            continue
        room = parts[0]
        assert room in FIELD_ROOMS, f"fields/{room} is new: add it to FIELD_ROOMS, in order"
        for module in imported_modules(ast.parse(path.read_text(encoding="utf-8")), ("harnack",)):
            if module[:1] != ("fields",) or len(module) < 2:
                continue
            target = module[1]
            if target in BASES.get(room, ()):
                continue
            later = FIELD_ROOMS.index(target) > FIELD_ROOMS.index(room)
            if later or (target in FAMILIES and target != room):
                wrong.append(f"{path.name} imports harnack.{'.'.join(module)}")
    assert wrong == []


def test_nothing_imports_the_literature() -> None:
    """It is there for comparison. Its names are data in one table, from which it is imported when
    one of them is asked for."""
    others = [path for path in FILES if path.relative_to(SOURCE).parts[0] != "literature"]
    texts = {path: path.read_text(encoding="utf-8") for path in others}
    assert len(texts) < len(FILES)
    wrong = [
        f"{path.name} imports harnack.{'.'.join(module)}"
        for path, source in texts.items()
        for module in imported_modules(ast.parse(source), ("harnack",))
        if module[:1] == ("literature",)
    ]
    assert wrong == []
    table = SOURCE / "enclosures/selection.py"
    assert [path for path, source in texts.items() if "harnack.literature" in source] == [table]


def rendering_imports() -> dict[tuple[str, ...], set[tuple[str, ...]]]:
    """What each file of `rendering` imports from `rendering`, at its top or within a function."""
    room = SOURCE / "rendering"
    parts = {path: path.relative_to(room).with_suffix("").parts for path in room.rglob("*.py")}
    graph: dict[tuple[str, ...], set[tuple[str, ...]]] = {}
    for path, name in parts.items():
        if name[-1] == "__init__":
            continue
        graph[name] = set()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom):
                assert node.level == 0, "imports are absolute"
                stem = tuple((node.module or "").split("."))
                modules = [(*stem, alias.name) for alias in node.names] + [stem]
            elif isinstance(node, ast.Import):
                modules = [tuple(alias.name.split(".")) for alias in node.names]
            else:
                continue
            inside = {module[2:] for module in modules if module[:2] == ("harnack", "rendering")}
            graph[name] |= inside & set(parts.values())
    return graph


def test_files_of_rendering_import_each_other_in_one_direction() -> None:
    graph = rendering_imports()
    assert len(graph) > 20
    TopologicalSorter(graph).prepare()  # raises CycleError


def test_modules_have_names_that_say_something() -> None:
    vague = {"utils", "util", "helpers", "misc", "common"}
    names = {part for path in FILES for part in path.relative_to(SOURCE).with_suffix("").parts}
    assert names & vague == set()


def test_package_imports_backend_before_anything_that_may_load_drjit() -> None:
    tree = ast.parse((SOURCE / "__init__.py").read_text(encoding="utf-8"))
    harmless = {("_version",)}
    rooms = [module for module in imported_modules(tree, ("harnack",)) if module not in harmless]
    assert rooms[0][0] == "backend"


@pytest.mark.parametrize(
    ("path", "source", "wrong"),
    [
        ("enclosures/slope.py", "from harnack.geometry import Ball", False),
        ("enclosures/slope.py", "from harnack.enclosures.free_radius import newton", False),
        ("enclosures/slope.py", "import numpy, harnack.backend", False),
        ("enclosures/slope.py", "from harnack._version import __version__", False),
        ("enclosures/slope.py", "import harnack.tracer", True),
        ("enclosures/slope.py", "from harnack import tracer", True),
        ("enclosures/slope.py", "from .. import tracer", True),
        ("enclosures/slope.py", "from ..tracer import march", True),
        ("enclosures/slope.py", "from ..tree import packed", False),
        ("enclosures/slope.py", "from . import solve", False),
        ("enclosures/slope.py", "def f():\n    from harnack.cli import main", True),
        ("enclosures/slope.py", "from harnack.testing import check_bound", True),
        ("tracer.py", "from harnack.cli import main", True),
        ("tracer.py", "from . import enclosures", False),
        ("testing.py", "import harnack.cli", False),
        ("__init__.py", "import harnack.cli", False),
        ("solids.py", "from harnack.fields.solids import Solid", False),
        ("math.py", "import harnack.arithmetic", False),
        ("cli/main.py", "from harnack.solids import Sphere", True),
        ("live/session.py", "from harnack.rendering import Camera", False),
        ("misc/thing.py", "", True),
    ],
)
def test_the_order_of_rooms_is_seen(path: str, source: str, wrong: bool) -> None:
    assert bool(misplaced_imports(Path(path), source)) == wrong


def test_every_name_of_enclosures_is_explained() -> None:
    docstring = inspect.getdoc(choose_enclosures) or ""
    guide = (ROOT / "docs/proofs.md").read_text(encoding="utf-8")
    names = [f'"{name}"' for name in ENCLOSURE_NAMES]
    assert [name for name in names if name not in docstring or f"`{name}`" not in guide] == []


def test_names_and_files_in_contributing_exist() -> None:
    """Files in backquotes are there, and define what is said to be in them."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    found = {
        name: path
        for name in re.findall(r"`([\w./]+\.(?:pyi?|md))`", text)
        for folder in (ROOT, SOURCE, SOURCE.parent, ROOT / "scripts/site")
        if (path := folder / name).exists()
    }
    assert set(re.findall(r"`([\w/]+/[\w.]+\.pyi?)`", text)) <= set(found)
    pairs = re.findall(r"`(\w+)`[^`.;]{0,30}?\s(?:in|of)\s+`([\w./]+\.py)`", text)
    absent = [
        (name, file)
        for name, file in pairs
        if not re.search(
            rf"(?m)^\s*(?:def |class )?{name}\b *[:(=]", found[file].read_text("utf-8")
        )
    ]
    assert absent == []
