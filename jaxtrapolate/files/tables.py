"""Frozen dataclasses from tables of plain values, as TOML and JSON have them, strictly."""

import dataclasses
import types
import typing
from collections.abc import Mapping
from typing import Any, Literal, TypeVar

T = TypeVar("T")


def parse(cls: type[T], table: Mapping[str, Any], *, where: str = "") -> T:
    """A frozen dataclass from a table of plain values, whose names and types must fit; `where` is the table's name.

    Integers stand for real numbers, arrays for tuples, tables for dataclasses; a field that may be `None` is left out.

    Raises:
        ValueError: one line that names the key, what was expected, and what is there.
    """
    prefix = f"{where}." if where else ""
    fields = {f.name: f for f in dataclasses.fields(cls)}  # type: ignore[arg-type]
    for key in table:
        if key not in fields:
            raise ValueError(f"{prefix}{key}: no such setting; there are {', '.join(fields) or 'none'}")
    hints = typing.get_type_hints(cls)
    values = {key: _convert(hints[key], value, f"{prefix}{key}") for key, value in table.items()}
    needed = (f for f in fields.values() if f.name not in values)
    for field in needed:
        if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            raise ValueError(f"{prefix}{field.name}: missing; it has no default")
    try:
        return cls(**values)
    except ValueError as error:
        raise ValueError(f"{prefix}{error}") from None


def _convert(hint: Any, value: Any, where: str) -> Any:
    """A plain value as what a type hint asks for."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if hint is Any:
        return value
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        if not isinstance(value, Mapping):
            raise ValueError(f"{where}: expected a table, got {value!r}")
        return parse(hint, value, where=where)
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in arguments:  # in JSON; TOML has no null
            return None
        (hint,) = (a for a in arguments if a is not type(None))
        return _convert(hint, value, where)
    if origin is Literal:
        if value not in arguments or isinstance(value, bool):
            raise ValueError(f"{where}: expected one of {', '.join(map(repr, arguments))}, got {value!r}")
        return value
    if origin is tuple:
        repeated = len(arguments) == 2 and arguments[1] is Ellipsis
        if not isinstance(value, list | tuple) or not (repeated or len(value) == len(arguments)):
            raise ValueError(f"{where}: expected an array{'' if repeated else f' of {len(arguments)}'}, got {value!r}")
        each = [arguments[0]] * len(value) if repeated else arguments
        return tuple(_convert(a, v, f"{where}[{i}]") for i, (a, v) in enumerate(zip(each, value, strict=True)))
    names = {bool: "true or false", int: "an integer", float: "a number", str: "a text"}
    accepted: Any = (int, float) if hint is float else hint
    if isinstance(value, bool) is not (hint is bool) or not isinstance(value, accepted):
        raise ValueError(f"{where}: expected {names[hint]}, got {value!r}")
    return float(value) if hint is float else value
