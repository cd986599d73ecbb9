"""Sums of kernels about points: metaballs, molecules, surfaces through oriented points."""
