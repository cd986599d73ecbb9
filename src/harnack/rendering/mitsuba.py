"""Imports Mitsuba with a variant that can draw surfaces, loads scene files, and computes refraction
and absorption in transparent solids. `mi` is the Mitsuba module. A variant of Mitsuba fixes the
device, the representation of colors and the precision, such as llvm_ad_rgb. A proxy is the Mitsuba
mesh that stands for a surface of harnack in a scene and carries its BSDF; no ray of Mitsuba hits
it.

Scene files in XML are checked before Mitsuba reads them, and Mitsuba's error messages are
shortened.
"""

from __future__ import annotations

import codecs
import contextlib
import functools
import importlib
import os
import re
from collections.abc import Callable, Generator, Mapping
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from harnack.backend import Backend, backend_of, choose_backend
from harnack.files.file_geometry import MAX_BYTES, FileLocation, read_bytes

_USABLE = re.compile(r"(llvm|cuda|metal)_ad_(mono|rgb|spectral)(_double)?")


def load_mitsuba() -> Any:
    """Return the `mitsuba` module, with a variant in which surfaces can be drawn. It is imported
    when it is first needed.

    A variant that was set before stays. If none was set, it becomes cuda_ad_rgb, metal_ad_rgb or
    llvm_ad_rgb, according to the device that `harnack.backend.choose_backend` finds.

    Raises:
        RuntimeError: Mitsuba lacks the variant of the device, or the variant that is set has no
            vectorized arrays, or tracks polarization.
        LLVMNotFoundError: LLVM is needed, and there is none that Dr.Jit can work with.
    """
    with _syntax_when_called():
        mi = importlib.import_module("mitsuba")
    if mi.variant() is None:
        variant = f"{choose_backend().name}_ad_rgb"
        if variant not in mi.variants():
            raise RuntimeError(
                f"this Mitsuba has no variant {variant}: set HARNACK_BACKEND=llvm to draw on the "
                "CPU"
            )
        with _syntax_when_called():
            mi.set_variant(variant)
    elif _USABLE.fullmatch(mi.variant()) is None:
        raise RuntimeError(
            f"the Mitsuba variant is {mi.variant()}, and surfaces are traced with Dr.Jit arrays "
            "that have derivatives and no polarization: call "
            'mitsuba.set_variant("llvm_ad_rgb") or ("cuda_ad_rgb") before the scene is made'
        )
    return mi


def set_variant(variant: str) -> None:
    """Set a Mitsuba variant, if another or none is set. A process of a cluster calls it with the
    variant of the process for which it works.

    Raises:
        ImportError: this Mitsuba does not have the variant, or cannot use it here.
    """
    mi = importlib.import_module("mitsuba")
    if mi.variant() != variant:
        with _syntax_when_called():
            mi.set_variant(variant)


@contextlib.contextmanager
def _syntax_when_called() -> Generator[None]:
    """A context in which the decorator `drjit.syntax`, which rewrites the source of a function,
    does so for functions of Mitsuba only when they are first called.

    Setting a variant defines all of Mitsuba's integrators that are written in Python. They are
    rarely called, and to rewrite them takes longer than all else of Mitsuba's import.
    """
    drjit: Any = dr
    rewrite: Callable[..., Any] = drjit.syntax

    def syntax(function: Any = None, **options: Any) -> Any:
        """`drjit.syntax`, put off for functions of Mitsuba."""
        if function is None:
            return functools.partial(syntax, **options)
        if not function.__module__.startswith("mitsuba"):
            return rewrite(function, **options)
        rewritten: Callable[[], Any] = functools.cache(lambda: rewrite(function, **options))

        @functools.wraps(function)
        def call(*args: Any, **kwargs: Any) -> Any:
            """Call the function, rewritten."""
            return rewritten()(*args, **kwargs)

        return call

    drjit.syntax = syntax
    try:
        yield
    finally:
        drjit.syntax = rewrite


def mitsuba_backend(mi: Any) -> Backend:
    """Return the backend with the array types of the Mitsuba variant that is set."""
    return backend_of(mi.Float(0))


# Scene files.

_BYTE_ORDER_MARKS = {
    codecs.BOM_UTF8: "utf-8", codecs.BOM_UTF32_LE: "utf-32", codecs.BOM_UTF32_BE: "utf-32",
    codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16",
    b"<\0": "utf-16-le", b"\0<": "utf-16-be",
}  # fmt: skip
# Elements that name files: <include filename="..."/>, <string name="filename" value="..."/>.
_NAMES_A_FILE = re.compile(r"<(include|string)\b([^<>]*)>")
_ATTRIBUTE = re.compile(r"""\b(filename|value)\s*=\s*(?:"([^"]*)"|'([^']*)')""")
# Parts of Mitsuba's error messages besides the error: locations in its source, Python's traceback.
_SOURCE_PLACE = re.compile(r"\[\w+\.(?:cpp|h):\d+\]\s*")
_TRACEBACK = re.compile(r"Traceback \(most recent call last\):\n(?:[ \t]+.*\n)*(?:[\w.]+: )?")
_REPEATED = re.compile(r"(?m)^(.*\n)(?:\1)+")


def load_scene_file(mi: Any, path: str | os.PathLike[str]) -> Any:
    """Load the scene in an XML file by Mitsuba, and return it.

    Raises:
        FileFormatError: the file, or one that it includes, is missing, no ordinary file,
            unreadable, empty, above 256 MiB, or no XML.
        RuntimeError: Mitsuba cannot read it; the message says where.
    """
    path = Path(path)
    check_scene_file(path)
    try:
        return mi.load_file(os.fspath(path), parallel=False)
    except RuntimeError as error:
        raise RuntimeError(without_traceback(str(error))) from error


def load_dict(mi: Any, description: Mapping[str, Any]) -> Any:
    """Load the scene, or another object of Mitsuba's, that a dictionary describes, and return it.

    Raises:
        RuntimeError: Mitsuba cannot make it; the message says which entry is wrong.
    """
    try:
        return mi.load_dict({**description}, parallel=False)
    except RuntimeError as error:
        raise RuntimeError(without_traceback(str(error))) from error


def check_scene_file(path: Path) -> None:
    """Check a scene file and the files that it names before Mitsuba reads them.

    Mitsuba's parser checks neither kind nor size of a file: it waits forever at a pipe, and takes
    all memory for a file of many gigabytes.

    Raises:
        FileFormatError: a file is of another kind or too large. If the path names a surface file, a
            formula or no file at all, the message says what to do instead.
    """
    # Imported here: only scene files need them.
    from harnack.fields.expressions import looks_like_formula
    from harnack.files.geometry_files import GEOMETRY_SUFFIXES

    if path.suffix.lower() in GEOMETRY_SUFFIXES:
        raise FileLocation(path).error(
            "this is a surface file, not a Mitsuba scene (.xml): draw its field, "
            "harnack.io.field_from_file(path).field"
        )
    if looks_like_formula(str(path)) and not path.exists():
        raise FileLocation(path).error(
            "there is no such file; of a formula, take the field harnack.expression(text)"
        )
    if not path.suffix and not path.exists():
        raise FileLocation(path).error(
            "there is no such file; Mitsuba scenes are .xml files, and scenes of the gallery are "
            "drawn by harnack.gallery.SCENES[name].render()"
        )
    # Included files are read in turn; other files that are named must only be ordinary ones.
    checked = {path}
    waiting = [path]
    total = 0
    while waiting:
        text = _scene_text(waiting.pop())
        total += len(text)
        if total > MAX_BYTES:
            raise FileLocation(path).error(
                f"with what it includes it has more than {MAX_BYTES:,} bytes"
            )
        for element, name in _files_named(text):
            file = path.parent / name
            # A file that is not found here may lie in a folder that the scene names to Mitsuba.
            if file in checked or not _exists(file):
                continue
            checked.add(file)
            if element == "include":
                waiting.append(file)
            elif not file.is_file() and not file.is_dir():
                raise FileLocation(file).error("this is not an ordinary file")


def _scene_text(path: Path) -> str:
    """Read the text of a file that may be XML.

    Raises:
        FileFormatError: it does not look like XML.
    """
    data = read_bytes(path)
    byte_order_mark = next(
        (
            byte_order_mark
            for byte_order_mark in _BYTE_ORDER_MARKS
            if data.startswith(byte_order_mark)
        ),
        b"",
    )
    # Without a mark the encoding does not matter: markup is ASCII, and latin-1 reads all bytes.
    text = data.decode(_BYTE_ORDER_MARKS.get(byte_order_mark, "latin-1"), "replace")
    if not text.lstrip("\ufeff \t\r\n").startswith("<"):
        raise FileLocation(path).error("this is no XML file: it does not begin with '<'")
    if "\0" in text:
        raise FileLocation(path).error(
            "this is binary data, not the text that its extension announces"
        )
    return text


def _files_named(text: str) -> list[tuple[str, str]]:
    """Find the files that the text of a scene may name. Returns pairs (element, name), such as
    ("include", "lights.xml")."""
    # An element has its name as group 1 and its attributes as group 2. Groups 2 and 3 of an
    # attribute are the value in double and in single quotes; one of them is None.
    return [
        (element[1], attribute[2] or attribute[3])
        for element in _NAMES_A_FILE.finditer(text)
        for attribute in _ATTRIBUTE.finditer(element[2])
        if attribute[2] or attribute[3]
    ]


def _exists(path: Path) -> bool:
    """Return whether a path exists; False for a path that the system cannot handle."""
    try:
        return path.exists()
    except (OSError, ValueError):
        return False


def without_traceback(message: str) -> str:
    """Return the message of an error of Mitsuba, without Python's traceback and locations in source
    files."""
    message = _SOURCE_PLACE.sub("", _TRACEBACK.sub("", message))
    return _REPEATED.sub(r"\1", message).strip()


# Transparent solids: their transmittance and refraction.

# A solid whose index of refraction differs less from 1 does not bend light.
_MIN_INDEX_DIFFERENCE = 1e-6


def transmittance_texture(mi: Any, tint: Any) -> Any:
    """Return a Mitsuba texture that holds how much light is left after one unit of length in a
    solid; None if no light is absorbed.

    tint: the remaining fractions of red, green and blue light, in (0, 1]; None for all of the
        light.

    Raises:
        TypeError, ValueError: not three numbers in (0, 1].
    """
    if tint is None:
        return None
    wrong = "tint is what is left of red, green and blue after one unit of length, in (0, 1]"
    try:
        color = [float(channel) for channel in tint]
    except (TypeError, ValueError):
        raise TypeError(f"{wrong}, such as (0.9, 0.5, 0.1), not {tint!r}") from None
    if len(color) != 3 or not all(0 < channel <= 1 for channel in color):
        raise ValueError(f"{wrong}, such as (0.9, 0.5, 0.1), not {tint!r}")
    if min(color) == 1:
        return None
    return mi.load_dict({"type": "srgb", "color": color}, parallel=False)


def refractive_index(mi: Any, carrier: Any) -> Any:
    """Return the index of refraction of a transparent solid, relative to its surroundings, as a
    kernel parameter. None for opaque shapes and for surfaces that bound no solid.

    carrier: the proxy, the Mitsuba mesh that stands for the solid.
    """
    bsdf = carrier.bsdf()
    transmissions = (mi.BSDFFlags.DeltaTransmission, mi.BSDFFlags.GlossyTransmission)
    if carrier.surface.solid_range is None or not any(
        mi.has_flag(bsdf.flags(), transmission) for transmission in transmissions
    ):
        return None
    # Mitsuba's BSDFs of glass name their index "eta".
    parameters = mi.traverse(bsdf)
    for name, _ in parameters:
        if name == "eta":
            return dr.opaque(mi.Float, float(np.ravel(parameters[name])[0]))
    return None


def is_inside(mi: Any, carrier: Any, start: Any, d: Any) -> Any:
    """Return the mask of rays that start on the boundary of a solid and run inside it.

    carrier: the proxy, the mesh that stands for the solid in Mitsuba.
    start, d: the surface interactions at which rays start, and their directions (3,).
    """
    starts_on_it = start.is_valid() & (start.shape == mi.ShapePtr(carrier))
    return starts_on_it & (dr.dot(start.n, d) < 0)


def transmittance(mi: Any, carriers: Any, start: Any, si: Any, d: Any) -> Any:
    """Return the fraction of light, as a spectrum, that transparent solids let through along rays
    up to their next hits.

    carriers: the proxies, meshes that stand for surfaces of harnack in Mitsuba.
    start, d: the surface interactions at which rays start, and their directions (3,).
    si: the next hits of the rays.

    If one unit of length in a solid leaves the fraction a of the light, a length t leaves the
    fraction a^t (Beer and Lambert). A ray crosses the boundary of a solid alternately inward and
    outward (`CappedSolid.intersect`). So a ray that leaves a point of a solid's boundary against
    the outward normal is inside up to the next hit.
    """
    remaining = mi.Spectrum(1)
    for carrier in carriers:
        if carrier.tint is None:
            continue
        inside = is_inside(mi, carrier, start, d) & si.is_valid()
        # The spectrum of a reflectance of that color, at the ray's wavelengths.
        per_unit = mi.Spectrum(carrier.tint.eval(si, inside))
        # `power` needs a positive base.
        remaining *= dr.select(inside, dr.power(dr.maximum(per_unit, 1e-6), si.t), 1)
    return remaining


def refract(normal: Any, d: Any, index: Any) -> tuple[Any, Any]:
    """Refract rays at a boundary of a transparent solid. Returns the unit directions behind it, and
    the fraction of unpolarized light that is reflected (Fresnel). If this fraction is 1 (total
    reflection), the direction is that of the mirrored ray.

    normal, d: (3,) outward unit normals of the solid, and unit directions of the rays.
    index: the refractive index of the inside relative to the outside.
    """
    normal_dot_d = dr.dot(normal, d)
    enters = normal_dot_d < 0
    # The refractive index before the boundary, divided by the one behind it.
    eta = dr.select(enters, 1 / index, index)
    normal_to_ray = dr.select(enters, 1, -1) * normal
    cosine = dr.clip(dr.abs(normal_dot_d), 0, 1)
    # Snell's law: the square of the refracted ray's cosine; negative for total reflection.
    refracted_cosine = 1 - eta * eta * (1 - cosine * cosine)
    is_refracted = refracted_cosine > 0
    refracted_cosine = dr.sqrt(dr.maximum(refracted_cosine, 0))
    # Fresnel's amplitudes for light that is polarized perpendicular and parallel to the plane of
    # incidence. The divisors are kept above 0.
    perpendicular = (eta * cosine - refracted_cosine) / dr.maximum(
        eta * cosine + refracted_cosine, 1e-9
    )
    parallel = (cosine - eta * refracted_cosine) / dr.maximum(cosine + eta * refracted_cosine, 1e-9)
    reflected_fraction = dr.select(
        is_refracted, 0.5 * (perpendicular * perpendicular + parallel * parallel), 1
    )
    # Between equal indices nothing is reflected.
    reflected_fraction = dr.select(dr.abs(index - 1) < _MIN_INDEX_DIFFERENCE, 0, reflected_fraction)
    refracted = eta * d + (eta * cosine - refracted_cosine) * normal_to_ray
    mirrored = d + 2 * cosine * normal_to_ray
    return dr.normalize(dr.select(is_refracted, refracted, mirrored)), reflected_fraction
