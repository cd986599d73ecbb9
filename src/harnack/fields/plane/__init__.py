"""Functions of the plane: height fields, Riemann surfaces, level curves."""
