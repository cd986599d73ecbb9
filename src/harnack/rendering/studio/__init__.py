"""A photo studio for surfaces: stage, camera, lights and materials."""
