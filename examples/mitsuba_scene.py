"""Beside Mitsuba's own shapes, with a material of your own.

Our surfaces are shapes of a Mitsuba scene like any other: its lamps light them, its mirrors
reflect them. Their material is any BSDF, also one written in Python: here white paint, colored by
the direction of the normal.
"""

import sys
from pathlib import Path

import harnack as hk  # isort: skip  # before Mitsuba, so that Dr.Jit loads an LLVM that works
import mitsuba as mi

mi.set_variant("llvm_ad_rgb")


class Tinted(mi.BSDF):
    def __init__(self, props):
        super().__init__(props)
        white = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 1.0}}
        self.paint = mi.load_dict({"type": "twosided", "bsdf": white})
        self.m_components = [self.paint.flags(i) for i in range(self.paint.component_count())]
        self.m_flags = self.paint.flags()

    def color(self, si):
        return mi.Color3f(0.5 + 0.4 * si.sh_frame.n)

    def sample(self, ctx, si, sample1, sample2, active=True):
        chosen, weight = self.paint.sample(ctx, si, sample1, sample2, active)
        return chosen, weight * self.color(si)

    def eval(self, ctx, si, wo, active=True):
        return self.paint.eval(ctx, si, wo, active) * self.color(si)

    def pdf(self, ctx, si, wo, active=True):
        return self.paint.pdf(ctx, si, wo, active)


mi.register_bsdf("tinted", Tinted)


def main(folder: Path, size: tuple[int, int] = (640, 480), spp: int = 32) -> hk.rendering.Picture:
    T = mi.ScalarTransform4f()
    knot = hk.SolidAngle(hk.geometry.example_curves.torus_knot(2, 3, 48))
    lamp = {"type": "area", "radiance": {"type": "rgb", "value": 12.0}}
    white, mirror = {"type": "diffuse"}, {"type": "conductor"}
    ground = T.translate([0, 0, -1.4]).scale(30)
    film = {"type": "hdrfilm", "width": size[0], "height": size[1]}
    view = T.look_at([4, -4, 3], [0.4, 0.4, -0.2], [0, 0, 1])
    scene = {
        "type": "scene",
        "integrator": {"type": "harnack_path", "max_depth": 6},
        "sensor": {"type": "perspective", "fov": 44, "to_world": view, "film": film},
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.6}},
        "lamp": {"type": "sphere", "center": [5, -1, 6], "radius": 1.2, "emitter": lamp},
        "floor": {"type": "rectangle", "to_world": ground, "bsdf": white},
        "mirror": {"type": "sphere", "center": [0.6, 3, -0.3], "radius": 1.1, "bsdf": mirror},
        "knot": hk.rendering.mitsuba_shape(knot, bsdf={"type": "tinted"}),
    }
    return hk.render(scene, folder / "mitsuba_scene.png", spp=spp)


if __name__ == "__main__":
    output = Path(sys.argv[1] if len(sys.argv) > 1 else "out")
    output.mkdir(parents=True, exist_ok=True)
    main(output)
