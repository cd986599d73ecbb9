"""Parameters by name: the numbers and arrays that the constructor of an object takes, and new
objects in which some of them are exchanged. They are read from the attributes in which the object
stores the arguments of its constructor. Numbers inside of an argument have names with dots, such as
"parts.0.radius" for the radius of the first of several spheres."""

from __future__ import annotations

import dataclasses
import inspect
import numbers
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any, cast

import drjit as dr
import numpy as np

from harnack.backend.validation import check_no_derivatives
from harnack.geometry.volume import Volume, check_volume
from harnack.name_suggestions import did_you_mean, with_article

if TYPE_CHECKING:
    from typing import Self

# A message lists at most so many names.
_MAX_LISTED = 30
_NOTHING = object()


@dataclass(frozen=True)
class ConstructorCall:
    """What is remembered of the call that made an object.

    maker: the name of the class method that was called; "" for the class itself.
    argument_names: the names of the arguments of the call.
    choices: those of them that are strings, booleans or None, such as method="auto".
    kept: those that are not copied by constructors, such as numbers, functions, volumes and
        Dr.Jit arrays. NumPy arrays, lists and mappings are not kept: the object stores its own
        copies as attributes. (But those with Dr.Jit numbers in them are, where a field has
        derivatives by these.)
    """

    maker: str = ""
    argument_names: tuple[str, ...] = ()
    choices: dict[str, Any] = field(default_factory=dict[str, Any])
    kept: dict[str, Any] = field(default_factory=dict[str, Any])

    @classmethod
    def of(cls, maker: str, arguments: Mapping[str, Any]) -> ConstructorCall:
        """The call of a maker with these arguments, by name."""
        choices = {name: value for name, value in arguments.items() if _is_choice(value)}
        kept = {name: value for name, value in arguments.items() if _is_kept(value)}
        return cls(maker, tuple(arguments), choices, kept)


def _is_choice(value: Any) -> bool:
    """Whether a value is None, a text or a boolean."""
    return value is None or isinstance(value, str | bool | np.bool_)


def _is_kept(value: Any) -> bool:
    """Whether a value is a number, a path, a volume, a field, a function, a dataclass or a Dr.Jit
    array."""
    if type(value) in (float, int, tuple):  # the most frequent types
        return type(value) is not tuple
    kinds = numbers.Number, os.PathLike, Volume, Parametrized
    is_structure = dataclasses.is_dataclass(value) or _is_drjit(value)
    return isinstance(value, kinds) or callable(value) or is_structure


@lru_cache(maxsize=256)
def _signature(kind: type, maker: str) -> inspect.Signature:
    """The signature, without self, of a class method of the class `kind`, or of its constructor for
    the name ""."""
    if maker:
        return inspect.signature(getattr(kind, maker))
    whole = inspect.signature(cast("Any", kind).__init__)
    return whole.replace(parameters=[*whole.parameters.values()][1:])


@lru_cache(maxsize=256)
def _plain_names(kind: type, maker: str) -> tuple[int, tuple[str, ...]]:
    """How many positional arguments a class method or constructor (`_signature`) needs, and the
    names of all that it takes, so that calls with these alone, as of the many parts of a model,
    need not be bound to the signature; (1, ()) if it has parameters of other kinds."""
    parameters = _signature(kind, maker).parameters.values()
    if any(p.kind is not inspect.Parameter.POSITIONAL_OR_KEYWORD for p in parameters):
        return 1, ()
    required = sum(p.default is inspect.Parameter.empty for p in parameters)
    return required, tuple(p.name for p in parameters)


def record_call(
    instance: Any, args: tuple[Any, ...], kwargs: Mapping[str, Any], maker: str = ""
) -> None:
    """Remember the call that makes an object, for `Parametrized.replace`. An argument `domain` is
    checked first, here for all classes.

    instance: the object.
    args, kwargs: the arguments of the call. If these are no arguments of the maker, so that it is
        going to raise an error, nothing is remembered.
    maker: the name of the class method that is called; "" for the class itself.

    Raises:
        TypeError: the argument `domain` is neither a volume nor None.
    """
    kind = cast("Any", type(instance))
    required, names = _plain_names(kind, maker)
    if not kwargs and required <= len(args) <= len(names):
        arguments = dict(zip(names, args, strict=False))
    else:
        signature = _signature(kind, maker)
        try:
            arguments = dict(signature.bind(*args, **kwargs).arguments)
        except TypeError:
            return
        for name, parameter in signature.parameters.items():
            # The entries of **kwargs are arguments of their own.
            if parameter.kind is inspect.Parameter.VAR_KEYWORD:
                arguments |= arguments.pop(name, {})
    check_volume(arguments.get("domain"), "domain")
    vars(instance)["_constructor_call"] = ConstructorCall.of(maker, arguments)


def record_arguments(instance: Any, **arguments: Any) -> None:
    """Take these arguments for those with which an object was made, in place of the ones that were
    given, such as a number that was found for "auto"."""
    call = _call_of(instance)
    old = dict.fromkeys(call.argument_names, _NOTHING) | call.choices | call.kept
    vars(instance)["_constructor_call"] = ConstructorCall.of(call.maker, old | arguments)


def _call_of(instance: object) -> ConstructorCall:
    """The call that made an object, as far as it is known."""
    return vars(instance).get("_constructor_call", ConstructorCall())


def kept_arguments(instance: object) -> dict[str, Any]:
    """The arguments of the call that made an object that are kept as they were given
    (`ConstructorCall`)."""
    return _call_of(instance).kept


def attributes_of(instance: object) -> dict[str, Any]:
    """The attributes of an object, which may be changed."""
    return vars(instance)


class Parametrized:
    """An object whose parameters, the numbers and arrays in the arguments of its constructor, have
    names."""

    def constructor_arguments(self) -> dict[str, Any]:
        """The arguments of the constructor by name, in the form in which it takes them.

        The default knows the numbers, functions, volumes and fields that were given. All else it
        finds in the attribute `_name` or `name`, which may be a property, for an argument `name`;
        and of what was not given and is no attribute, it takes the default of the constructor. A
        class that stores an array, a list or a mapping under another name, or in another form,
        overrides this method.
        """
        call = _call_of(self)
        parameters = _signature(type(self), call.maker).parameters
        arguments: dict[str, Any] = {}
        for name in dict.fromkeys((*parameters, *call.argument_names)):
            # A kept argument; else what the object stores; else a choice that was given, or the
            # default.
            if name in call.kept:
                value = call.kept[name]
            elif (value := _stored(self, name)) is _NOTHING and name in call.argument_names:
                value = call.choices.get(name, _NOTHING)
            elif value is _NOTHING and parameters[name].default is not inspect.Parameter.empty:
                value = parameters[name].default
            if value is not _NOTHING:
                arguments[name] = value
        return arguments

    def parameters(self) -> dict[str, Any]:
        """The parameters by name: the numbers, NumPy arrays and Dr.Jit arrays in the arguments of
        the constructor. What is inside of an argument that is a list, a mapping, another field or a
        map of space has a name with dots: in a union of a box and a sphere, "parts.1.radius" is the
        radius of the sphere. Texts, booleans, functions and volumes are no parameters.
        """
        arguments = self.constructor_arguments().items()
        return dict(entry for name, value in arguments for entry in _named(name, value))

    def replace(self, **changes: Any) -> Self:
        """A new field, made by the same constructor with some parameters exchanged.

        changes: values by the names of `parameters()`, or by the names of arguments of the
            constructor. Names with dots are given as replace(**{"parts.1.radius": 2.0}).

        What the constructor computed itself (areas, domains and methods that were not given) is
        computed anew. Attributes that were set afterwards are not carried over.

        Raises:
            TypeError: an unknown name; or the class does not store an argument of its constructor.
            NotImplementedError: values with derivatives enabled, which would be lost.
            The errors of the constructor, which checks the new values.
        """
        if not _keeps_derivatives(self):  # also of what is only a part of an argument
            check_no_derivatives(type(self).__name__, changes)
        call, arguments = _call_of(self), self.constructor_arguments()
        signature = _signature(type(self), call.maker)
        self._check_names(changes, {*arguments, *signature.parameters})
        # What was left to the constructor, which is no argument of the call, is left to it again.
        new_arguments = {
            name: call.choices[name] if name in call.choices else arguments.get(name, _NOTHING)
            for name in call.argument_names
        }
        for name, inside in _by_part({*arguments, *signature.parameters}, changes).items():
            new_arguments[name] = _exchanged(arguments.get(name), inside)
        for name, value in new_arguments.items():
            if value is _NOTHING:
                raise TypeError(
                    f"{with_article(type(self).__name__)} does not store the argument {name!r} "
                    f"of its constructor: store it as an attribute {name!r}, or define "
                    "constructor_arguments()"
                )
        make = getattr(type(self), call.maker) if call.maker else type(self)
        # Names that the signature lacks are passed on by the constructor's **kwargs.
        further_arguments = {
            name: new_arguments.pop(name)
            for name in [*new_arguments]
            if name not in signature.parameters
        }
        bound = inspect.BoundArguments(signature, cast("Any", new_arguments))
        return make(*bound.args, **bound.kwargs, **further_arguments)

    def _check_names(self, changes: Mapping[str, Any], arguments: set[str]) -> None:
        """Raise TypeError if a change is none of a parameter, of a part of an argument, or of an
        argument."""
        parameters = self.parameters()
        # "parts.1" and "parts" too, for the parameter "parts.1.radius".
        known = {*parameters, *arguments}
        for name in parameters:
            while name := name.rpartition(".")[0]:
                known.add(name)
        for name in changes:
            if name not in known:
                listed = [*parameters][:_MAX_LISTED]
                more = ", ..." if len(parameters) > _MAX_LISTED else ""
                raise TypeError(
                    f"{with_article(type(self).__name__)} has no parameter {name!r}"
                    f"{did_you_mean(name, sorted(known))}; there are {', '.join(listed)}{more}"
                )


ATTACHED = "_has_attached_numbers"
"""The attribute of fields that were made of numbers with derivatives
(`Traits.differentiable_arguments`), or of such fields. Other fields lack it."""


def _keeps_derivatives(instance: Any) -> bool:
    """Whether an object is a field whose traits say that some of its parameters may have
    derivatives."""
    traits = getattr(instance, "traits", None)
    return traits is not None and bool(
        traits.has_parameter_derivatives or traits.differentiable_arguments
    )


def differentiable_parameters(instance: Parametrized) -> tuple[Any, ...]:
    """The parameters of an object that are Dr.Jit arrays, with respect to which f can be
    differentiated, such as the vertices of a curve that is optimized. There are none unless the
    object is a field whose traits say `has_parameter_derivatives`."""
    traits = getattr(instance, "traits", None)
    if traits is None or not (traits.has_parameter_derivatives or ATTACHED in vars(instance)):
        return ()
    return tuple(value for value in instance.parameters().values() if _is_drjit(value))


def _stored(instance: object, name: str) -> Any:
    """The attribute or property of an object that holds the argument `name` of its constructor;
    `_NOTHING` if there is none. Attributes of the class do not count: they are defaults."""
    for attribute in (f"_{name}", name):
        if attribute in vars(instance):
            return vars(instance)[attribute]
        # The class that defines the attribute; `object` if none does.
        kind = next((kind for kind in type(instance).__mro__ if attribute in vars(kind)), object)
        if isinstance(vars(kind).get(attribute), property | cached_property):
            return getattr(instance, attribute)
    return _NOTHING


def _named(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield the parameters in an argument, as pairs of the full name and the value.

    name, value: the full name and the value of the argument, or of a part of it.
    """
    if isinstance(value, Parametrized):
        for inner, parameter in value.parameters().items():
            yield f"{name}.{inner}", parameter
    elif _is_number(value) or _is_drjit(value) or isinstance(value, np.ndarray):
        yield name, value
    elif _is_nested_numbers(value):
        yield name, np.array(value)
    else:
        for inner, part in _parts(value).items():
            yield from _named(f"{name}.{inner}", part)


def _parts(value: Any) -> dict[str, Any]:
    """The parts of an argument by name: the entries of a list, a tuple or a mapping, and the
    attributes of a dataclass. All else, such as a number, a text or a volume, has no parts."""
    if isinstance(value, list | tuple):
        return {str(k): part for k, part in enumerate(cast("Any", value))}
    if isinstance(value, Mapping):
        return {_key_name(key): part for key, part in cast("Any", value).items()}
    if dataclasses.is_dataclass(value) and not isinstance(value, Volume | type):
        return {entry.name: getattr(value, entry.name) for entry in _init_fields(value)}
    return {}


def _init_fields(value: Any) -> list[dataclasses.Field[Any]]:
    """The attributes of a dataclass that its constructor takes."""
    return [entry for entry in dataclasses.fields(value) if entry.init]


def _key_name(key: Any) -> str:
    """The name of the entry of a mapping: "2,1,0" for the key (2, 1, 0)."""
    return ",".join(map(str, cast("Any", key))) if isinstance(key, tuple) else str(key)


def _by_part(parts: Iterable[str], changes: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Sort changes by the part in which they are.

    parts: the names of the parts of an argument, or of arguments.
    changes: new values by names that begin with the name of a part, such as "1.radius" for "1".

    Returns for each part in which something changes: the changes, by their names inside of it, such
    as "radius"; "" for the part itself.

    Raises:
        TypeError: a change is in none of the parts.
    """
    longest_first = sorted(parts, key=len, reverse=True)  # "1.5" before "1"
    changes_by_part: dict[str, dict[str, Any]] = {}
    for changed, value in changes.items():
        part = next((name for name in longest_first if f"{changed}.".startswith(f"{name}.")), None)
        if part is None:  # of a part that is exchanged as a whole, too, and has other names now
            raise TypeError(f"there is no {changed!r} in the new value of what holds it")
        changes_by_part.setdefault(part, {})[changed.removeprefix(part).removeprefix(".")] = value
    return changes_by_part


def _exchanged(value: Any, changes: dict[str, Any]) -> Any:
    """An argument with some of what is in it exchanged.

    value: the argument, or a part of it.
    changes: new values by their names inside of the argument: "" for the argument itself.
    """
    if "" in changes:
        changes = {**changes}
        value = _in_form_of(value, changes.pop(""))
    if not changes:
        return value
    if isinstance(value, Parametrized):
        return value.replace(**changes)
    parts = _parts(value)
    new = {
        name: _exchanged(parts[name], inside) for name, inside in _by_part(parts, changes).items()
    }
    if isinstance(value, list | tuple):
        entries = [{**parts, **new}[name] for name in parts]
        return entries if isinstance(value, list) else tuple(entries)
    if isinstance(value, Mapping):
        return dict(zip(cast("Any", value), {**parts, **new}.values(), strict=True))
    return dataclasses.replace(value, **new)


def _in_form_of(old: Any, new: Any) -> Any:
    """The value `new`. If it is an array that replaces a list or tuple of numbers, `old`, it is
    made a list or tuple, too."""
    if not isinstance(new, np.ndarray) or not _is_nested_numbers(old):
        return cast("Any", new)

    def nested(entries: Any) -> Any:
        """Lists of lists as tuples of tuples."""
        return tuple(map(nested, entries)) if isinstance(entries, list) else entries  # pyright: ignore[reportUnknownArgumentType]

    entries = cast("Any", new).tolist()
    return entries if isinstance(old, list) else nested(entries)


def _is_number(value: Any) -> bool:
    """Whether a value is a number of Python or NumPy, and no boolean."""
    return not isinstance(value, bool) and isinstance(value, numbers.Number)


def _is_drjit(value: Any) -> bool:
    """Whether a value is a Dr.Jit array."""
    return dr.is_array_v(cast("Any", type(value)))


def _is_nested_numbers(value: Any) -> bool:
    """Whether a value is a list or tuple of numbers, or of such lists of equal lengths, so that it
    is an array."""
    return _shape(value) is not None and _shape(value) != ()


def _shape(value: Any) -> tuple[int, ...] | None:
    """The shape of nested lists or tuples of numbers, () for a number; None for all else, for empty
    lists and for lists of different lengths."""
    if _is_number(value):
        return ()
    if not isinstance(value, list | tuple) or not value:
        return None
    # All entries must have the same shape: then the set holds one.
    shapes = {_shape(entry) for entry in cast("Any", value)}
    shape = shapes.pop()
    return None if shapes or shape is None else (len(cast("Any", value)), *shape)
