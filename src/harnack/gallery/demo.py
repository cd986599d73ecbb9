"""The pictures of the command `harnack demo`. They are chosen such that all of them together take
less than a minute on two cores, even on a machine where no kernel was ever compiled."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["DEMO_PICTURES", "DEMO_SIZE", "DemoPicture"]

DEMO_SIZE = (640, 480)
"""Width and height of the pictures, in pixels."""


@dataclass(frozen=True)
class DemoPicture:
    """One picture of the demo: a scene of the gallery, drawn quickly.

    scene: the name of the scene.
    show: the kind of picture, as for `render`. Shaded pictures have no noise, and take a few
        seconds; only glass needs light paths.
    spp: samples per pixel.
    seconds: how long the picture takes on two cores if its kernels must be compiled first. The
        remaining time of the demo is estimated with the proportions of these numbers.
    """

    scene: str
    show: str
    spp: int
    seconds: float


# Those that are finished soonest come first.
DEMO_PICTURES = (
    DemoPicture("trefoil", "shaded", 9, 2.9),
    DemoPicture("hopf", "shaded", 9, 0.9),
    DemoPicture("carved", "shaded", 9, 3.5),
    DemoPicture("cut-mesh", "shaded", 9, 5.1),
    DemoPicture("cloud", "shaded", 9, 7.0),
    DemoPicture("gyroid", "path", 100, 16.6),
)
"""The pictures of the demo, in the order in which they are drawn: the six of the README."""
