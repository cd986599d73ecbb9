# As for drjit: Mitsuba's types depend on the variant chosen at run time, so here it is Any.
from typing import Any

def __getattr__(name: str) -> Any: ...
