"""Surfaces in Mitsuba's scenes: carriers, plug-ins, and a path tracer that sees both worlds."""
