"""Rays on another GPU: Mesa's, which computes on the CPU, stands for all of them."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np
import pytest

import harnack as hk
from harnack import webgpu
from harnack.backend import choose_backend, to_numpy
from harnack.geometry.example_meshes import icosphere
from harnack.tracer import hits as tracing
from harnack.webgpu import Device, DeviceMismatchError, NoDeviceError, find_device, record_kernel
from harnack.webgpu import device as device_module
from tests.fields.test_contracts import APPROXIMATE, FIELDS
from tests.fields.test_shapes import SHAPES

try:
    find_device()
except NoDeviceError as missing:
    pytest.skip(str(missing), allow_module_level=True)

_BALL = icosphere(1)
# Fields whose contracts are elsewhere.
OTHERS: dict[str, Callable[[], hk.Field]] = {
    "polygon mesh": lambda: hk.PolygonMesh(_BALL[0], [[*face] for face in _BALL[1]]),
    "blobs": lambda: hk.Blobs(np.random.default_rng(1).normal(size=(30, 3)) * 0.5, radii=0.3),
    "HRBF": lambda: hk.fields.HRBF(_BALL[0], _BALL[0]),
    "log": lambda: hk.fields.RiemannSurface("log", domain=hk.Ball(radius=1.0)),
    "asin": lambda: hk.fields.RiemannSurface("asin", domain=hk.Ball(radius=1.0)),
    "level curves": lambda: hk.fields.LevelCurves("log"),
    "thousand spheres": lambda: hk.union(
        [hk.Sphere(0.07, (x, y, z)) for x, y, z in np.random.default_rng(4).random((1000, 3))]
    ),
}


def field_of(name: str) -> hk.Field:
    if name in OTHERS:
        return OTHERS[name]()
    return {**FIELDS, **APPROXIMATE}[name] if name not in SHAPES else SHAPES[name][0]


def rays(field: hk.Field, count: int, seed: int = 3) -> tuple[Any, Any, float]:
    """From all sides through the surface's box, and a tolerance for its size."""
    box = field.extent((field.default_level,)) or field.domain
    ends = np.array([[-2.0] * 3, [2.0] * 3] if box is None else box.bounds())
    lower, upper = np.clip(ends, -1e4, 1e4)
    size = 0.5 * float(np.linalg.norm(upper - lower))
    rng = np.random.default_rng(seed)
    away = rng.normal(size=(count, 3))
    o = 0.5 * (lower + upper) + 2 * size * away / np.linalg.norm(away, axis=1, keepdims=True)
    return o, rng.uniform(lower, upper, (count, 3)) - o, 1e-4 * size


def check_same_hits(field: hk.Field, count: int) -> None:
    """Against Dr.Jit's own: the same ends but for grazes, and hits within the tolerance."""
    o, d, tolerance = rays(field, count)
    if isinstance(field, hk.WindingNumber):
        field.configure_cells(False)  # devices have them where they are asked for
    other = hk.trace(field, o, d, tolerance=tolerance, backend="webgpu")
    own = hk.trace(field, o, d, tolerance=tolerance, precision="single")
    unit = d / np.linalg.norm(d, axis=1, keepdims=True)
    assert tracing._compare_hits(own, other, unit, hk.tracer.HitTolerance(tolerance)) == ""
    both = own.is_hit & other.is_hit
    assert (own.status != other.status).sum() <= 1e-3 * count
    assert both.any()
    assert np.quantile(np.abs(own.t[both] - other.t[both]), 0.9) <= 0.1 * tolerance
    np.testing.assert_array_equal(own.primitive_index[both], other.primitive_index[both])


# Walks its tree for more turns than Mesa's compiler lets loops have.
TOO_LONG = ("morph",)
# Mesa reads and writes local arrays slowly.
FEWER = {"network": 4_000}


@pytest.mark.few(6)
@pytest.mark.parametrize("name", [
    *(first := ("gyroid", "wavy", "mesh, exact", "torus", "polygon mesh", "log")),
    *(name for name in [*FIELDS, *APPROXIMATE, *SHAPES, *OTHERS]
      if name not in (*first, *TOO_LONG)),
])  # fmt: skip
def test_every_field_is_hit_as_on_the_cpu(name: str) -> None:
    check_same_hits(field_of(name), FEWER.get(name, 20_000))


def check_same_results(compute: Callable[..., dict[str, Any]], count: int = 50) -> None:
    """Of numbers x from 0 to 4 and integers n from 0 to 4."""
    backend = choose_backend("single")
    lanes = {
        "x": backend.Float(np.linspace(0, 4, count)),
        "n": backend.UInt32(np.arange(count) % 5),
    }
    recording = record_kernel(compute, lanes, ())
    program = find_device().compile(recording.shader)
    computed = program.run(recording.data, {f"lane {k}": to_numpy(v) for k, v in lanes.items()})
    assert recording.results
    for label, result in recording.results.items():
        expected = to_numpy(result)
        if expected.dtype == np.bool_:
            np.testing.assert_array_equal(computed[label] != 0, expected)
        else:
            np.testing.assert_allclose(computed[label].view(expected.dtype), expected, rtol=1e-5)


def test_switches() -> None:
    """In a loop, with a loop and an array within, masks, and one function alone."""
    backend = choose_backend("single")
    table = backend.Float(np.arange(7) ** 0.5)

    def gathers(x: Any, n: Any, is_large: Any) -> tuple[Any, Any, Any]:
        return x + dr.gather(backend.Float, table, n, is_large), n + 1, x > 2

    def loops(x: Any, n: Any, is_large: Any) -> tuple[Any, Any, Any]:
        double = dr.while_loop((x, n), lambda _, k: k < 5, lambda x, k: (x * 2, k + 1))
        return double[0] * 0.125, n, ~is_large

    def constant(x: Any, n: Any, is_large: Any) -> tuple[Any, Any, Any]:
        return backend.Float(0.5), n * 2, backend.Bool(True)

    def compute(x: Any, n: Any) -> dict[str, Any]:
        def body(k: Any, x: Any, n: Any, is_large: Any) -> tuple[Any, ...]:
            functions = [gathers, loops, constant]
            return k + 1, *dr.switch((k + n) % 3, functions, x, n % 7, is_large)

        state = (backend.UInt32(n), x, n, x > 1)
        _, x, n, is_large = dr.while_loop(state, lambda k, *_: k < 7, body)
        (increased,) = dr.switch(n * 0, [lambda x: (x + 1,)], x)
        return {"x": increased, "n": n, "large": is_large}

    check_same_results(compute)


def test_local_arrays() -> None:
    """Of numbers, integers and truth values, at computed and at constant indices, with masks.
    (Dr.Jit 1.5 compiles no truth values that are stored in a loop.)"""
    backend = choose_backend("single")
    kinds = (backend.Float, backend.UInt32, backend.Bool)

    def compute(x: Any, n: Any) -> dict[str, Any]:
        numbers, integers, masks = arrays = [dr.alloc_local(kind, 5) for kind in kinds]
        for k in range(5):
            for array, entry in zip(arrays, (x + k, n + k, x > k), strict=True):
                array[backend.UInt32(k)] = entry

        def body(k: Any, total: Any, arrays: Any) -> tuple[Any, Any, Any]:
            numbers, integers, masks = arrays
            read = numbers.read(k, x > 1) + dr.select(masks[k], integers[(k + 1) % 5], 0)
            numbers.write(read, (n + k) % 5, n != k)
            integers.write(n * k, n)
            return k + 1, total + read, arrays

        state = (backend.UInt32(n), backend.Float(0), arrays)
        _, total, (numbers, integers, masks) = dr.while_loop(state, lambda k, *_: k < 5, body)
        return {"a": total, "b": numbers[n], "c": integers[n], "d": masks[n]}

    check_same_results(compute)


@dataclasses.dataclass(frozen=True)
class Lying:
    """A device of which one operation is wrong: the line of the shader that `wrong` chooses."""

    device: Any
    line: int
    name: str = "a device that lies"

    def compile(self, shader: Any) -> Any:
        lines = shader.code.split("\n")
        numbers = [k for k, one in enumerate(lines) if re.match(r" +let v_f\d+ = [^;]*;$", one)]
        k = numbers[self.line % len(numbers)]
        lines[k] = re.sub(r"= (.*);", r"= (\1) * 1.001f;", lines[k])
        return self.device.compile(dataclasses.replace(shader, code="\n".join(lines)))


def test_a_device_that_lies_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """One operation wrong by a thousandth: most are refused, the others do no harm."""
    field = hk.Gyroid(0.5, domain=hk.Ball(radius=1.0))
    o, d, tolerance = rays(field, 4096)
    own = hk.trace(field, o, d, tolerance=tolerance, precision="single")
    refused = 0
    for line in range(0, 600, 30):
        monkeypatch.setattr(webgpu, "find_device", lambda k=line: Lying(find_device(), k))
        try:
            other = hk.trace(field, o, d, tolerance=tolerance, backend="webgpu")
        except DeviceMismatchError:
            refused += 1
            continue
        assert (own.status == other.status).mean() > 0.998
        both = own.is_hit & other.is_hit
        assert np.quantile(np.abs(own.t[both] - other.t[both]), 0.9) < tolerance
    assert refused >= 5


def test_the_device_is_named_that_lies(monkeypatch: pytest.MonkeyPatch) -> None:
    field = hk.Gyroid(0.5, domain=hk.Ball(radius=1.0))
    o, d, _ = rays(field, 4096)
    monkeypatch.setattr(webgpu, "find_device", lambda: Lying(find_device(), 0))
    with pytest.raises(DeviceMismatchError, match=r"a device that lies does not .*leave out back"):
        hk.trace(field, o, d, backend="webgpu")


def test_what_is_not_for_other_devices() -> None:
    field = hk.Sphere(1.0)
    o, d, _ = rays(field, 8)
    with pytest.raises(ValueError, match="single precision alone"):
        hk.trace(field, o, d, precision="double", backend="webgpu")
    with pytest.raises(TypeError, match="crossings has no backend"):
        hk.crossings(field, o, d, max_crossings=3, backend="webgpu")
    with pytest.raises(ValueError, match="'metal'"):
        hk.trace(field, o, d, backend="metal")  # type: ignore[arg-type]
    backend = hk.backend.choose_backend("single")
    with pytest.raises(TypeError, match="NumPy arrays"):
        hk.trace(field, backend.Array3f(0, 0, 2), d, backend="webgpu")


def test_few_rays_and_many() -> None:
    field = hk.Sphere(1.0)
    for count in (1, 2, 3, 5000, 40000):
        o, d, _ = rays(field, count)
        own = hk.trace(field, o, d, precision="single")
        other = hk.trace(field, o, d, backend="webgpu")
        np.testing.assert_array_equal(own.status, other.status)
        np.testing.assert_allclose(
            other.position[other.is_hit], own.position[own.is_hit], atol=1e-4
        )
    none = hk.trace(field, np.zeros((0, 3)), np.zeros((0, 3)), backend="webgpu")
    assert len(none.t) == 0


class Uploads:
    """A device's handle that notes the sizes of what is uploaded in buffers of their own."""

    def __init__(self, handle: Any) -> None:
        self.handle, self.sizes = handle, list[int]()

    def create_buffer_with_data(self, *, data: Any, usage: Any) -> Any:
        self.sizes.append(data.nbytes)
        return self.handle.create_buffer_with_data(data=data, usage=usage)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.handle, name)


def test_tables_are_uploaded_once_for_all_dispatches(monkeypatch: pytest.MonkeyPatch) -> None:
    backend = choose_backend("single")
    x, table = backend.Float(np.arange(640) / 64), backend.Float(np.arange(4096) ** 0.5)

    def compute(x: Any) -> dict[str, Any]:
        return {"y": dr.gather(backend.Float, table, backend.UInt32(x * 100)) + x}

    recording = record_kernel(compute, {"x": x}, table)
    uploads = Uploads(find_device().handle)
    monkeypatch.setattr(device_module, "_INITIAL_BATCH", 64)
    monkeypatch.setattr(device_module, "_MAX_BATCH", 64)
    program = Device(uploads, "device").compile(recording.shader)
    computed = program.run(recording.data, {"lane x": to_numpy(x)})
    expected = to_numpy(recording.results["result y"])
    assert np.array_equal(computed["result y"].view(np.float32), expected)
    assert len([size for size in uploads.sizes if size > 4 * 4096]) == 1
    assert len(uploads.sizes) == 1 + 10
