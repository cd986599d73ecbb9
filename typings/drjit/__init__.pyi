# Dr.Jit's own stubs are generic over array types that exist at run time only; under pyright's
# strict mode nearly every call is then "partially unknown". Here Dr.Jit is Any, as the aliases in
# harnack.backend (Real, Vec3, Mask) say it is.
from typing import Any

def __getattr__(name: str) -> Any: ...
