"""Namespace of checks before 3D printing: problems that a slicer would report, and the thickness of
walls."""

from __future__ import annotations

from harnack.meshing import PrintCheck, PrintProblem, WallThickness, check_print, wall_thickness

__all__ = ["PrintCheck", "PrintProblem", "WallThickness", "check_print", "wall_thickness"]
