"""Formulas as data: a formula is recorded as a tape, a list of instructions, which a loop on the
backend interprets. So a kernel does not grow with the formula, and in each cell of a grid only
those instructions are run that can matter there."""
