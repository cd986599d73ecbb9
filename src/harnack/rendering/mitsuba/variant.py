"""Mitsuba, imported when it is first needed, with a variant that our surfaces can be drawn in."""

from __future__ import annotations

import importlib
import re
from typing import Any

from harnack.backend import Backend, backend_of, choose_backend

_USABLE = re.compile(r"(llvm|cuda|metal)_ad_(mono|rgb|spectral)(_double)?")


def load_mitsuba() -> Any:
    """The `mitsuba` module, with a variant set.

    A variant that was set before stays. If none was, it becomes cuda_ad_rgb, metal_ad_rgb or
    llvm_ad_rgb, as `harnack.backend.choose_backend` finds a device.

    Raises:
        RuntimeError: Mitsuba lacks the device's variant, or the one that is set has no vectorised
            arrays, or tracks polarization.
        LLVMNotFoundError: LLVM is wanted and there is none that Dr.Jit can work with.
    """
    mi = importlib.import_module("mitsuba")
    if mi.variant() is None:
        wanted = f"{choose_backend().name}_ad_rgb"
        if wanted not in mi.variants():
            raise RuntimeError(
                f"this Mitsuba has no variant {wanted}: set HARNACK_BACKEND=llvm to draw on the CPU"
            )
        mi.set_variant(wanted)
    elif _USABLE.fullmatch(mi.variant()) is None:
        raise RuntimeError(
            f"the Mitsuba variant is {mi.variant()}, and surfaces are traced with Dr.Jit arrays "
            "that have derivatives and no polarization: call "
            'mitsuba.set_variant("llvm_ad_rgb") or ("cuda_ad_rgb") before the scene is made'
        )
    return mi


def mitsuba_backend(mi: Any) -> Backend:
    """Our name for the arrays of the variant that is set."""
    return backend_of(mi.Float(0))
