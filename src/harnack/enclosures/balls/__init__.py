"""Proofs by harmonic balls: Harnack's inequality and what is sharper."""
