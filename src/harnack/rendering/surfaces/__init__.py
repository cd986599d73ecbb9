"""Surfaces as rays meet them: where they are, their normals, solids. Knows no Mitsuba."""
