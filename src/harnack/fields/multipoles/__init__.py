"""Far sums of dipoles as multipoles, with bounds of what they leave out."""
