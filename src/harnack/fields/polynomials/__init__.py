"""Harmonic polynomials and what is known of them near a point."""
