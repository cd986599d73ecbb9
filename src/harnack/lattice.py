"""Namespace of lattices: functions that make periodic graphs of struts
(`harnack.fields.solids.lattices`)."""

from __future__ import annotations

from harnack.fields.solids.lattices import Lattice, bcc, cubic, diamond, fcc, kagome, octet

__all__ = ["Lattice", "bcc", "cubic", "diamond", "fcc", "kagome", "octet"]
