"""Tests of formulas as tapes."""
