"""Neural networks whose level sets are surfaces: multilayer perceptrons of a point, with one
value."""
