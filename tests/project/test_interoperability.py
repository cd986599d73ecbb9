"""The code of `docs/interoperability` runs, and what it makes is right. `make test-interop`
installs the tools and runs this: a tool that is missing is a failure, and nothing is skipped, but
for Blender under versions of Python for which it has no wheel."""

from __future__ import annotations

import os
import subprocess
import sys
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.project.test_readme import ROOT, blocks_of

pytestmark = pytest.mark.interop

# Those for which the Makefile has a version.
BLENDER_PYTHONS = {(3, 11), (3, 13)}
PAGES = ROOT / "docs" / "interoperability"
Variables = dict[str, Any]


@dataclass(frozen=True)
class Example:
    """A block of code on a page, and what must be true after it.

    check: takes the variables of the block; files are in the working folder. It is called in the
        process that ran the block, since windows and servers end with it.
    last_line: the end of the block, which the check runs itself.
    """

    page: str
    number: int
    check: Callable[[Variables], None]
    last_line: str = ""

    def __str__(self) -> str:
        return f"{self.page}-{self.number}"

    @property
    def code(self) -> str:
        block = blocks_of(PAGES / f"{self.page}.md")[self.number]
        assert block.endswith(self.last_line)
        return block.removesuffix(self.last_line)

    def run(self) -> None:
        """Run the block as a script would be run, then the check."""
        variables: Variables = {"__name__": "__main__"}
        exec(compile(self.code, str(self), "exec"), variables)
        self.check(variables)


def picture(path: str) -> np.ndarray:
    """The pixels (h, w, 3) of a picture, in [0, 1]."""
    from PIL import Image

    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"), np.float64) / 255


def check_shows_object(path: str, *, is_colored: bool = False) -> np.ndarray:
    """Check that a picture is of an object in its middle, and return the object's colors (k, 3).

    is_colored: whether the object is told from its background by not being gray; else by not having
        the color of the picture's corner.
    """
    pixels = picture(path)
    assert pixels.shape == (360, 480, 3)
    if is_colored:
        is_object = np.ptp(pixels, axis=2) > 0.04
    else:
        is_object = np.abs(pixels - pixels[0, 0]).max(axis=2) > 0.1
    assert 0.1 < is_object.mean() < 0.5
    assert is_object[120:240, 200:280].mean() > 0.8
    assert not is_object[:10].any()
    assert pixels[is_object].std(axis=0).max() > 0.05  # it is shaded, not a spot
    return pixels[is_object]


def check_two_curvatures(colors: np.ndarray) -> None:
    """Check that among colors (k, 3) of a diverging map both ends show: the sphere is convex (red),
    and the groove is concave (blue)."""
    excess = colors[:, 0] - colors[:, 2]
    assert (excess > 0.1).mean() > 0.2
    assert (excess < -0.1).mean() > 0.02


def check_grooved_ball(vertices: Any, faces: Any) -> None:
    """Check that a mesh is the ball of radius 1 with a groove, of which the pages are."""
    import trimesh

    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.is_watertight
    # Most of a torus of volume 2 pi^2 0.8 0.3^2 is inside of the ball, and is taken away.
    ball, torus = 4 / 3 * np.pi, 2 * np.pi**2 * 0.8 * 0.3**2
    assert ball - torus < mesh.volume < ball - 0.8 * torus
    from_center, from_circle = distances_of_grooved_ball(mesh.vertices)
    assert from_center.max() < 1 + 1e-5
    away = np.minimum(np.abs(from_center - 1), np.abs(from_circle - 0.3))
    assert away.max() < 5e-3  # The tolerance is 1e-2.


def distances_of_grooved_ball(vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The distances (n,) of vertices (n, 3) from the center of the ball, 1 on the sphere, and from
    the circle in the middle of the groove, 0.3 in the groove."""
    x, y, z = np.asarray(vertices).T
    return np.sqrt(x * x + y * y + z * z), np.hypot(np.hypot(x, y) - 0.8, z)


def check_curvature(vertices: Any, curvature: Any) -> None:
    """Check the mean curvature (n,) at vertices (n, 3) of the grooved ball: 1 on the sphere, and in
    the groove that of a torus seen from inside."""
    from_center, from_circle = distances_of_grooved_ball(vertices)
    off_sphere, off_groove = np.abs(from_center - 1), np.abs(from_circle - 0.3)
    # (At the crease both have a curvature.)
    in_groove = (off_groove < 1e-5) & (off_sphere > 1e-2)
    on_sphere = (off_sphere < 1e-5) & (off_groove > 1e-2)
    assert in_groove.mean() > 0.2
    assert on_sphere.mean() > 0.15
    radius = np.hypot(*np.asarray(vertices)[in_groove, :2].T)
    expected = -0.5 * (1 / 0.3 + (radius - 0.8) / 0.3 / radius)
    np.testing.assert_allclose(np.asarray(curvature)[in_groove], expected, atol=1e-4)
    np.testing.assert_allclose(np.asarray(curvature)[on_sphere], 1, atol=1e-4)


# arrays


def check_saved_hits(page: Variables) -> None:
    hits, saved = page["hits"], np.load("hits.npz")
    assert set(saved) == set(vars(hits))
    for name in saved:
        np.testing.assert_array_equal(saved[name], getattr(hits, name))
    radius = np.hypot(page["x"], page["y"])
    is_clear = np.abs(np.abs(radius - 0.7) - 0.25) > 1e-3
    assert ((np.abs(radius - 0.7) < 0.25) == hits.is_hit)[is_clear].all()
    heights = np.sqrt(np.maximum(0.25**2 - (radius - 0.7) ** 2, 0))[hits.is_hit]
    np.testing.assert_allclose(page["heights"], heights, atol=0.02)


def check_dlpack(page: Variables) -> None:
    from drjit.llvm.ad import Array3f

    import harnack as hk

    np.testing.assert_allclose(page["t"], [1.75, 1.75, np.inf], atol=1e-3)
    assert page["hit"].tolist() == [True, True, False]
    rows = [[0.7, 0, 0.25], [0, 0.7, 0.25]]
    np.testing.assert_allclose(page["position"][:2], rows, atol=1e-3)
    for name in ("t", "position"):
        again = np.from_dlpack(getattr(page["hits"], name))
        assert np.shares_memory(page[name], again)
    rays = Array3f(page["origins"].T), Array3f(0, 0, -1)
    position = hk.trace(hk.Torus(0.7, 0.25), *rays).position
    columns = np.from_dlpack(position)
    np.testing.assert_array_equal(columns.T, page["position"])
    assert not np.shares_memory(columns, np.from_dlpack(position))


# trimesh


def check_colored_file(page: Variables) -> None:
    import trimesh

    check_grooved_ball(page["mesh"].vertices, page["mesh"].faces)
    check_curvature(page["mesh"].vertices, page["curvature"])
    read = trimesh.load("part.glb", force="mesh")
    np.testing.assert_allclose(read.vertices, page["mesh"].vertices, atol=1e-6)
    colors = read.visual.vertex_colors
    np.testing.assert_array_equal(colors, page["mesh"].visual.vertex_colors)
    assert len(np.unique(colors, axis=0)) > 10


def check_pierced_box(page: Variables) -> None:
    assert page["hits"].is_hit.tolist() == [False, True]
    assert page["hits"].t[1] == pytest.approx(2.5, abs=2e-3)


# PyVista


def check_pyvista_plot(page: Variables) -> None:
    import pyvista as pv

    mesh = page["mesh"]
    check_grooved_ball(page["shown"].points, page["shown"].regular_faces)
    check_curvature(page["shown"].points, page["shown"]["mean curvature"])
    with warnings.catch_warnings(record=True) as caught:
        wrapped = pv.wrap(mesh)
    # Of PyVista 0.49, which reads metadata; older versions do not.
    assert all("metadata key 'harnack'" in str(warning.message) for warning in caught)
    for shown in (page["shown"], wrapped):
        np.testing.assert_array_equal(shown.points, mesh.vertices)
        np.testing.assert_array_equal(shown.regular_faces, mesh.faces)
    check_two_curvatures(check_shows_object("pyvista.png"))


def check_grid(page: Variables) -> None:
    grid, field = page["grid"], page["field"]
    x, y, z = grid.points.T
    np.testing.assert_allclose(grid["f"], field.value(grid.points))
    assert grid["gradient"].shape == (41**3, 3)
    # Homogeneous of degree 3: Euler's relation.
    euler = x * grid["gradient"][:, 0] + y * grid["gradient"][:, 1] + z * grid["gradient"][:, 2]
    np.testing.assert_allclose(euler, 3 * grid["f"], atol=1e-5)
    assert grid["f"].max() > 0.1
    assert sum(part.n_points for part in page["slices"]) == 3 * 41**2
    contour = grid.contour([0.1], scalars="f")
    np.testing.assert_allclose(field.value(contour.points), 0.1, atol=0.02)


def check_mesh_from_pyvista(page: Variables) -> None:
    mesh = page["rounded"]
    assert mesh.is_watertight
    np.testing.assert_allclose(mesh.bounds, [[-1, -0.5, -0.5], [1, 0.5, 0.5]], atol=0.02)


# Polyscope


def check_polyscope_picture(page: Variables) -> None:
    check_grooved_ball(page["mesh"].vertices, page["mesh"].faces)
    check_curvature(page["mesh"].vertices, page["curvature"])
    shown = page["shown"]
    assert shown.n_vertices() == len(page["mesh"].vertices)
    assert shown.n_faces() == len(page["mesh"].faces)
    check_two_curvatures(check_shows_object("polyscope.png", is_colored=True))


# Open3D


def check_cloud(page: Variables) -> None:
    mesh, back, points = page["mesh"], page["back"], page["points"]
    normals = np.asarray(page["cloud"].normals)
    assert (normals * points).sum(axis=1).min() > 0.9
    np.testing.assert_array_equal(np.asarray(back.vertices), mesh.vertices)
    np.testing.assert_array_equal(np.asarray(back.triangles), mesh.faces)
    assert back.is_watertight()
    assert back.get_volume() == pytest.approx(4 / 3 * np.pi, rel=0.03)


def check_torus_of_open3d(page: Variables) -> None:
    import harnack as hk

    distance = hk.signed_distance(page["solid"], [[1.0, 0, 0], [0, 0, 0], [1.0, 0, 0.8]])
    np.testing.assert_allclose(distance, [-0.3, 0.7, 0.5], atol=0.03)


# meshio


def check_vtu(page: Variables) -> None:
    mesh, read = page["mesh"], page["read"]
    np.testing.assert_array_equal(read.points, mesh.vertices)
    np.testing.assert_array_equal(read.cells_dict["triangle"], mesh.faces)
    np.testing.assert_array_equal(read.point_data["mean curvature"], page["curvature"])
    check_grooved_ball(page["solid"].vertices, page["solid"].faces)
    check_curvature(page["mesh"].vertices, page["curvature"])


# viser


def check_server(page: Variables) -> None:
    """The page still lacks its last line, which stops the server."""
    import urllib.error
    import urllib.request

    server, level = page["server"], page["level"]
    address = f"http://127.0.0.1:{server.get_port()}"
    with urllib.request.urlopen(address, timeout=5) as answer:
        assert b"<html" in answer.read()
    check_gyroid(server, 0.0)
    level.value = 0.5
    check_gyroid(server, 0.5)
    server.stop()
    with pytest.raises(urllib.error.URLError, match="refused"):
        urllib.request.urlopen(address, timeout=5)


def check_gyroid(server: Any, level: float) -> None:
    """Check that the mesh that a server of viser shows is the gyroid's level set."""
    shown = server.scene.get_handle_by_name("/gyroid")
    vertices = np.asarray(shown.vertices)
    x, y, z = (2 * np.pi * vertices).T
    values = np.sin(x) * np.cos(y) + np.sin(y) * np.cos(z) + np.sin(z) * np.cos(x)
    # |grad f| is up to 11; on the faces of the box vertices are within the tolerance of 0.03.
    assert np.abs(values - level).max() < 0.3
    assert np.median(np.abs(values - level)) < 1e-3
    np.testing.assert_allclose(np.abs(vertices).max(axis=0), 1, atol=1e-2)
    assert np.asarray(shown.faces).max() == len(vertices) - 1


# Blender


def check_blender_picture(_: Variables) -> None:
    colors = check_shows_object("blender.png")
    assert (colors[:, 0] >= colors[:, 2]).all()  # clay is reddish
    assert (colors[:, 0] - colors[:, 2] > 0.1).mean() > 0.5


EXAMPLES = [
    Example("arrays", 0, check_saved_hits),
    Example("arrays", 1, check_dlpack),
    Example("trimesh", 0, check_colored_file),
    Example("trimesh", 1, check_pierced_box),
    Example("pyvista", 0, check_pyvista_plot),
    Example("pyvista", 1, check_grid),
    Example("pyvista", 2, check_mesh_from_pyvista),
    Example("polyscope", 0, check_polyscope_picture),
    Example("open3d", 0, check_cloud),
    Example("open3d", 1, check_torus_of_open3d),
    Example("meshio", 0, check_vtu),
    Example("viser", 0, check_server, last_line="server.stop()\n"),
]


def run_in_folder(folder: Path, python: Path, *arguments: str) -> None:
    """Run Python in a folder; a nonzero exit code is a failure that shows what it wrote."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT / "src"), str(ROOT)])}
    run = subprocess.run(
        [str(python), *arguments],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
        env=environment,
    )
    assert run.returncode == 0, run.stdout + run.stderr


@pytest.mark.parametrize("number", range(len(EXAMPLES)), ids=map(str, EXAMPLES))
def test_code_makes_what_the_page_says(number: int, tmp_path: Path) -> None:
    code = f"from {__name__} import EXAMPLES; EXAMPLES[{number}].run()"
    run_in_folder(tmp_path, Path(sys.executable), "-c", code)


@pytest.mark.skipif(
    sys.version_info[:2] not in BLENDER_PYTHONS, reason="Blender has no wheel for this Python"
)
def test_blender_renders_the_mesh(tmp_path: Path) -> None:
    writing, rendering = blocks_of(PAGES / "blender.md")
    run_in_folder(tmp_path, Path(sys.executable), "-c", writing)
    run_in_folder(tmp_path, ROOT / ".venv" / "blender" / "bin" / "python", "-c", rendering)
    variables: Variables = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path)
        check_blender_picture(variables)


# Code that defines a function `draw`, which draws something into a file.
DRAWING = {
    "polyscope": """
import polyscope as ps
ps.set_allow_headless_backends(True)
ps.init()
ps.register_surface_mesh("triangle", [(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 1, 2)])
def draw(name):
    ps.screenshot(name)
""",
    "pyvista": """
import pyvista as pv
def draw(name):
    plotter = pv.Plotter(off_screen=True)
    plotter.add_mesh(pv.Sphere())
    plotter.screenshot(name)
""",
}


@pytest.mark.parametrize("tool", DRAWING)
def test_tools_may_draw_before_harnack_is_imported(tool: str, tmp_path: Path) -> None:
    """They load the LLVM of Mesa's driver, which is another one than Dr.Jit's."""
    code = f"""
{DRAWING[tool]}
draw("before.png")
import harnack as hk
hits = hk.trace(hk.Sphere(0.5) - hk.Torus(0.4, 0.1), [[0, 0, 2.0]], [[0, 0, -1.0]])
assert abs(hits.t[0] - 1.5) < 1e-3
draw("after.png")
"""
    run_in_folder(tmp_path, Path(sys.executable), "-c", code)
    pixels = [picture(str(tmp_path / f"{name}.png")) for name in ("before", "after")]
    assert pixels[0].std() > 0.01
    np.testing.assert_allclose(*pixels, atol=0.02)


def test_every_block_is_run() -> None:
    """`tests/backend/test_frameworks.py` runs the last one of arrays."""
    counts = {page.stem: len(blocks_of(page)) for page in PAGES.glob("*.md")}
    assert counts.pop("index") == 0
    numbers = {page: {e.number for e in EXAMPLES if e.page == page} for page in counts}
    assert numbers.pop("blender") == set()
    assert counts.pop("blender") == 2
    assert numbers.pop("arrays") == {0, 1}
    assert counts.pop("arrays") == 3
    assert numbers == {page: set(range(count)) for page, count in counts.items()}
