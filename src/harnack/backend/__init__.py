"""Dr.Jit backends and precisions, arrays, loops and tables on them, and a check that Dr.Jit has
loaded a usable LLVM. A backend is the device that runs Dr.Jit's kernels: the CPU by LLVM, or a GPU
by CUDA or Metal. This package contains no mathematics of fields.

Importing this package decides which LLVM Dr.Jit loads (see `harnack.backend.llvm`). So it must come
before any other import of drjit: `harnack/__init__.py` imports it first.
"""

from __future__ import annotations

from harnack.backend.llvm import LLVMNotFoundError, import_drjit

import_drjit()  # loads LLVM with it, so it comes before whatever else imports drjit

from harnack.backend.arrays import (  # noqa: E402
    Backend,
    BackendName,
    Index,
    Mask,
    Precision,
    Real,
    Vec3,
    backend_of,
    choose_backend,
    to_float,
    to_numpy,
    to_vector3,
    upload_floats,
)
from harnack.backend.validation import BoolArray, FloatArray, IntArray  # noqa: E402

__all__ = [
    "Backend",
    "BackendName",
    "BoolArray",
    "FloatArray",
    "Index",
    "IntArray",
    "LLVMNotFoundError",
    "Mask",
    "Precision",
    "Real",
    "Vec3",
    "backend_of",
    "choose_backend",
    "to_float",
    "to_numpy",
    "to_vector3",
    "upload_floats",
]
