"""The choice of LLVM, and the way between NumPy and Dr.Jit."""

from __future__ import annotations

import ctypes
import functools
import importlib.metadata
import os
import platform
import subprocess
import sys
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

import harnack.backend as hb
from harnack.backend import arrays, atomic_library, doctor, llvm
from harnack.backend.elementary import orthonormal_basis, orthonormal_basis_rows
from harnack.backend.record_table import RecordTable
from harnack.rendering.mitsuba import load_mitsuba

ELF_WITH_SONAME = b"\x7fELF...\0libc.so.6\0%s\0LLVMCreateMessage\0"


def touch(path: Path, content: bytes = b"") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    return path


def run_python(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run code in a Python of its own, where no LLVM has been chosen yet."""
    kept = {key: value for key, value in os.environ.items() if key != llvm.PATH_VARIABLE}
    return subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
        env={**kept, **environment},
    )


# ---- versions of libraries, without loading them ----


@pytest.mark.parametrize(
    ("name", "major"),
    [
        ("libLLVM-14.so.1", 14),
        ("libLLVM-14.0.6.so.1", 14),
        ("libLLVM-15.so.1", 15),
        ("libLLVM-17.so", 17),
        ("libLLVM.so.18.1", 18),
        ("libLLVM.so.19.1", 19),
        ("libLLVM.so.22.1-rust-1.95.0-stable", 22),
        ("libLLVM-19.dylib", 19),
        ("libLLVM.19.1.dylib", 19),
        ("libLLVM.so", None),
        ("libLLVM.dylib", None),
    ],
)
def test_version_from_file_name(tmp_path: Path, name: str, major: int | None) -> None:
    assert llvm.library_version(touch(tmp_path / name)) == major


@pytest.mark.parametrize(
    ("soname", "major"),
    [
        (b"libLLVM-15.so.1", 15),
        (b"libLLVM-14.0.6.so", 14),
        (b"libLLVM.so.19.1", 19),
        (b"libLLVM.so", None),
        (b"libLLVMSupport.so.19.1", None),
    ],
)
def test_version_from_soname(tmp_path: Path, soname: bytes, major: int | None) -> None:
    path = touch(tmp_path / "libLLVM.so", ELF_WITH_SONAME % soname)
    assert llvm.library_version(path) == major


def test_version_from_where_links_end(tmp_path: Path) -> None:
    touch(tmp_path / "lib" / "libLLVM.so.19.1")
    link = tmp_path / "libLLVM.so"
    link.symlink_to(tmp_path / "lib" / "libLLVM.so.19.1")
    assert llvm.library_version(link) == 19


@pytest.mark.parametrize(
    ("folder", "major"),
    [("Cellar/llvm/21.1.0/lib", 21), ("Cellar/llvm@19/19.1.7_1/lib", 19), ("llvm-18/lib", 18)],
)
def test_version_from_folder(tmp_path: Path, folder: str, major: int) -> None:
    assert llvm.library_version(touch(tmp_path / folder / "libLLVM.dylib")) == major


def test_version_of_a_library_that_is_not_there(tmp_path: Path) -> None:
    assert llvm.library_version(tmp_path / "libLLVM.so") is None


@pytest.mark.parametrize(
    ("major", "word"), [(14, "too old"), (15, "aborts"), (16, "aborts"), (None, "cannot be told")]
)
def test_refused_versions(major: int | None, word: str) -> None:
    assert word in (llvm.rejection_reason(major) or "")


@pytest.mark.parametrize("major", [17, 18, 19, 20, 21, 22, 23, 24])
def test_accepted_versions(major: int) -> None:
    assert llvm.rejection_reason(major) is None


def test_libraries_are_found_once_each_and_best_first(tmp_path: Path) -> None:
    for major in (14, 15, 18, 19, 23, 24):
        touch(tmp_path / "a" / f"libLLVM-{major}.so.1")
    touch(tmp_path / "a" / "libLLVMSupport.so.19")
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "libLLVM.so").symlink_to(tmp_path / "a" / "libLLVM-19.so.1")
    (tmp_path / "b" / "libLLVM-21.so").symlink_to(tmp_path / "nowhere")
    found = llvm.find_libraries([tmp_path / "a", tmp_path / "b", tmp_path / "missing"])
    assert [library.major for library in found] == [19, 23, 18, 24, 15, 14]


def test_earlier_folder_wins_among_equals(tmp_path: Path) -> None:
    for folder in ("near", "far"):
        touch(tmp_path / folder / "libLLVM.so.19.1")
    found = llvm.find_libraries([tmp_path / "near", tmp_path / "far"])
    assert found[0].path == tmp_path / "near" / "libLLVM.so.19.1"


# ---- refusals, and what they advise ----


def test_bad_library_in_the_environment_is_refused_not_suffered(tmp_path: Path) -> None:
    fake = touch(tmp_path / "libLLVM-15.so.1")
    code = (
        "import harnack.backend as hb\n"
        "try:\n    hb.choose_backend()\n"
        "except hb.LLVMNotFoundError as error:\n    print(error)\n"
    )
    done = run_python(code, HARNACK_BACKEND="llvm", DRJIT_LIBLLVM_PATH=str(fake))
    assert done.returncode == 0, done.stderr
    assert f"DRJIT_LIBLLVM_PATH names {fake}: LLVM 15 aborts the process" in done.stdout
    assert "run `" in done.stdout or "Install LLVM" in done.stdout


def test_missing_library_in_the_environment_is_named(tmp_path: Path) -> None:
    code = "from harnack.backend import llvm; llvm.ensure_llvm()"
    done = run_python(code, DRJIT_LIBLLVM_PATH=str(tmp_path / "libLLVM.so"))
    assert done.returncode == 1
    assert "there is no such file" in done.stderr


def test_import_leaves_the_environment_alone_and_picks_an_acceptable_llvm() -> None:
    code = (
        "import os\nfrom harnack.backend import llvm\n"
        "assert 'DRJIT_LIBLLVM_PATH' not in os.environ\n"
        "assert llvm.loaded_library().major == llvm.best_library().major == llvm.ensure_llvm()\n"
        "assert llvm.loaded_library().rejection_reason is None\n"
    )
    done = run_python(code)
    assert done.returncode == 0, done.stderr


def test_import_of_harnack_loads_no_mitsuba_through_backend() -> None:
    done = run_python("import harnack.backend, sys; sys.exit('mitsuba' in sys.modules)")
    assert done.returncode == 0, done.stderr


def use_libraries(monkeypatch: pytest.MonkeyPatch, *majors: int) -> None:
    found = tuple(llvm.LLVMLibrary(Path(f"/lib/libLLVM-{m}.so.1"), m) for m in majors)
    monkeypatch.setattr(llvm, "find_libraries", lambda: found)
    monkeypatch.delenv(llvm.PATH_VARIABLE, raising=False)


def test_advice_points_at_an_acceptable_library_that_is_there(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    use_libraries(monkeypatch, 19, 15)
    monkeypatch.setattr(llvm, "_loaded_major", lambda: 15)
    with pytest.raises(hb.LLVMNotFoundError, match=r"aborts.*export DRJIT_LIBLLVM_PATH=\S+-19"):
        llvm.ensure_llvm()


def test_advice_is_to_install_if_nothing_acceptable_is_there(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    use_libraries(monkeypatch, 14)
    monkeypatch.setattr(llvm, "_loaded_major", lambda: None)
    with pytest.raises(hb.LLVMNotFoundError, match=r"Found only /lib/libLLVM-14.* Install LLVM 19"):
        llvm.ensure_llvm()


@pytest.mark.parametrize(
    ("platform", "machine", "conda", "dnf", "command"),
    [
        ("linux", "x86_64", None, None, "-m pip install 'karellen-llvm-core>=19.1.7,<20'`"),
        ("linux", "x86_64", "/opt/conda", "/usr/bin/dnf", "-m pip install 'karellen-llvm-core"),
        ("linux", "aarch64", None, None, "`sudo apt-get install libllvm19`"),
        ("linux", "aarch64", None, "/usr/bin/dnf", "`sudo dnf install llvm-libs`"),
        ("linux", "aarch64", "/opt/conda", None, "`conda install -c conda-forge libllvm19`"),
        ("darwin", "arm64", None, None, "`brew install llvm@19`"),
        ("win32", "AMD64", None, None, "`winget install LLVM.LLVM`, then set DRJIT_LIBLLVM_PATH"),
    ],
)
def test_advice_of_each_system(
    monkeypatch: pytest.MonkeyPatch,
    platform: str,
    machine: str,
    conda: str | None,
    dnf: str | None,
    command: str,
) -> None:
    monkeypatch.setattr(sys, "platform", platform)
    monkeypatch.setattr(llvm.platform, "machine", lambda: machine)
    monkeypatch.setattr(llvm.shutil, "which", lambda name: dnf)
    monkeypatch.delenv("CONDA_PREFIX", raising=False)
    if conda:
        monkeypatch.setenv("CONDA_PREFIX", conda)
    assert command in llvm.install_advice()


def test_advice_names_the_versions_that_the_package_requires() -> None:
    requirements = importlib.metadata.requires("harnack") or []
    wheel = next(line for line in requirements if line.startswith("karellen-llvm-core"))
    advised = llvm.LLVM_WHEEL.strip("'").removeprefix("karellen-llvm-core").split(",")
    assert sorted(wheel.removeprefix("karellen-llvm-core").split(";")[0].split(",")) == sorted(
        advised
    )


# ---- what minimal systems lack ----

X86_LINUX = pytest.mark.skipif(
    sys.platform != "linux" or platform.machine() != "x86_64", reason="for Linux on x86-64"
)
TRY_KERNEL = "from harnack.backend import doctor; doctor.try_kernel('single')\n"


@X86_LINUX
def test_stand_in_for_libatomic_compares_and_exchanges(tmp_path: Path) -> None:
    path = tmp_path / "stand-in.so"
    path.write_bytes(atomic_library.shared_library())
    function = getattr(ctypes.CDLL(str(path)), "__atomic_compare_exchange_16")
    function.restype = ctypes.c_bool
    pointer, word = ctypes.c_void_p, ctypes.c_uint64
    function.argtypes = [pointer, pointer, word, word, ctypes.c_int, ctypes.c_int]
    storage = ctypes.create_string_buffer(64)
    address = -(-ctypes.addressof(storage) // 16) * 16  # the instruction needs aligned memory
    memory = (word * 2).from_address(address)
    expected = (word * 2)(2**64 - 1, 2)
    memory[:] = [2**64 - 1, 2]
    sequential = 5  # __ATOMIC_SEQ_CST
    arguments = (ctypes.addressof(expected), 3, 2**63, sequential, sequential)
    assert function(address, *arguments) is True
    assert (memory[:], expected[:]) == ([3, 2**63], [2**64 - 1, 2])
    memory[1] = 8  # differs in the upper word alone
    expected[:] = [3, 9]
    assert function(address, *arguments) is False
    assert (memory[:], expected[:]) == ([3, 8], [3, 8])


@X86_LINUX
@pytest.mark.parametrize("has_files_in_memory", [True, False])
def test_kernels_run_on_the_stand_in_for_libatomic(has_files_in_memory: bool) -> None:
    """The library of the system is hidden by the stand-in, which has its name and comes first."""
    code = (
        "import importlib.util, os\n"
        f"if not {has_files_in_memory}:\n    del os.memfd_create\n"
        f"spec = importlib.util.spec_from_file_location('a', {atomic_library.__file__!r})\n"
        "a = importlib.util.module_from_spec(spec); spec.loader.exec_module(a)\n"
        "a._load_from_memory(a.shared_library())\n"
        f"{TRY_KERNEL}"
        "maps = open('/proc/self/maps').read()\n"
        "assert a.is_stand_in_loaded() and 'libatomic.so.1' not in maps\n"
    )
    done = run_python(code, HARNACK_BACKEND="llvm")
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""


@X86_LINUX
def test_llvm_wheel_works_where_it_could_not_make_its_links(tmp_path: Path) -> None:
    """A wheel has no links; this one makes them later, which fails where it may not write."""
    library = Path(sys.prefix) / "lib" / "libLLVM.so.19.1"
    if not library.exists():
        pytest.skip("LLVM of the system is in use")
    runtime = "x86_64-unknown-linux-gnu"
    (tmp_path / runtime).mkdir()
    (tmp_path / library.name).symlink_to(library)
    for path in (library.parent / runtime).glob("*.so.1.0"):
        (tmp_path / runtime / path.name).symlink_to(path)
    done = run_python(
        TRY_KERNEL, HARNACK_BACKEND="llvm", DRJIT_LIBLLVM_PATH=str(tmp_path / library.name)
    )
    assert done.returncode == 0, done.stderr


# ---- backends ----


@pytest.fixture(params=["single", "double"])
def backend(request: pytest.FixtureRequest) -> hb.Backend:
    return hb.choose_backend(request.param)


def test_backend_of_each_of_its_own_types(backend: hb.Backend) -> None:
    for kind in (backend.Float, backend.Array2f, backend.Array3f, backend.Array4f):
        assert hb.backend_of(kind(1)) is backend
        assert hb.backend_of(dr.detach(kind(1), preserve_type=False)) is backend
    assert hb.backend_of(dr.zeros(backend.ArrayXf, (3, 2))) is backend


def test_types_carry_derivatives_and_have_the_precision(backend: hb.Backend) -> None:
    width = {"single": dr.VarType.Float32, "double": dr.VarType.Float64}[backend.precision]
    for kind in (backend.Float, backend.Array2f, backend.Array3f, backend.Array4f, backend.ArrayXf):
        assert dr.is_diff_v(kind)
        assert dr.type_v(kind) == width
    assert dr.type_v(backend.UInt32) == dr.VarType.UInt32
    assert dr.type_v(backend.Int32) == dr.VarType.Int32
    assert dr.is_mask_v(backend.Bool)


def test_backend_of_mitsuba_arrays_whatever_the_variant() -> None:
    before = mi.variant()
    try:
        mi.set_variant("llvm_ad_rgb")
        assert repr(hb.backend_of(mi.Point3f(1, 2, 3))) == "Backend(llvm, single)"
        assert repr(hb.backend_of(mi.Vector3d(1, 2, 3))) == "Backend(llvm, double)"
        hb.choose_backend("double")
        assert mi.variant() == "llvm_ad_rgb"
        mi.set_variant("scalar_rgb")
        with pytest.raises(TypeError, match=r"scalar mode.*llvm_ad_rgb"):
            hb.backend_of(mi.Point3f(1, 2, 3))
    finally:
        if before is not None:
            mi.set_variant(before)


def test_backend_of_other_things(backend: hb.Backend) -> None:
    tensor = dr.ones(dr.tensor_t(backend.Float), (2, 3))
    for other in (1.0, [1.0], np.zeros(3), None):
        with pytest.raises(TypeError, match=r"expected a Dr\.Jit array"):
            hb.backend_of(other)
    for other in (backend.UInt32(1), backend.Int32(1), backend.Bool(True)):
        with pytest.raises(TypeError, match="floats of 32 or 64 bits"):
            hb.backend_of(other)
    for other in (tensor, dr.matrix_t(backend.Array3f)(1)):
        with pytest.raises(TypeError, match="scalar or vector array"):
            hb.backend_of(other)


def test_forced_backend(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HARNACK_BACKEND", "llvm")
    assert hb.choose_backend().name == "llvm"
    monkeypatch.setenv("HARNACK_BACKEND", "gpu")
    with pytest.raises(ValueError, match=r"HARNACK_BACKEND is 'gpu'.*unset"):
        hb.choose_backend()


@pytest.mark.skipif(dr.has_backend(dr.JitBackend.CUDA), reason="there is a CUDA device")
def test_forced_cuda_without_a_device(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HARNACK_BACKEND", "cuda")
    with pytest.raises(RuntimeError, match=r"HARNACK_BACKEND=cuda.*no usable device"):
        hb.choose_backend()


@pytest.fixture
def metal(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """A stand-in for Dr.Jit on a Mac: the types of LLVM under Metal's name."""
    module = types.SimpleNamespace(**vars(importlib.import_module("drjit.llvm.ad")))
    monkeypatch.setitem(sys.modules, "drjit.metal.ad", module)
    monkeypatch.setattr(dr, "has_backend", lambda kind: kind != dr.JitBackend.CUDA)
    monkeypatch.delenv("HARNACK_BACKEND", raising=False)
    arrays._make_backend.cache_clear()
    yield module
    arrays._make_backend.cache_clear()


def test_metal_is_taken_for_single_precision(metal: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    assert hb.choose_backend().name == "metal"
    assert hb.choose_backend("double").name == "llvm"
    monkeypatch.setenv("HARNACK_BACKEND", "metal")
    assert [hb.choose_backend(one).name for one in ("single", "double")] == ["metal", "llvm"]
    monkeypatch.setenv("HARNACK_BACKEND", "llvm")
    assert hb.choose_backend().name == "llvm"
    monkeypatch.setenv("HARNACK_BACKEND", "metal")
    monkeypatch.setattr(dr, "has_backend", lambda kind: kind == dr.JitBackend.LLVM)
    with pytest.raises(RuntimeError, match=r"HARNACK_BACKEND=metal.*macOS"):
        hb.choose_backend()


def test_metal_needs_no_llvm(metal: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing() -> None:
        raise hb.LLVMNotFoundError("there is none")

    monkeypatch.setattr(arrays, "ensure_llvm", missing)
    assert hb.choose_backend().name == "metal"
    with pytest.raises(hb.LLVMNotFoundError):
        hb.choose_backend("double")


@pytest.mark.parametrize("what", ["infinities", "NaN", "quotients"])
def test_a_metal_that_computes_otherwise_is_not_believed(
    what: str, metal: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As compilers do that take infinities and NaN for impossible."""
    right = arrays.to_numpy

    def wrong(array: Any) -> Any:
        found = right(array).copy()
        if what == "infinities":
            found[np.isinf(found)] = 3e38
        elif what == "NaN":
            found[np.isnan(found)] = 0
        else:
            found[1] *= 1 + 1e-6
        return found

    monkeypatch.setattr(arrays, "to_numpy", wrong)
    with pytest.raises(RuntimeError, match=r"does not compute .* as IEEE 754 says.*llvm"):
        hb.choose_backend()


def test_metal_is_named_where_mitsuba_lacks_it(metal: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in = types.SimpleNamespace(variant=lambda: None, variants=lambda: ["llvm_ad_rgb"])
    monkeypatch.setitem(sys.modules, "mitsuba", stand_in)
    with pytest.raises(RuntimeError, match=r"no variant metal_ad_rgb.*HARNACK_BACKEND=llvm"):
        load_mitsuba()


def test_unknown_precision() -> None:
    bad: Any = "half"
    with pytest.raises(ValueError, match="'half'"):
        hb.choose_backend(bad)


def test_choosing_a_backend_changes_no_setting_of_drjit() -> None:
    flags = [flag for flag in dr.JitFlag if flag.name != "Default"]
    before = dr.thread_count(), [dr.flag(flag) for flag in flags]
    chosen = hb.choose_backend("double")
    hb.to_numpy(hb.to_vector3(chosen, [[1, 2, 3]]))
    assert (dr.thread_count(), [dr.flag(flag) for flag in flags]) == before


# ---- from NumPy and back ----


@given(values=st.lists(st.tuples(*[st.floats(-(2.0**100), 2.0**100, width=32)] * 3), max_size=20))
def test_vectors_come_back_as_they_went(values: list[tuple[float, float, float]]) -> None:
    array = np.array(values, dtype=np.float64).reshape(-1, 3)
    for precision in ("single", "double"):
        back = hb.to_numpy(hb.to_vector3(hb.choose_backend(precision), array))
        assert back.shape == array.shape
        assert back.flags.c_contiguous
        np.testing.assert_array_equal(back, array)


def test_numbers_come_back_as_they_went(backend: hb.Backend) -> None:
    np.testing.assert_array_equal(
        hb.to_numpy(hb.to_float(backend, [0.5, np.inf, -0.0])), [0.5, np.inf, -0.0]
    )
    np.testing.assert_array_equal(hb.to_numpy(hb.to_float(backend, 3)), [3])
    assert hb.to_numpy(hb.to_float(backend, [])).shape == (0,)


def test_drjit_arrays_pass_and_change_precision(backend: hb.Backend) -> None:
    other = hb.choose_backend("single" if backend.precision == "double" else "double")
    vectors = hb.to_vector3(backend, other.Array3f([1, 2], 3, 4))
    assert type(vectors) is backend.Array3f
    np.testing.assert_array_equal(hb.to_numpy(vectors), [[1, 3, 4], [2, 3, 4]])
    assert type(hb.to_float(backend, other.Float(1))) is backend.Float


def test_derivatives_pass_through(backend: hb.Backend) -> None:
    x = backend.Array3f(1, 2, 3)
    dr.enable_grad(x)
    y = dr.squared_norm(hb.to_vector3(backend, x))
    np.testing.assert_array_equal(hb.to_numpy(y), [14])
    dr.backward(y)
    np.testing.assert_array_equal(hb.to_numpy(dr.grad(x)), [[2, 4, 6]])


def test_another_number_does_not_compile_another_kernel(backend: hb.Backend) -> None:
    def launch(value: float) -> str:
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            x = dr.arange(backend.Float, 8) * hb.to_float(backend, value)
            dr.eval(x)
            return dr.kernel_history([dr.KernelType.JIT])[-1]["hash"]

    assert launch(2.0) == launch(3.0)


@pytest.mark.parametrize(
    ("value", "error", "message"),
    [
        ([1.0, 2.0, 3.0], ValueError, r"^origins must have shape \(n, 3\), not \(3,\); write \[\["),
        (np.zeros((3, 4)), ValueError, r"^origins must have shape \(n, 3\), not \(3, 4\)$"),
        (1.0, ValueError, r"^origins must have shape"),
        ([[0, 0, 0], [0, np.nan, 0]], ValueError, r"^origins has NaN or infinite .*entry 1$"),
        ([[np.inf, 0, 0], [0, 0, -np.inf]], ValueError, r"entry 0 and 1 more$"),
        ([[1, 2, 3], [4, 5]], ValueError, r"^origins must be a rectangular array"),
        ([["a", "b", "c"]], TypeError, r"^origins must hold real numbers"),
        ([[1j, 0, 0]], TypeError, r"^origins must hold real numbers"),
        (None, TypeError, r"^origins must hold real numbers"),
    ],
)
def test_bad_vectors(backend: hb.Backend, value: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        hb.to_vector3(backend, value, "origins")


@pytest.mark.parametrize(
    ("value", "error", "message"),
    [
        ([[1.0]], ValueError, r"^t_max must be a number or have shape \(n,\), not \(1, 1\)$"),
        ([0.0, np.nan], ValueError, r"^t_max has NaN values: entry 1$"),
        (np.nan, ValueError, r"^t_max has NaN values: entry 0$"),
        ("far", TypeError, r"^t_max must hold real numbers"),
        (True, TypeError, r"^t_max must hold real numbers"),
    ],
)
def test_bad_numbers(backend: hb.Backend, value: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        hb.to_float(backend, value, "t_max")


def test_drjit_arrays_of_the_wrong_kind(backend: hb.Backend) -> None:
    with pytest.raises(TypeError, match=r"^origins must be a 3-vector, got Array2f"):
        hb.to_vector3(backend, backend.Array2f(1), "origins")
    with pytest.raises(TypeError, match=r"^origins must be a 3-vector"):
        hb.to_vector3(backend, backend.Float(1), "origins")
    with pytest.raises(TypeError, match=r"^t_max must be one number a lane"):
        hb.to_float(backend, backend.Array3f(1), "t_max")
    with pytest.raises(TypeError, match=r"^t_max: expected floats"):
        hb.to_float(backend, backend.UInt32(1), "t_max")
    elsewhere = hb.Backend("cuda", "single", *[None] * 8)
    with pytest.raises(TypeError, match=r"lives on llvm, but the computation runs on cuda"):
        hb.to_float(elsewhere, hb.backend_of(backend.Float(1)).Float(1), "t_max")


def test_numbers_too_large_for_single_precision() -> None:
    single, double = hb.choose_backend("single"), hb.choose_backend("double")
    with pytest.raises(ValueError, match=r"^points has 1e\+39, too large for single precision"):
        hb.to_vector3(single, [[0, 1e39, 0]], "points")
    with pytest.raises(ValueError, match=r"^level has -1e\+300, too large"):
        hb.to_float(single, -1e300, "level")
    np.testing.assert_array_equal(hb.to_numpy(hb.to_float(double, 1e300)), [1e300])


def test_aligned_memory_is_aligned_and_its_own(backend: hb.Backend) -> None:
    kind = np.float64 if backend.precision == "double" else np.float32
    for offset in range(1, 8):
        source = np.arange(40, dtype=kind)[offset:]
        expected = source.copy()
        buffer = hb.upload_floats(backend, source)
        source[:] = -1
        np.testing.assert_array_equal(hb.to_numpy(buffer), expected)
        if backend.name == "llvm":
            assert buffer.numpy().ctypes.data % 64 == 0


def test_where_memory_lies_compiles_no_kernel(backend: hb.Backend) -> None:
    integers = functools.partial(hb.arrays.upload_integers, backend)
    for upload in (functools.partial(hb.upload_floats, backend), integers):
        dr.eval(upload(np.arange(40)) + 1)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            for offset in range(1, 17):
                memory = np.arange(80, dtype=np.uint32)[offset : 40 + offset]
                np.testing.assert_array_equal(hb.to_numpy(upload(memory) + 1), memory + 1)
            kernels = dr.kernel_history((dr.KernelType.JIT,))
        assert len(kernels) == 16
        assert all(one["cache_hit"] for one in kernels)


def test_aligned_takes_strided_arrays_and_only_one_dimension(backend: hb.Backend) -> None:
    table = np.arange(12.0).reshape(4, 3)
    np.testing.assert_array_equal(hb.to_numpy(hb.upload_floats(backend, table[:, 1])), table[:, 1])
    with pytest.raises(ValueError, match="one-dimensional"):
        hb.upload_floats(backend, table)


def test_to_numpy_of_lanes_masks_and_other_things(backend: hb.Backend) -> None:
    vectors = backend.Array3f(1, [2, 3], 4)
    np.testing.assert_array_equal(hb.to_numpy(vectors), [[1, 2, 4], [1, 3, 4]])
    np.testing.assert_array_equal(hb.to_numpy(vectors.y > 2), [False, True])
    assert hb.to_numpy(backend.UInt32(7)).dtype == np.uint32
    for other in (np.zeros(3), 1.0, dr.matrix_t(backend.Array3f)(1)):
        with pytest.raises(TypeError, match=r"expected a Dr\.Jit array or vector"):
            hb.to_numpy(other)


# ---- the doctor ----


def test_doctor_finds_this_installation_well() -> None:
    console = Console(record=True, width=200, file=open(os.devnull, "w"))  # noqa: SIM115
    assert doctor.print_report(console)
    text = console.export_text()
    for word in ("drjit", "mitsuba", "LLVM", "backend", "kernel, single precision", "runs"):
        assert word in text


def test_doctor_says_what_to_do(tmp_path: Path) -> None:
    fake = touch(tmp_path / "libLLVM-15.so.1")
    code = (
        "from rich.console import Console; from harnack.backend import doctor\n"
        "assert not doctor.print_report(Console(width=80))\n"
    )
    done = run_python(code, HARNACK_BACKEND="llvm", DRJIT_LIBLLVM_PATH=str(fake))
    assert done.returncode == 0, done.stderr
    assert "no  backend" in done.stdout
    assert f"DRJIT_LIBLLVM_PATH names {fake}: LLVM 15 aborts the process" in done.stdout


def test_doctor_survives_a_kernel_that_ends_its_process(monkeypatch: pytest.MonkeyPatch) -> None:
    aborting = subprocess.CompletedProcess([], -6, stdout="", stderr="LLVM ERROR: Cannot select")
    monkeypatch.setattr(doctor.subprocess, "run", lambda *args, **options: aborting)
    findings = [finding for finding in doctor.diagnose() if finding.subject.startswith("kernel")]
    assert len(findings) == 2
    for finding in findings:
        assert not finding.ok
        assert "Cannot select" in finding.detail
        assert "DRJIT_LIBLLVM_PATH" in finding.advice


def test_numbers_of_a_field_that_single_precision_cannot_hold_are_refused() -> None:
    backend = hb.choose_backend("single")
    with pytest.raises(ValueError, match="too large for single precision"):
        hb.upload_floats(backend, np.array([1.0, 1e39]))


def test_rows_have_frames() -> None:
    """Both functions for an orthonormal basis agree, at the poles as well."""
    rng = np.random.default_rng(3)
    d = np.concatenate([rng.normal(size=(200, 3)), [[0, 0, 1], [0, 0, -1], [1e-9, 0, -1]]])
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    u, v = orthonormal_basis_rows(d)
    frame = np.stack([u, v, d], axis=1)
    np.testing.assert_allclose(frame @ frame.transpose(0, 2, 1), np.tile(np.eye(3), (203, 1, 1)),
                               atol=1e-14)  # fmt: skip
    np.testing.assert_allclose(np.linalg.det(frame), 1.0, atol=1e-14)
    backend = hb.choose_backend("double")
    on_backend = orthonormal_basis(hb.to_vector3(backend, d))
    for ours, theirs in zip((u, v), on_backend, strict=True):
        np.testing.assert_allclose(ours, hb.to_numpy(theirs), atol=1e-15)


@pytest.mark.slow
def test_names_are_imported_where_they_are_first_used() -> None:
    """Importing the package imports no more than Dr.Jit, and every name there is can be had."""
    code = """
import sys
import harnack as hk
rooms = {name.split(".")[1] for name in sys.modules if name.startswith("harnack.")}
print(sorted(rooms))
assert all(getattr(hk, name) is not None for name in hk.__all__)
assert set(hk.__all__) <= set(dir(hk))
try:
    hk.traec
except AttributeError as error:
    print(error)
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    rooms, missed = run.stdout.splitlines()
    assert rooms == "['_version', 'backend', 'name_suggestions']"
    assert missed == "module 'harnack' has no attribute 'traec'; did you mean \"trace\"?"


def test_records_that_fill_no_whole_iteration_need_a_padding_row() -> None:
    message = "3 records are no multiple of at_once=2: give `padding_row`"
    with pytest.raises(ValueError, match=f"^{message}$"):
        RecordTable.upload(hb.choose_backend(), np.zeros((3, 2)), at_once=2)
