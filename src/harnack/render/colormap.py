"""Numbers as colours."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

# Polynomials of degree 6 in sRGB, least-squares fits of "viridis" (S. van der Walt, N. Smith,
# matplotlib, 2015, CC0), highest degree last.
