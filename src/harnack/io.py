"""Namespace of input and output: outlines from SVG files and text, surface files in, mesh files
out, and files and arrays of other libraries."""

from __future__ import annotations

from harnack.backend.tensors import wrap_for_jax, wrap_for_torch
from harnack.cluster.zarr_files import to_zarr
from harnack.field_from_file import field_from_file
from harnack.files import outline
from harnack.mesh_to_file import write_mesh

__all__ = ["field_from_file", "outline", "to_zarr", "wrap_for_jax", "wrap_for_torch", "write_mesh"]
