"""Errors of meshing, and whether it is worthwhile to try again with smaller cells."""

from __future__ import annotations

from harnack.backend import FloatArray, IntArray

__all__ = [
    "CELL_SIZE_RATIO",
    "EmptySurfaceError",
    "LocalizedMeshingError",
    "MeshingError",
    "OffLevelError",
    "SelfIntersectionError",
    "TriangleLimitError",
    "UnrefinableError",
    "is_retry_promising",
    "point_text",
]

# The ratio of the size of smaller cells to the size before, if meshing is tried again.
CELL_SIZE_RATIO = 0.6


class MeshingError(ValueError):
    """A level set could not be meshed. The message says why, and names a remedy."""

    def may_be_fixed_by(self, smaller: float) -> bool:
        """Whether smaller cells of the lattice may avoid the error.

        smaller: the size of the smaller cells, as a fraction of the size of the cells that failed.
        """
        del smaller
        return True


class EmptySurfaceError(MeshingError):
    """The level set is empty: no cell of the lattice contains a point of it."""


class LocalizedMeshingError(MeshingError):
    """A check failed at known locations, so that smaller cells there may be enough.

    locations: (k, 3) points.
    is_explained: whether a cause was looked for (`add`).
    """

    def __init__(self, message: str, places: FloatArray) -> None:
        super().__init__(message)
        self.locations, self.is_explained = places, False

    def add(self, advice: str) -> None:
        """Add a text, which may be empty, to the end of the message: the cause of the failure."""
        self.args, self.is_explained = (f"{self}{advice}",), True


class OffLevelError(LocalizedMeshingError):
    """Vertices or centers of faces are farther from the level set than the tolerance; `locations`
    holds these points."""


class SelfIntersectionError(LocalizedMeshingError):
    """Triangles pass through each other.

    faces: (k,) the indices of these triangles.
    locations: (k, 3) their centers.
    """

    def __init__(self, message: str, places: FloatArray, faces: IntArray) -> None:
        super().__init__(message, places)
        self.faces = faces


class UnrefinableError(MeshingError):
    """An error that smaller cells of the lattice do not avoid."""

    def may_be_fixed_by(self, smaller: float) -> bool:
        """False: no cells are small enough. `smaller`, the size to be tried, plays no part."""
        del smaller
        return False


class TriangleLimitError(UnrefinableError):
    """The mesh would have more triangles than allowed, and was not begun."""


# Smaller cells are tried again if there are no more failures than the first, or than the second
# times the number of failures before.
_MAX_FAILURES_FOR_RETRY, _REQUIRED_FAILURE_REDUCTION = 20, 0.5


def is_retry_promising(
    now: MeshingError, before: MeshingError | None, smallest: float = 1.0
) -> bool:
    """Whether to try again with smaller cells after an attempt at meshing failed. It is not
    worthwhile if smaller cells cannot help. Nor is it worthwhile if a check failed at more than 20
    places, and at more than half as many as in the attempt before. That happens along a pole of the
    function, or where surfaces on which it jumps cross: there cells of every size fail.

    now: the error of the last attempt.
    before: the error of the attempt before it, or None.
    smallest: the size of the smallest cells allowed, relative to the cells that failed now.
    """
    if not now.may_be_fixed_by(smallest):
        return False
    if not isinstance(now, LocalizedMeshingError) or not isinstance(before, LocalizedMeshingError):
        return True
    return len(now.locations) <= max(
        _MAX_FAILURES_FOR_RETRY, _REQUIRED_FAILURE_REDUCTION * len(before.locations)
    )


def point_text(x: FloatArray) -> str:
    """The coordinates of a point (3,) as text for messages, with four digits."""
    return "(" + ", ".join(f"{c:.4g}" for c in x) + ")"
