"""Data on a backend, in coordinates in which they have a size of about one, and their fields."""

from __future__ import annotations

import abc
import copy
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Generic, TypeVar

import drjit as dr
import numpy as np

from harnack.backend import backend_of
from harnack.fields.field import AtDetail, Field
from harnack.fields.field_cache import prepared_once

if TYPE_CHECKING:
    from typing import Self

    from harnack.backend import Backend, FloatArray, Real, Vec3
    from harnack.fields.look import Sample


@dataclass(frozen=True)
class UnitCoordinates:
    """The way to coordinates center + size times these; what lies there, subclasses say."""

    backend: Backend
    center: Vec3
    size: Real

    def unit(self, p: Vec3) -> Vec3:
        """A point in these coordinates."""
        return (self.backend.Array3f(p) - self.center) / self.size


Uploaded = TypeVar("Uploaded", bound=UnitCoordinates)


class UploadedField(Field, Generic[Uploaded]):
    """A field that is evaluated by data on a backend. Subclasses define `_upload`."""

    def __init__(self) -> None:
        self._device: Uploaded | None = None
        self._batches: dict[Backend, Uploaded] = {}

    @abc.abstractmethod
    def _upload(self, backend: Backend, *, traced: bool) -> Uploaded:
        """The data, for tracing or for values at points."""

    @prepared_once
    def prepare(self, backend: Backend) -> Self:
        if self._device is not None and self._device.backend is backend:
            return self
        prepared = copy.copy(self)
        prepared._device = self._upload(backend, traced=True)
        return prepared

    def _on(self, p: Vec3) -> Uploaded:
        """The data for tracing, on the backend of p where `prepare` was not called."""
        if self._device is None:
            return self._upload(backend_of(p), traced=True)
        return self._device

    def _prepared(self) -> Uploaded:
        """The data for tracing; RuntimeError where `prepare` was not called."""
        if self._device is None:
            raise RuntimeError("prepare(backend) comes first, before at_detail")
        return self._device

    def _batch(self, backend: Backend) -> Uploaded:
        """The data for values at points, which are uploaded once a backend."""
        if backend not in self._batches:
            self._batches[backend] = self._upload(backend, traced=False)
        return self._batches[backend]


class DetailedField(UploadedField[Uploaded]):
    """One that is evaluated more coarsely or more closely. Subclasses define `_sample`."""

    has_detail = True

    values_take_more: ClassVar[bool] = True
    """Whether `_upload` of values at points differs from that for tracing."""

    @abc.abstractmethod
    def _sample(self, on: Uploaded, p: Vec3, detail: Real) -> Sample:
        """f at p from the data, at a detail (`Field.at_detail`)."""

    def evaluate(self, p: Vec3) -> Sample:
        on = self._on(p)
        return self._sample(on, p, on.backend.Float(1))

    def at_detail(self, detail: Real) -> Field:
        on = self._prepared()
        return AtDetail(lambda p: self._sample(on, p, detail))

    def _batch(self, backend: Backend) -> Uploaded:
        device = self._device
        if self.values_take_more or device is None or device.backend is not backend:
            return super()._batch(backend)
        return device


def single(center: FloatArray) -> FloatArray:
    """The nearest center that single precision holds exactly: to subtract it from points nearby
    then rounds nothing, however far the origin is."""
    with np.errstate(over="ignore"):
        rounded = center.astype(np.float32).astype(np.float64)
    return np.where(np.isfinite(rounded), rounded, center)


def placed(backend: Backend, center: FloatArray, size: float) -> tuple[Backend, Vec3, Real]:
    """What `UnitCoordinates` consist of; neither becomes part of a kernel's code."""
    opaque = (dr.opaque(backend.Float, float(c)) for c in center)
    return backend, backend.Array3f(*opaque), dr.opaque(backend.Float, size)


def epsilon_at(x: Vec3) -> Real:
    """What rounding may do to a coordinate of x, or of a vertex of size about one."""
    return float(dr.epsilon(x)) * (1 + dr.max(dr.abs(x)))
