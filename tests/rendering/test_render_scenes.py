"""Our surfaces in Mitsuba scenes: energy, agreement with Mitsuba's own shapes, interplay."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np
import pytest

import harnack as hk
from harnack.enclosures import Lipschitz
from harnack.fields.field import Field, Sample
from harnack.rendering import mitsuba_shape, register, render
from harnack.rendering.aov_render import AovTask

mi = register()
T = mi.ScalarTransform4f


class Sphere(Field):
    """Distance to a sphere about the origin."""

    def __init__(self, radius: float = 1.0) -> None:
        self.radius = radius
        self.domain = hk.Ball(radius=2.0 * radius)

    def evaluate(self, p: Any) -> Sample:
        distance = dr.norm(p)
        return Sample(distance - self.radius, p / distance, (Lipschitz(1.0),))


class Plane(Field):
    """Height over the plane z = 0."""

    def __init__(self) -> None:
        self.domain = hk.Box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))

    def evaluate(self, p: Any) -> Sample:
        up = type(p)(0.0, 0.0, 1.0)
        return Sample(dr.dot(p, up), up, (Lipschitz(1.0),))


def red() -> dict[str, Any]:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.02, 0.02]}}


def sensor(origin: tuple[float, float, float] = (2.7, -3.0, 1.5), size: int = 48) -> dict[str, Any]:
    return {
        "type": "perspective",
        "fov": 40,
        "to_world": T().look_at(origin=list(origin), target=[0, 0, 0], up=[0, 0, 1]),
        "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}},
        "sampler": {"type": "multijitter"},
    }


def lamp() -> dict[str, Any]:
    return {
        "type": "rectangle",
        "to_world": T().look_at(origin=[2, -2, 5], target=[0, 0, 0], up=[0, 1, 0]),
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [10.0, 9.0, 8.0]}},
    }


def drawn(members: dict[str, Any], spp: int = 16, depth: int = 8, **kw: Any) -> np.ndarray:
    scene = {
        "type": "scene",
        "integrator": {"type": "harnack_path", "max_depth": depth},
        "sensor": sensor(**kw),
        **members,
    }
    return render(scene, spp=spp, progress=False)


GYROID = hk.Gyroid(1.0, domain=hk.Ball(radius=1.0))


@pytest.mark.few(1)
@pytest.mark.parametrize("tolerance", [1e-3, 1e-4, 1e-5])
@pytest.mark.parametrize(
    "settings",
    [
        {"level": 0.0, "side": "below"},
        {"level": (-0.3, 0.3), "side": "between"},
        {
            "level": (-0.3, 0.3),
            "side": "between",
            "clip": hk.Box((-0.6, -0.6, -0.6), (0.6, 0.6, 0.6)),
        },
        {"level": 0.2, "side": "above", "clip": hk.HalfSpace((0.3, -1.0, 0.2), 0.2)},
    ],
    ids=["half", "wall", "box", "halfspace"],
)
def test_glass_neither_takes_nor_gives_light(tolerance: float, settings: dict[str, Any]) -> None:
    """White furnace: under constant light a lossless solid cannot be seen, in any pixel."""
    glass = mitsuba_shape(GYROID, bsdf={"type": "dielectric"}, tolerance=tolerance, **settings)
    scene = {
        "type": "scene",
        "integrator": {"type": "harnack_path", "max_depth": -1, "rr_depth": 100_000},
        "sensor": sensor(),
        "light": {"type": "constant"},
        "glass": glass,
    }
    image = render(scene, spp=4, progress=False)
    np.testing.assert_allclose(image, 1.0, atol=1e-3)


@pytest.mark.parametrize("tolerance", [1e-3, 1e-4, 1e-5])
def test_open_white_surface_takes_no_light(tolerance: float) -> None:
    white = {"type": "twosided", "nested": {"type": "diffuse", "reflectance": 1.0}}
    scene = {
        "type": "scene",
        "integrator": {"type": "harnack_path", "max_depth": -1, "rr_depth": 100_000},
        "sensor": sensor(),
        # Found by paths alone, so that there is no noise.
        "light": {"type": "constant", "sampling_weight": 0.0},
        "dark": {"type": "point", "intensity": 0.0},
        "surface": mitsuba_shape(GYROID, bsdf=white, tolerance=tolerance),
    }
    image = render(scene, spp=4, progress=False)
    np.testing.assert_allclose(image, 1.0, atol=1e-3)


BSDFS: dict[str, dict[str, Any]] = {
    "diffuse": red(),
    "roughconductor": {"type": "roughconductor", "material": "Au", "alpha": 0.2},
    "dielectric": {"type": "dielectric", "int_ior": 1.5},
    "roughdielectric": {"type": "roughdielectric", "alpha": 0.2},
    "principled": {"type": "principled", "roughness": 0.3, "metallic": 0.4, "spec_tint": 0.5},
}


@pytest.mark.few(1)
@pytest.mark.parametrize("name", BSDFS)
def test_solid_sphere_looks_like_mitsubas(name: str) -> None:
    surroundings = {
        "sky": {"type": "constant", "radiance": 0.4},
        "lamp": lamp(),
        "ground": {"type": "rectangle", "to_world": T().translate([0, 0, -1]).scale(6)},
    }
    ours = mitsuba_shape(Sphere(), bsdf=BSDFS[name], level=0.0, side="below")
    theirs = {"type": "sphere", "bsdf": BSDFS[name]}
    a = drawn({**surroundings, "ball": ours}, spp=256, size=24)
    b = drawn({**surroundings, "ball": theirs}, spp=256, size=24)
    assert a.mean() == pytest.approx(b.mean(), rel=0.005)
    blocks = [image.reshape(4, 6, 4, 6, 3).mean(axis=(1, 3)) for image in (a, b)]
    np.testing.assert_allclose(*blocks, rtol=0.06)


def _mesh_of_gyroid(cells: int) -> dict[str, Any]:
    """Marching cubes on the whole box; the mesh's own normals from the gradient of f."""
    measure = pytest.importorskip("skimage.measure")
    axis = np.linspace(-0.6, 0.6, cells)
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    values = _gyroid(grid.reshape(-1, 3)).reshape(cells, cells, cells)
    vertices, faces, _, _ = measure.marching_cubes(values, 0.0, spacing=(axis[1] - axis[0],) * 3)
    vertices = vertices + axis[0]
    step = 1e-5 * np.eye(3)
    gradient = [_gyroid(vertices + h) - _gyroid(vertices - h) for h in step]
    normals = np.stack(gradient, axis=-1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    props = mi.Properties()
    props["bsdf"] = mi.load_dict({"type": "twosided", "nested": red()})
    mesh = mi.Mesh("gyroid", len(vertices), len(faces), props=props, has_vertex_normals=True)
    params = mi.traverse(mesh)
    params["vertex_positions"] = vertices.astype(np.float32).ravel()
    params["vertex_normals"] = normals.astype(np.float32).ravel()
    params["faces"] = faces.astype(np.uint32).ravel()
    params.update()
    return {"gyroid": mesh}


def _lit_gyroid(tolerance: float) -> dict[str, Any]:
    box = hk.Box((-0.6, -0.6, -0.6), (0.6, 0.6, 0.6))
    bsdf = {"type": "twosided", "nested": red()}
    field = hk.Gyroid(1.0, domain=box)
    return {"gyroid": mitsuba_shape(field, bsdf=bsdf, tolerance=tolerance)}


LIGHTS = {"sky": {"type": "constant", "radiance": 0.3}, "lamp": lamp()}


@pytest.mark.slow
def test_gyroid_looks_like_its_mesh() -> None:
    ours = drawn({**LIGHTS, **_lit_gyroid(1e-4)}, spp=196, size=64)
    mesh = drawn({**LIGHTS, **_mesh_of_gyroid(160)}, spp=196, size=64)
    assert ours.mean() == pytest.approx(mesh.mean(), rel=0.005)
    for channel in range(3):
        assert ours[..., channel].mean() == pytest.approx(mesh[..., channel].mean(), rel=0.005)
    blocks = [image.reshape(8, 8, 8, 8, 3).mean(axis=(1, 3)) for image in (ours, mesh)]
    np.testing.assert_allclose(*blocks, rtol=0.06, atol=0.005)


def test_tolerances_draw_the_same_picture() -> None:
    """No black, no specks: with the tolerance, only noise and outlines change."""
    images = [drawn({**LIGHTS, **_lit_gyroid(t)}, spp=64) for t in (1e-3, 1e-4, 1e-5)]
    for image in images[:2]:
        assert image.mean() == pytest.approx(images[2].mean(), rel=0.01)
        difference = np.abs(image - images[2]).max(axis=-1)
        assert np.mean(difference > 0.15) < 0.01
        assert np.mean(difference) < 0.03
    surface = images[0][..., 0] - images[0][..., 1] > 0.02  # red: the sky is gray
    assert surface.mean() > 0.2
    dark = [np.mean(image[surface].max(axis=-1) < 0.01) for image in images]
    assert max(dark) < 0.002


@pytest.mark.slow
def test_shadows_fall_both_ways() -> None:
    sun = {"type": "directional", "direction": [0, 0, -1], "irradiance": 3.0}
    above = {"type": "sphere", "center": [0, 0, 2], "radius": 0.4}
    plane = mitsuba_shape(Plane(), bsdf={"type": "twosided", "nested": red()})
    floor = {"type": "rectangle", "to_world": T().translate([0, 0, -0.01]).scale(3)}
    view = {"origin": (0.0, -4.0, 3.0)}
    lit = drawn({"sun": sun, "plane": plane}, **view)
    shaded = drawn({"sun": sun, "plane": plane, "ball": above}, **view)
    middle = np.s_[23:25, 22:26]  # the filter reaches two pixels beyond
    assert lit[middle].max() > 0.5
    assert shaded[middle].max() < 0.01
    ball = mitsuba_shape(Sphere(0.4), to_world=T().translate([0, 0, 2]), bsdf=red())
    assert drawn({"sun": sun, "floor": floor}, **view)[middle].min() > 0.3
    assert drawn({"sun": sun, "floor": floor, "ball": ball}, **view)[middle].max() < 0.05


def test_reflections_show_both_ways() -> None:
    sky = {"type": "constant"}
    mirror = {"type": "conductor"}
    view = {"origin": (0.0, -4.0, 0.0)}
    middle = np.s_[23:25, 23:25]
    # Behind the camera, so that it is seen in the mirror only.
    behind = T().translate([0, -7, 0])
    seen = drawn(
        {
            "sky": sky,
            "mirror": {"type": "sphere", "bsdf": mirror},
            "red": mitsuba_shape(Sphere(2.0), bsdf=red(), to_world=behind),
        },
        **view,
    )
    assert seen[middle][..., 0].mean() > 3 * seen[middle][..., 1].mean()
    seen = drawn(
        {
            "sky": sky,
            "mirror": mitsuba_shape(Sphere(), bsdf=mirror, level=0.0, side="below"),
            "red": {"type": "sphere", "radius": 2, "to_world": behind, "bsdf": red()},
        },
        **view,
    )
    assert seen[middle][..., 0].mean() > 3 * seen[middle][..., 1].mean()


def test_nearer_of_two_surfaces_hides_the_other_in_either_order() -> None:
    green = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.02, 0.8, 0.02]}}
    near = mitsuba_shape(Sphere(0.5), bsdf=red(), to_world=T().translate([0, -2, 0]))
    far = mitsuba_shape(Sphere(1.0), bsdf=green)
    view = {"origin": (0.0, -6.0, 0.0)}
    sky = {"type": "constant"}
    a = drawn({"sky": sky, "a": near, "b": far}, **view)
    b = drawn({"sky": sky, "a": far, "b": near}, **view)
    for image in (a, b):
        assert image[24, 24, 0] > 5 * image[24, 24, 1]
        assert image[24, 34, 1] > 5 * image[24, 34, 0]


def test_to_world_moves_turns_and_scales() -> None:
    to_world = T().translate([0.3, 0.2, -0.1]).rotate([0.6, 0.0, 0.8], 40).scale(0.8)
    grid = hk.Gyroid(1.0, domain=hk.Ball(radius=1.0))
    moved = mitsuba_shape(grid, to_world=to_world, level=(-0.3, 0.3), side="between")
    view = AovTask.of(mi, *_scene_and_sensor(moved)).look()
    inverse = np.linalg.inv(np.array(to_world.matrix, dtype=float).reshape(4, 4))
    points = _positions(view) @ inverse[:3, :3].T + inverse[:3, 3]
    f = _gyroid(points)
    on_wall = np.abs(np.abs(f) - 0.3) < 0.01
    on_cap = (np.abs(np.linalg.norm(points, axis=1) - 1) < 1e-3) & (np.abs(f) < 0.31)
    assert len(points) > 300
    assert (on_wall | on_cap).all()
    assert on_wall.sum() > 100
    assert on_cap.sum() > 20


def _gyroid(p: np.ndarray) -> np.ndarray:
    x, y, z = 2 * np.pi * p.T
    return np.sin(x) * np.cos(y) + np.sin(y) * np.cos(z) + np.sin(z) * np.cos(x)


def _scene_and_sensor(member: Any) -> tuple[Any, Any]:
    scene = mi.load_dict({"type": "scene", "sensor": sensor(), "member": member})
    return scene, scene.sensors()[0]


def _positions(view: Any) -> np.ndarray:
    """World positions of the pixels' hits, from the camera of `sensor`."""
    camera = mi.load_dict(sensor())
    n = view.depth.shape[0]
    y, x = np.mgrid[0:n, 0:n].reshape(2, -1)
    place = mi.Point2f((x + 0.5) / n, (y + 0.5) / n)
    ray, _ = camera.sample_ray(0.0, 0.5, place, mi.Point2f(0.5))
    t = view.depth.ravel()
    hit = np.isfinite(t)
    o, d = np.array(ray.o).T, np.array(ray.d).T
    return (np.broadcast_to(o, d.shape) + t[:, None] * d)[hit]


@pytest.mark.parametrize(
    "bad",
    [
        (
            lambda: mitsuba_shape(hk.SolidAngle([[0, 0, 0], [1, 0, 0], [0, 1, 0]]), level=0.0),
            "infinity",
        ),
        (lambda: mitsuba_shape(GYROID, to_world=np.diag([1.0, 2.0, 1.0, 1.0])), "one scale"),
        (lambda: mitsuba_shape(GYROID, to_world=np.zeros((4, 4))), "one scale"),
        (lambda: mitsuba_shape(GYROID, to_world=np.full((4, 4), np.nan)), "finite"),
        (lambda: mitsuba_shape(GYROID, bsdf={"type": "rectangle"}), "BSDF"),
        (lambda: mitsuba_shape(hk.Surface(GYROID), level=0.1), "level"),
        (lambda: mi.load_dict({"type": "harnack_path", "max_depth": -2}), "max_depth"),
    ],
)
def test_errors_say_what_is_wrong(bad: tuple[Callable[[], Any], str]) -> None:
    make, word = bad
    with pytest.raises((ValueError, TypeError, RuntimeError), match=word):
        make()


@pytest.mark.slow
def test_mitsubas_own_render_draws_the_same_picture() -> None:
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "harnack_path", "max_depth": 6},
            "sensor": sensor(),
            **LIGHTS,
            **_lit_gyroid(1e-4),
        }
    )
    theirs = np.array(mi.render(scene, spp=64))
    ours = render(scene, spp=64, progress=False)
    assert scene.integrator().take_lost() == 0
    assert theirs.mean() == pytest.approx(ours.mean(), rel=0.01)
    # The filters differ: a pixel's square here, a Gaussian there.
    blocks = [image.reshape(6, 8, 6, 8, 3).mean(axis=(1, 3)) for image in (ours, theirs)]
    np.testing.assert_allclose(*blocks, rtol=0.1, atol=0.02)
    with pytest.raises(ValueError, match="size"):
        render(scene, size=(20, 20))


def test_mitsubas_own_render_shows_and_counts_what_was_lost() -> None:
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "harnack_path"},
            "sensor": sensor(),
            "sky": {"type": "constant", "radiance": 0.0},
            "surface": mitsuba_shape(GYROID, max_steps=3),
        }
    )
    image = np.array(mi.render(scene, spp=4))
    lost = scene.integrator().take_lost()
    assert lost > 1000
    assert scene.integrator().take_lost() == 0
    # All that shines is magenta: red and blue in full, no green.
    assert image[..., 1].max() == 0
    assert image[..., 0].sum() == pytest.approx(lost / 4, rel=0.05)
    np.testing.assert_allclose(image[..., 0], image[..., 2], atol=1e-5)


@pytest.mark.slow
def test_pictures_differentiate_with_respect_to_materials() -> None:
    bsdf = {"type": "twosided", "nested": red()}
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "harnack_path", "max_depth": 4, "rr_depth": 99},
            "sensor": sensor(size=24),
            **LIGHTS,
            "surface": mitsuba_shape(GYROID, bsdf=bsdf),
        }
    )
    params = mi.traverse(scene)
    name = next(key for key in params.keys() if "reflectance" in key)  # noqa: SIM118

    def picture_of(reflectance: float) -> Any:
        params[name] = mi.Color3f(reflectance, 0.02, 0.02)
        dr.enable_grad(params[name])
        params.update()
        return mi.render(scene, params, spp=64, seed=1)

    ahead, behind = (np.array(picture_of(r))[..., 0].mean() for r in (0.82, 0.78))
    image = picture_of(0.8)
    dr.backward(dr.mean(image) * 3)  # a mean over three channels, of which one changes
    derivative = np.array(dr.grad(params[name])).ravel()[0]
    assert derivative == pytest.approx((ahead - behind) / 0.04, rel=0.03)


def test_xml_scene_names_our_surfaces(tmp_path: Any) -> None:
    square = np.array([[1, -1, 0], [1, 1, 0], [-1, 1, 0], [-1, -1, 0.3]], dtype=float)
    np.savetxt(tmp_path / "square.loops", square.reshape(1, -1))
    (tmp_path / "scene.xml").write_text(
        """<scene version="3.0.0">
        <integrator type="harnack_path"><integer name="max_depth" value="3"/></integrator>
        <sensor type="perspective">
            <transform name="to_world">
                <lookat origin="0,-8,5" target="0,0,0" up="0,0,1"/></transform>
            <film type="hdrfilm">
                <integer name="width" value="40"/><integer name="height" value="20"/></film>
        </sensor>
        <emitter type="constant"/>
        <shape type="harnack"><string name="file" value="square.loops"/>
            <transform name="to_world"><translate x="-1.5"/></transform>
            <bsdf type="twosided"><bsdf type="diffuse"/></bsdf></shape>
        <shape type="harnack"><string name="field" value="gyroid"/>
            <float name="cell" value="1"/><float name="clip_radius" value="1"/>
            <float name="low" value="-0.3"/><float name="high" value="0.3"/>
            <transform name="to_world"><translate x="1.5"/></transform>
            <bsdf type="diffuse"/></shape>
        </scene>"""
    )
    status = render(tmp_path / "scene.xml", show="status")
    assert status.shape == (20, 40)
    left, right = status[:, :20], status[:, 20:]
    assert (left == hk.RayStatus.HIT).sum() > 20
    assert (right == hk.RayStatus.HIT).sum() > 20
    with pytest.raises(ValueError, match="as it is"):
        render(tmp_path / "scene.xml", material="gold")


def test_xml_shape_with_a_misspelled_property_is_refused() -> None:
    text = (
        '<scene version="3.0.0"><shape type="harnack"><string name="field" value="gyroid"/>'
        '<float name="levle" value="1"/></shape></scene>'
    )
    with pytest.raises(RuntimeError, match="levle"):
        mi.load_string(text)


@pytest.mark.slow
def test_integrators_that_cannot_see_our_surfaces_are_named_in_a_warning() -> None:
    theirs = {"type": "sphere"}
    path, ours = {"type": "path"}, {"type": "harnack_path"}

    def scene(integrator: dict[str, Any], member: Any) -> Any:
        members = {"integrator": integrator, "sensor": sensor(size=8), "lamp": lamp()}
        return mi.load_dict({"type": "scene", "shape": member, **members})

    for stock in (path, {"type": "prb"}):
        with pytest.warns(UserWarning, match="1 of .*cannot see.*harnack_path"):
            mi.render(scene(stock, mitsuba_shape(Sphere())), spp=1)
    with pytest.warns(UserWarning, match="PathIntegrator draws nothing"):
        mi.render(scene(ours, mitsuba_shape(Sphere())), integrator=mi.load_dict(path), spp=1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mi.render(scene(ours, mitsuba_shape(Sphere())), spp=1)
        mi.render(scene({"type": "moment", "nested": ours}, mitsuba_shape(Sphere())), spp=1)
        mi.render(scene(path, theirs), spp=1)
        render(scene(path, mitsuba_shape(Sphere())), spp=1, progress=False)


def drawn_by(integrator: dict[str, Any], member: Any, **members: Any) -> Any:
    film = {**sensor(size=8), "sampler": {"type": "independent", "sample_count": 4}}
    scene = {"integrator": integrator, "sensor": film, "lamp": lamp(), "shape": member, **members}
    return mi.load_dict({"type": "scene", **scene})


@pytest.mark.slow
def test_integrators_are_followed_left_to_mitsuba_or_refused_by_name() -> None:
    """`direct`, `aov` and `volpath` were replaced by paths without a word."""
    theirs, ours = {"type": "sphere"}, mitsuba_shape(Sphere())
    quiet: dict[str, Any] = {"spp": 4, "progress": False}
    channels = {"type": "aov", "aovs": "d:depth,n:sh_normal", "image": {"type": "path"}}
    found = render(drawn_by(channels, theirs), **quiet)
    assert found.shape[-1] in (7, 8)
    assert found[4, 4, -4] == pytest.approx(3.3, abs=0.2)  # the depth of the sphere
    assert found.srgb.shape[-1] in (3, 4)
    with pytest.raises(ValueError, match="denoise: Mitsuba draws this scene"):
        render(drawn_by(channels, theirs), denoise=True, **quiet)
    inside = {"type": "aov", "aovs": "d:depth", "image": {"type": "harnack_path"}}
    with pytest.raises(ValueError, match=r"1 of .*level sets.*AOVIntegrator asks for"):
        render(drawn_by(inside, ours), **quiet)
    with pytest.warns(UserWarning, match="AOVIntegrator draws nothing"):
        mi.render(drawn_by(inside, ours), spp=1)
    moments = {"type": "moment", "nested": {"type": "harnack_path"}}
    assert render(drawn_by(moments, ours), **quiet).shape[-1] > 4
    fog = {"type": "cube", "bsdf": {"type": "null"}, "interior": {"type": "homogeneous"}}
    with pytest.raises(ValueError, match="light in its media"):
        render(drawn_by({"type": "volpath"}, ours, fog=fog), **quiet)
    render(drawn_by({"type": "volpath"}, theirs, fog=fog), **quiet)
    with pytest.warns(UserWarning, match="follows no light in media"):
        render(drawn_by({"type": "harnack_path"}, ours, fog=fog), **quiet)
    for kind in ("ptracer", "prb"):
        with pytest.raises(ValueError, match="level sets of harnack"):
            render(drawn_by({"type": kind}, ours), **quiet)


@pytest.mark.slow
def test_direct_light_is_that_of_paths_of_two_edges_and_hidden_lamps_stay_hidden() -> None:
    white = {"type": "constant"}
    direct, two = (
        render(drawn_by(one, mitsuba_shape(Sphere()), sky=white), spp=4, progress=False)
        for one in ({"type": "direct"}, {"type": "harnack_path", "max_depth": 2})
    )
    np.testing.assert_array_equal(direct, two)
    for kind in ("path", "direct", "volpath"):
        hidden = drawn_by({"type": kind, "hide_emitters": True}, mitsuba_shape(Sphere()), sky=white)
        assert render(hidden, spp=4, progress=False)[0, 0].max() == 0.0


def test_attributes_of_vertices_are_refused_on_level_sets(tmp_path: Any) -> None:
    """They were black."""
    colors = {"type": "mesh_attribute", "name": "vertex_color"}
    with pytest.raises(ValueError, match="mesh_attribute belongs to vertices"):
        mitsuba_shape(Sphere(), bsdf={"type": "diffuse", "reflectance": colors})


def test_channels_of_mitsuba_are_written_with_their_names(tmp_path: Any) -> None:
    import OpenEXR

    channels = {"type": "aov", "aovs": "d:depth", "image": {"type": "path"}}
    found = render(
        drawn_by(channels, {"type": "sphere"}), tmp_path / "a.exr", spp=4, progress=False
    )
    with OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True) as file:
        written = file.channels()
        assert "d.T" in written
        np.testing.assert_array_equal(written["d.T"].pixels, found[..., -1])


def test_integrators_in_python_draw_and_differentiate() -> None:
    # Their loops are rewritten when they are first called.
    scene = mi.load_dict(
        {"type": "scene", "light": {"type": "constant"}, "camera": sensor(size=4)}, parallel=False
    )
    parameters = mi.traverse(scene)
    radiance = parameters["light.radiance.value"]
    dr.enable_grad(radiance)
    integrator = mi.load_dict({"type": "prb_basic"})
    image = mi.render(scene, parameters, integrator=integrator, spp=1)
    dr.backward(dr.mean(image, axis=None))
    np.testing.assert_allclose(np.array(image), 1.0, rtol=1e-5)
    assert float(dr.grad(radiance)[0]) == pytest.approx(1.0, rel=1e-5)
