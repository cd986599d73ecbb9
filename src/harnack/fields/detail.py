"""Detail: how closely a field is evaluated, where that can be chosen, and what is left out.

A sum over a tree takes clusters of far terms as a whole. The farther off these have to be, the less
is left out, and the longer it takes. Far from the surface much may be left out: the tracer begins
coarsely and asks for detail where what is left out makes steps shorter.
"""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING, Any, cast

if TYPE_CHECKING:
    from harnack.backend import Backend, Real
    from harnack.fields.field import Field

# A detail at which nothing is left out.
NO_TRUNCATION = 1e9


class Detail:
    """What a field of many details is asked for, and what one that has a single one answers."""

    has_detail: bool = False
    """Whether f can be evaluated more coarsely and more closely; then `at_detail` is needed."""

    coarsest_detail: float = 1.0
    """What detail 0 amounts to, as a detail in (0, 1]: see `at_detail`."""

    def at_detail(self, detail: Real) -> Field:
        """This field, evaluated so closely in each lane: 0 as coarsely as the field allows, 1 as
        `evaluate` does, more than 1 more closely.

        `Sample.truncation` falls about as detail^-3 and is 0 for a detail that is large enough.
        A coarse sample is as true as any: it states a larger `error`. The tracer asks for detail
        where that error matters.
        """
        del detail
        return cast("Field", self)

    def without_truncation(self, backend: Backend) -> Field:
        """This field, prepared for the backend, with nothing left out when it is evaluated."""
        if not self.has_detail:
            return cast("Field", self)
        closely: Any = copy.copy(self)
        closely.evaluate = self.at_detail(backend.Float(NO_TRUNCATION)).evaluate
        return closely
