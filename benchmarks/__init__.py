"""Benchmarks: `make bench` runs them, and they write their own tables into the docs."""

import harnack  # noqa: F401  # before Dr.Jit, so that this loads an LLVM that works
