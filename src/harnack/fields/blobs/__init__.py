"""Sums of kernels about points: metaballs, molecules, surfaces through oriented points.
Sums of dipoles are in `solid_angles`, with the solid angles and winding numbers that they give."""
