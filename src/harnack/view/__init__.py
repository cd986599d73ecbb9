"""Surfaces that turn under a mouse, drawn by the visitor's own GPU."""

from __future__ import annotations

from harnack.view.page import page

__all__ = ["page"]
