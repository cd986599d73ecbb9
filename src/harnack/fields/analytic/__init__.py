"""Functions in closed form: harmonic polynomials, waves, and functions of a complex variable."""
