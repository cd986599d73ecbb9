"""Functions in closed form: harmonic polynomials, waves, and functions of a complex variable. One
that jumps belongs here as well, unless it is of a mesh or a curve (`solid_angles`)."""
