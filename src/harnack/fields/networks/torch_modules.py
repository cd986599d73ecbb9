"""The layers of PyTorch's modules, without importing PyTorch: a module is known by the name of its
class and by its attributes."""

from __future__ import annotations

from typing import Any, cast

import numpy as np

__all__ = ["layers_of_modules"]

_SUPPORTED = "Linear, ReLU, Tanh, Softplus, ELU, Sine, SineLayer, Identity and Sequential"
# The names of the frequency of a sine.
_FREQUENCIES = ("w0", "omega_0", "omega0", "omega", "w_0")


def layers_of_modules(module: Any) -> tuple[list[tuple[Any, Any]], list[Any]]:
    """The weights and biases of the Linear layers of a module, and the activations between them,
    as `Network` takes them.

    Raises:
        TypeError: a module of another kind.
        ValueError: the layers and activations do not take turns.
    """
    layers: list[tuple[Any, Any]] = []
    activations: list[Any] = []
    for entry in _flattened(module):
        is_layer = _is_layer(entry)
        if is_layer != (len(layers) == len(activations)):
            wanted = "a Linear layer" if len(layers) == len(activations) else "an activation"
            number = len(layers) + len(activations)
            raise ValueError(
                f"module {number} of the network should be {wanted}: Linear layers and activations "
                "take turns"
            )
        if is_layer:
            layers.append(entry)
        else:
            activations.append(entry)
    if len(layers) == len(activations):
        raise ValueError("the network must end with a Linear layer, not with an activation")
    return layers, activations


def _is_layer(entry: Any) -> bool:
    """Whether an entry of `_flattened` is a layer, and not an activation."""
    return isinstance(entry, tuple) and isinstance(cast("Any", entry)[0], np.ndarray)


def _flattened(module: Any) -> list[Any]:
    """The layers, as pairs of arrays, and the activations of a module, in order."""
    name = type(module).__name__
    if name in ("Sequential", "ModuleList"):
        return [entry for child in module.children() for entry in _flattened(child)]
    if name == "Identity":
        return []
    if name == "Linear":
        weights = _numbers(module.weight)
        bias = np.zeros(len(weights)) if module.bias is None else _numbers(module.bias)
        return [(weights, bias)]
    if name == "SineLayer":
        return [*_flattened(module.linear), ("sine", _frequency(module, name))]
    if name == "Sine":
        return [("sine", _frequency(module, name))]
    if name == "Softplus":
        return [("softplus", float(module.beta))]
    if name == "ELU":
        return [("elu", float(module.alpha))]
    if name in ("ReLU", "Tanh"):
        return [name.lower()]
    raise TypeError(f"a module {name} is not supported: {_SUPPORTED} are")


def _frequency(module: Any, name: str) -> float:
    """The frequency of a sine."""
    for attribute in _FREQUENCIES:
        if hasattr(module, attribute):
            return float(getattr(module, attribute))
    raise TypeError(
        f"a module {name} needs its frequency as an attribute named one of "
        f"{', '.join(_FREQUENCIES)}"
    )


def _numbers(tensor: Any) -> Any:
    """The numbers of a tensor as an array."""
    for method in ("detach", "cpu", "numpy"):
        tensor = getattr(tensor, method)() if hasattr(tensor, method) else tensor
    return np.asarray(tensor, np.float64)
