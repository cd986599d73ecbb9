"""`render`: files, modes, settings, determinism, and errors before any work."""

from __future__ import annotations

import functools
import math
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import harnack as hk
from harnack.geometry import example_curves
from harnack.rendering import MATERIALS, SHOW_MODES, Camera, Material, picture, register, render
from harnack.rendering.images import exr_bytes, tone_map
from harnack.rendering.light_paths import PathRenderTask
from harnack.rendering.scales import viridis
from harnack.rendering.stage import stage_placement
from harnack.tracer import traced_surface

mi = register()
SMALL: dict[str, Any] = {"size": (40, 30), "progress": False}
POLYGON = hk.SolidAngle(example_curves.wavy_polygon(24))
GYROID = hk.Gyroid(1.0, domain=hk.Ball(radius=1.0))


def draw(what: Any = POLYGON, path: Any = None, **settings: Any) -> np.ndarray:
    return render(what, path, **{**SMALL, "spp": 4, **settings})


def read(path: Path) -> np.ndarray:
    return np.array(mi.Bitmap(str(path)))


@pytest.mark.slow
def test_a_png_and_an_exr_are_written(tmp_path: Path) -> None:
    image = draw(path=tmp_path / "a.png")
    assert image.shape == (30, 40, 3)
    assert image.dtype == np.float32
    assert np.isfinite(image).all()
    np.testing.assert_array_equal(read(tmp_path / "a.png"), tone_map(image))
    draw(path=tmp_path / "a.exr")
    assert (tmp_path / "a.exr").read_bytes() == exr_bytes(image)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.exr", "a.png"]


@pytest.mark.few(1)
@pytest.mark.parametrize("shape", [(30, 40, 3), (33, 7), (16, 16, 3), (1, 1)])
def test_exr_files_hold_what_was_written(shape: tuple[int, ...], tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    images = {"noise": rng.normal(size=shape), "steps": np.round(rng.random(shape))}
    images["steps"].flat[0] = np.inf
    for name, image in images.items():
        (tmp_path / f"{name}.exr").write_bytes(exr_bytes(image))
        np.save(tmp_path / f"{name}.npy", image.astype(np.float32).reshape(*shape[:2], -1))
    # Mitsuba's reader waits for ever where Dr.Jit has one thread.
    code = f"""
import harnack, drjit, numpy, mitsuba
drjit.set_thread_count(2)
mitsuba.set_variant("llvm_ad_rgb")
for name in ("noise", "steps"):
    stem = {str(tmp_path)!r} + "/" + name
    image = numpy.array(mitsuba.Bitmap(stem + ".exr"))
    expected = numpy.load(stem + ".npy")
    same = (image.reshape(expected.shape) == expected).all()
    assert same, name
print(True)
"""
    assert in_a_new_process(code) == "True"
    assert len((tmp_path / "steps.exr").read_bytes()) < len(
        (tmp_path / "noise.exr").read_bytes()
    ) or shape == (1, 1)


@pytest.mark.slow
def test_the_same_seed_draws_the_same_picture() -> None:
    first = draw(seed=3)
    np.testing.assert_array_equal(first, draw(seed=3))
    other = draw(seed=4)
    assert not np.array_equal(first, other)
    assert first.mean() == pytest.approx(other.mean(), rel=0.03)


@pytest.mark.slow
def test_bands_leave_no_seam(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = draw(spp=64)
    narrow = functools.partial(PathRenderTask, paths_a_band=64 * 50)
    monkeypatch.setattr("harnack.rendering.render_job.PathRenderTask", narrow)
    bands = draw(spp=64)
    np.testing.assert_array_equal(whole, bands)


@pytest.mark.few(1)
@pytest.mark.parametrize("show", SHOW_MODES)
def test_every_mode_makes_numbers_and_a_picture(show: str, tmp_path: Path) -> None:
    image = draw(path=tmp_path / "a.png", show=show, color_by="x" if show == "value" else None)
    assert image.shape[:2] == (30, 40)
    drawn = read(tmp_path / "a.png")
    assert drawn.shape == (30, 40, 3)
    assert drawn.std() > 5


def test_modes_agree_with_each_other() -> None:
    status, depth = draw(show="status"), draw(show="depth")
    normal, evaluations = draw(show="normal"), draw(show="evaluations")
    hit = status == hk.RayStatus.HIT
    assert 0.2 < hit.mean() < 0.8
    assert (status[~hit] == hk.RayStatus.MISS).all()
    np.testing.assert_array_equal(np.isfinite(depth), hit)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=-1)[hit], 1, atol=1e-5)
    assert (normal[~hit] == 0).all()
    assert evaluations.dtype.kind == "i"
    assert (evaluations[hit] >= 2).all()
    assert (evaluations[0] == 0).any()  # a ray that misses the hull costs nothing


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_pictures_of_large_and_small_surfaces_are_alike(scale: float) -> None:
    field = hk.SolidAngle(scale * example_curves.wavy_polygon(24))
    depth = draw(field, show="depth") / scale
    reference = draw(show="depth")
    hit = np.isfinite(depth) & np.isfinite(reference)
    assert (np.isfinite(depth) != np.isfinite(reference)).mean() < 0.01
    np.testing.assert_allclose(depth[hit], reference[hit], rtol=2e-3)


@pytest.mark.slow
def test_out_of_steps_is_never_background(tmp_path: Path) -> None:
    status = draw(path=tmp_path / "a.png", show="status", max_steps=4)
    lost = status == hk.RayStatus.OUT_OF_STEPS
    assert lost.sum() > 20
    assert (read(tmp_path / "a.png")[lost] == (255, 0, 255)).all()
    with pytest.warns(UserWarning, match=r"\d+ light paths ran out of steps"):
        image = draw(max_steps=4, tolerance=1e-4)
    assert image[lost].mean(axis=0)[1] < 0.5 * image[lost].mean(axis=0)[0]


def test_nothing_is_lost_and_nothing_is_said_with_enough_steps() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        draw()


@pytest.mark.slow
def test_a_surface_is_drawn_as_its_field_with_keywords() -> None:
    near = hk.TraceOptions(tolerance=1e-3)
    surface = hk.Surface(POLYGON, 2.5 * math.pi).replace(level=math.pi)
    drawn = draw([surface], show="depth", options=near)
    np.testing.assert_array_equal(drawn, draw(POLYGON, show="depth", level=math.pi, tolerance=1e-3))
    solid = hk.Surface(GYROID, level=(-0.3, 0.3), side="between")
    half = hk.HalfSpace((0, 0, 1), 0.0)
    clipped = draw(solid.replace(clip=half), show="depth")
    expected = draw(GYROID, show="depth", level=(-0.3, 0.3), side="between", clip=half)
    np.testing.assert_array_equal(clipped, expected)
    assert not np.array_equal(clipped, draw(solid, show="depth"))
    with pytest.raises(TypeError, match=r"a Surface holds its own; .*surface\.replace\(clip="):
        draw(solid, show="depth", clip=half)
    with pytest.raises(TypeError, match=r"there are options already; .*options\.replace\(tol"):
        draw(solid, show="depth", options=near, tolerance=1e-3)


@pytest.mark.few(1)
@pytest.mark.parametrize("name", MATERIALS)
def test_every_material_draws(name: str) -> None:
    image = draw(GYROID, material=name, level=(-0.3, 0.3), side="between")
    assert np.isfinite(image).all()
    assert 0.1 < image.mean() < 1.2


@pytest.mark.slow
def test_materials_are_told_apart_and_one_may_be_given_for_each_surface() -> None:
    pair = [hk.Surface(GYROID, level) for level in (-0.5, 0.5)]
    gold, mixed = draw(pair, material="gold"), draw(pair, material=["gold", "porcelain"])
    assert np.abs(gold - mixed).mean() > 0.01
    red, same = draw(pair, material="red"), draw(pair, material=(1, 0, 0))
    np.testing.assert_array_equal(red, same)
    np.testing.assert_array_equal(red, draw(pair, material="#f00"))
    np.testing.assert_array_equal(gold, draw(pair, material="Gold"))
    assert (red[..., 0] > 2 * red[..., 2]).mean() > 0.1
    black = draw(pair, material="black", show="shaded", backdrop="white")
    assert 0.02 < black[black.max(axis=-1) < 0.9].mean() < 0.3
    own = draw(pair, material=Material({"type": "diffuse"}))
    dictionary = draw(pair, material={"type": "twosided", "nested": {"type": "diffuse"}})
    np.testing.assert_allclose(own, dictionary, atol=1e-6)


@pytest.mark.slow
def test_levels_of_one_field_may_have_materials_of_their_own() -> None:
    levels, names = [-0.5, 0.5], ["red", "blue"]
    one = draw(GYROID, level=levels, material=names, show="shaded", tolerance=1e-4)
    pair = [traced_surface(GYROID, level=level, tolerance=1e-4) for level in levels]
    np.testing.assert_array_equal(one, draw(pair, material=names, show="shaded"))
    with pytest.raises(ValueError, match=r"a surface is drawn twice.*a Surface for each level"):
        draw([GYROID, GYROID], level=levels, material=names)
    turn = POLYGON.period
    with pytest.raises(ValueError, match="a surface is drawn twice"):
        draw(POLYGON, level=[1.0, 1.0 + turn], material=names)
    with pytest.raises(ValueError, match="give one material, not 0"):
        draw(GYROID, material=[])
    array = draw(GYROID, level=np.array(levels), material=names, show="shaded", tolerance=1e-4)
    np.testing.assert_array_equal(one, array)
    with pytest.raises(ValueError, match="give one material or 2, one for each level, not 3"):
        draw(GYROID, level=levels, material=["red", "blue", "gold"])


@pytest.mark.slow
def test_parts_of_one_surface_may_be_drawn_as_several() -> None:
    halves = [hk.Box((0, -1, -1), (1, 1, 1)), hk.Box((-1, -1, -1), (0, 1, 1))]
    parts = [hk.Surface(hk.Sphere(0.9), clip=half) for half in halves]
    image = draw(parts, material=["red", "blue"], show="shaded")
    assert (image[..., 0] > 2 * image[..., 2]).any()
    assert (image[..., 2] > 2 * image[..., 0]).any()


@pytest.mark.slow
def test_tubes_around_boundaries_have_a_material() -> None:
    gold = draw(POLYGON, boundary_radius=0.1, show="shaded")
    same = draw(POLYGON, boundary_radius=0.1, boundary_material="gold", show="shaded")
    np.testing.assert_array_equal(gold, same)
    blue = draw(POLYGON, boundary_radius=0.1, boundary_material="blue", show="shaded")
    assert ((blue[..., 2] > 2 * blue[..., 0]) & (gold[..., 0] > gold[..., 2])).mean() > 0.005
    with pytest.raises(ValueError, match="boundary_material: tubes have no inside"):
        draw(POLYGON, boundary_radius=np.float32(0.1), boundary_material="glass")
    with pytest.raises(ValueError, match="boundary_material needs the radius of the tubes"):
        draw(POLYGON, boundary_material="gold")


@pytest.mark.slow
def test_camera_and_backdrop_change_the_picture() -> None:
    default = draw()
    assert np.abs(default - draw(camera=Camera(azimuth=10))).mean() > 0.02
    assert draw(backdrop="dark").mean() < 0.7 * default.mean()


@pytest.mark.few(1)
@pytest.mark.parametrize("size", [(60, 20), (20, 60), (40, 40)])
@pytest.mark.parametrize("elevation", [-30.0, 0.0, 35.0, 90.0])
def test_the_camera_frames_the_surface(size: tuple[int, int], elevation: float) -> None:
    camera = Camera(azimuth=25.0, elevation=elevation)
    hit = draw(show="status", size=size, camera=camera) == hk.RayStatus.HIT
    edge = np.concatenate([hit[0], hit[-1], hit[:, 0], hit[:, -1]])
    assert not edge.any()
    filled = max(hit.any(axis=0).mean(), hit.any(axis=1).mean())
    assert 0.7 < filled <= 0.95
    closer = draw(show="status", size=size, camera=Camera(25.0, elevation, zoom=1.5))
    assert (closer == hk.RayStatus.HIT).sum() > hit.sum()


def test_surfaces_stand_on_the_ground() -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform((5, -3, 2), (9, -2, 3), (100, 3))
    stage = stage_placement(points).apply(points)
    assert stage[:, 2].min() == pytest.approx(0, abs=1e-12)
    extent = stage.max(axis=0) - stage.min(axis=0)
    assert np.linalg.norm(extent) == pytest.approx(2)
    assert np.abs(stage.max(axis=0) + stage.min(axis=0))[:2].max() < 1e-12


@pytest.mark.parametrize(
    ("settings", "word"),
    [
        ({"path": "a.jpg"}, r"\.png or \.exr"),
        ({"path": "nowhere/a.png"}, "create the folder"),
        ({"show": "rainbow"}, "show must be one of"),
        ({"size": (0, 3)}, "size must be"),
        ({"spp": 0}, "spp must be"),
        ({"material": "cheese"}, "unknown material 'cheese'"),
        ({"material": ["gold", "gold"]}, "one material"),
        ({"backdrop": "plaid"}, "backdrop must be"),
        ({"level": math.nan}, "finite"),
        ({"what": []}, "nothing to draw"),
        ({"what": [3]}, "what is drawn are fields"),
        ({"what": 3}, "draw a field"),
        ({"what": {"type": "scene"}}, "no sensor"),
        ({"what": {"type": "scene"}, "level": 3.0}, "as it is"),
        ({"what": hk.Surface(POLYGON, clip=hk.Ball((9, 9, 9), 0.1))}, "nothing is to be seen"),
        ({"what": hk.Surface(POLYGON, 0.0)}, "infinity"),
        ({"material": "glass"}, "needs an inside"),
    ],
)
def test_errors_come_early_and_say_what_to_do(settings: dict[str, Any], word: str) -> None:
    with pytest.raises((ValueError, TypeError, FileNotFoundError), match=word):
        draw(**settings)


@pytest.mark.parametrize("values", [{"fov": 0}, {"zoom": -1.0}, {"elevation": 100.0}])
def test_cameras_that_cannot_be_are_refused(values: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(values))):
        Camera(**values)


def test_ctrl_c_leaves_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.png").write_bytes(b"old")

    def interrupted(exposing: Any, advance: Any, hands: Any) -> Any:
        del exposing, hands
        advance(0.5)
        raise KeyboardInterrupt

    monkeypatch.setattr(picture, "render_paths", interrupted)
    with pytest.raises(KeyboardInterrupt):
        draw(path=tmp_path / "a.png", progress=True)
    assert [p.name for p in tmp_path.iterdir()] == ["a.png"]
    assert (tmp_path / "a.png").read_bytes() == b"old"


def test_tone_mapping_keeps_order_and_range() -> None:
    x = np.linspace(0, 8, 500, dtype=np.float32)
    mapped = tone_map(x)
    assert mapped[0] == 0
    assert mapped[-1] == 255
    assert (np.diff(mapped.astype(int)) >= 0).all()
    assert tone_map(np.array([0.21586], np.float32))[0] == 128  # sRGB's middle gray
    assert tone_map(np.array([np.nan], np.float32))[0] == 0


def test_viridis_is_viridis() -> None:
    x = np.linspace(0, 1, 64).reshape(8, 8)
    colors = viridis(x)
    assert colors.shape == (8, 8, 3)
    np.testing.assert_allclose(colors[0, 0], (0.267, 0.005, 0.329), atol=0.02)
    np.testing.assert_allclose(colors[-1, -1], (0.993, 0.906, 0.144), atol=0.02)
    luminance = (colors @ (0.2126, 0.7152, 0.0722)).ravel()
    assert (np.diff(luminance) > 0).all()


def in_a_new_process(code: str) -> str:
    run = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=300
    )
    assert run.returncode == 0, run.stderr
    return run.stdout.strip().splitlines()[-1].removeprefix("\x1b[0m")  # Mitsuba's colors


@pytest.mark.slow
def test_large_libraries_are_imported_where_they_are_used() -> None:
    code = """
import sys, harnack, harnack.cli
harnack.trace, harnack.mesh, harnack.render, harnack.files, harnack.distance
large = {"dask", "gemmi", "manifold3d", "matplotlib", "mitsuba", "PIL", "scipy", "trimesh"}
print(sorted(large & set(sys.modules)))
"""
    assert in_a_new_process(code) == "[]"


@pytest.mark.slow
def test_pictures_import_what_they_need() -> None:
    code = """
import sys, harnack as hk
hk.render(hk.Sphere(), size=(8, 6), show="shaded")
parts = {"harnack.meshing.mesh_pipeline", "harnack.files.geometry_files", "harnack.webgpu"}
print(sorted({"asyncio", "rich", "scipy", *parts} & set(sys.modules)))
"""
    assert in_a_new_process(code) == "[]"


DRAW = """
import harnack as hk, mitsuba as mi
from harnack.rendering import render
from harnack.geometry.example_curves import wavy_polygon
{before}
try:
    image = render(hk.SolidAngle(wavy_polygon(12)), size=(24, 18), spp=64, progress=False)
    print(mi.variant(), *image.mean(axis=(0, 1)))
except RuntimeError as error:
    print(error)
"""


@pytest.mark.slow
def test_a_variant_is_chosen_if_there_is_none() -> None:
    assert in_a_new_process(DRAW.format(before="")).split()[0] in ("llvm_ad_rgb", "cuda_ad_rgb")


@pytest.mark.few(1)
@pytest.mark.parametrize("variant", ["scalar_rgb", "llvm_ad_spectral_polarized"])
def test_a_variant_that_cannot_work_is_refused_and_kept(variant: str) -> None:
    said = in_a_new_process(DRAW.format(before=f"mi.set_variant('{variant}')"))
    assert f"the Mitsuba variant is {variant}" in said


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["llvm_ad_spectral", "llvm_ad_mono"])
def test_other_variants_draw_the_same_picture(variant: str) -> None:
    name, *mean = in_a_new_process(DRAW.format(before=f"mi.set_variant('{variant}')")).split()
    assert name == variant
    _, *rgb = in_a_new_process(DRAW.format(before="mi.set_variant('llvm_ad_rgb')")).split()
    ours, reference = (np.array(values, dtype=float) for values in (mean, rgb))
    if variant == "llvm_ad_mono":
        ours, reference = ours[:1], reference @ np.array([[0.2126], [0.7152], [0.0722]])
    np.testing.assert_allclose(ours, reference, rtol=0.05)


@pytest.mark.slow
@pytest.mark.parametrize(
    "show",
    [
        "normal",
        *(pytest.param(one, marks=pytest.mark.slow) for one in ("depth", "evaluations", "status")),
    ],
)
def test_views_look_alike_in_bands(show: str, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = draw(show=show)
    monkeypatch.setattr("harnack.rendering.aov_render._RAYS_A_BAND", 7)
    np.testing.assert_array_equal(draw(show=show), whole)


def test_tone_mapping_of_many_rows_is_that_of_each() -> None:
    radiance = np.random.default_rng(0).uniform(0, 3, (150, 2, 3)).astype(np.float32)
    whole = tone_map(radiance)
    rows = [tone_map(radiance[k : k + 1]) for k in range(len(radiance))]
    np.testing.assert_array_equal(whole, np.concatenate(rows))
