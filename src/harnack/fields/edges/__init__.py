"""The solid angle of an edge: value, derivatives, and bounds of how they vary."""
