"""A figure: the content of the paper's figure, and the counterpart with its measurements."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from PIL import Image

import harnack as hk


@dataclass(frozen=True)
class Report:
    """The result of making a figure.

    picture: all panels in one picture. caption: a description of the picture, with measurements.
    differs: the differences from the paper's figure. is_plot: a drawing, stored without loss.
    """

    picture: Image.Image
    caption: str
    differs: str
    is_plot: bool = False


@dataclass(frozen=True)
class Figure:
    """A figure of the paper and its counterpart.

    paper: the content of the paper's figure, in our words. make: from the width of one panel in
    pixels to the report; smaller panels are measured on fewer rays.
    """

    number: int
    title: str
    paper: str
    make: Callable[[int], Report]


@dataclass(frozen=True)
class Counts:
    """Counts of the evaluations and results of n rays, one for each pixel."""

    rays: int
    hits: int
    out_of_steps: int
    evaluations: float
    evaluations_hitting: float
    most: int

    @classmethod
    def of(cls, status: npt.NDArray[np.int64], evaluations: npt.NDArray[np.int64]) -> Counts:
        """From the status and the number of evaluations of each ray, in arrays of one shape."""
        hit = status == int(hk.RayStatus.HIT)
        lost = status == int(hk.RayStatus.OUT_OF_STEPS)
        hitting = float(evaluations[hit].mean()) if hit.any() else 0.0
        return cls(
            status.size, int(hit.sum()), int(lost.sum()), float(evaluations.mean()), hitting,
            int(evaluations.max()),
        )  # fmt: skip

    def __str__(self) -> str:
        lost = "none" if self.out_of_steps == 0 else f"{self.out_of_steps:,}"
        return (
            f"{self.evaluations:.1f} evaluations a ray, {self.evaluations_hitting:.1f} a hitting "
            f"one, {self.most} at most ({self.rays:,} rays, {self.hits:,} hits, {lost} out of "
            "steps)"
        )
