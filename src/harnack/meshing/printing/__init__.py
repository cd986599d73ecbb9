"""Closed meshes: solids with caps, thick surfaces, simplified meshes."""
