"""The solid angle of closed curves."""
