"""Options of methods: the fields of a frozen dataclass, which is a part of what a method's functions are given.

A number that is real is a leaf of that pytree: it is traced, can be differentiated and swept, and changes without
compiling anew. All else (integers, choices, switches, tuples) sets shapes, loops or branches, and is static.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any, TypeVar, get_args

import jax
import numpy as np
from jax.core import Tracer

S = TypeVar("S")


@dataclasses.dataclass(frozen=True)
class Option:
    """What may be said of an option.

    Attributes:
        name: of the keyword.
        default: its value if nothing is said.
        value: its current value.
        doc: one line.
        low: the least number, also in a tuple; `None` where there is no bound.
        high: the greatest number, also in a tuple; `None` where there is no bound.
        choices: of a string, or of each string of a tuple.
        static: whether another value is compiled anew.
        none: whether it may be `None`.
    """

    name: str
    default: Any
    value: Any
    doc: str
    low: float | int | None = None
    high: float | int | None = None
    choices: tuple[str, ...] = ()
    static: bool = False
    none: bool = False

    @property
    def allowed(self) -> str:
        """What it may be, in words."""
        kind = self.default[0] if isinstance(self.default, tuple) else self.default
        if isinstance(kind, bool):
            said = "true or false"
        elif isinstance(kind, str):
            said = " or ".join(self.choices)
        else:
            said = "integer" if isinstance(kind, int) else "number"
            if self.low is not None and self.high is not None:
                said = f"{said} from {self.low:g} to {self.high:g}"
            elif self.low is not None:
                said = f"{said} from {self.low:g} on"
        said = f"several of: {said}" if isinstance(self.default, tuple) else said
        return f"{said}, or none" if self.none else said

    def checked(self, value: Any) -> Any:
        """The value as the field holds it.

        Raises:
            ValueError: a value that it may not be, without saying so: `replaced` does.
        """
        if value is None and self.none:
            return None
        if isinstance(self.default, tuple):
            if not isinstance(value, tuple | list) or not value:
                raise ValueError
            return tuple(self._one(self.default[0], v) for v in value)
        return self._one(self.default, value)

    def _one(self, kind: Any, value: Any) -> Any:
        if isinstance(kind, bool | str):
            if not isinstance(value, type(kind)) or (isinstance(kind, str) and value not in self.choices):
                raise ValueError
            return value
        if isinstance(value, bool) or np.ndim(value) != 0:
            raise ValueError
        if isinstance(value, Tracer):
            return value
        whole = isinstance(kind, int)
        if not isinstance(value, int | np.integer if whole else float | int | np.number | np.ndarray | jax.Array):
            raise ValueError
        held = float(value)
        low, high = (-math.inf if self.low is None else self.low), (math.inf if self.high is None else self.high)
        if not (low <= held <= high and math.isfinite(held)):
            raise ValueError
        return int(value) if whole else value if isinstance(value, jax.Array) else held

    def parsed(self, text: str) -> Any:
        """The value that a text means: tuples are joined by "-", as in 1-3-5.

        Raises:
            ValueError: none.
        """
        if text == "none" and self.none:
            return None
        if isinstance(self.default, tuple):
            return tuple(_parsed(self.default[0], part) for part in text.split("-"))
        return _parsed(self.default, text)


def _parsed(kind: Any, text: str) -> Any:
    if isinstance(kind, str):
        return text
    if isinstance(kind, bool):
        return {"true": True, "false": False}.get(text, text)
    return int(text) if isinstance(kind, int) else float(text)


def written(value: Any) -> str:
    """A value as `Option.parsed` reads it."""
    if isinstance(value, tuple):
        return "-".join(map(written, value))
    if value is None or isinstance(value, bool):
        return str(value).lower()
    return str(value) if isinstance(value, str | int) else f"{float(value):g}"


def option(
    default: Any,
    doc: str,
    *,
    low: float | int | None = None,
    high: float | int | None = None,
    choices: Any = (),
    none: bool = False,
) -> Any:
    """A field of a class that `settings` decorates; arguments as the attributes of `Option`.

    Its kind is the default's: bool, int, str (with choices, which may be a `Literal`), float, or a tuple of one of
    these. What has a float for its default is traced.
    """
    choices = tuple(choices if isinstance(choices, tuple) else get_args(choices))
    stated = {"doc": doc, "low": low, "high": high, "choices": choices, "none": none}
    return dataclasses.field(default=default, metadata={"option": stated | {"static": not isinstance(default, float)}})


def settings(cls: type[S]) -> type[S]:
    """A frozen dataclass of options as a pytree: its real numbers are leaves, all else is a part of its structure."""
    cls = dataclasses.dataclass(frozen=True)(cls)
    fields = dataclasses.fields(cls)  # type: ignore[arg-type]
    static = [field.name for field in fields if field.metadata["option"]["static"]]
    traced = [field.name for field in fields if field.name not in static]
    return jax.tree_util.register_dataclass(cls, data_fields=traced, meta_fields=static)


def options_of(given: Any, defaults: Any = None) -> tuple[Option, ...]:
    """The options of a class that `settings` decorates, with their current values; none of anything else.

    Their defaults are the values in `defaults`, of the same class, or without it the class's own.
    """
    if not dataclasses.is_dataclass(given):
        return ()
    return tuple(
        Option(
            field.name,
            field.default if defaults is None else getattr(defaults, field.name),
            getattr(given, field.name),
            **field.metadata["option"],
        )
        for field in dataclasses.fields(given)
    )


def _listed(options: tuple[Option, ...]) -> str:
    said = [f"{o.name}={written(o.default)} ({o.allowed})" for o in options]
    return f"its options: {', '.join(said)}" if said else "it has no options"


def _named(owner: str, options: tuple[Option, ...], name: str) -> Option:
    for known in options:
        if known.name == name:
            return known
    raise ValueError(f"{owner}: no option {name!r}; {_listed(options)}")


def replaced(owner: str, given: S, values: Mapping[str, Any]) -> S:
    """Settings with other values.

    Raises:
        ValueError: an unknown option, or a value that it may not have; lists the options of the `owner`.
    """
    found = _each(owner, given, values, Option.checked)
    return dataclasses.replace(given, **found) if found else given  # type: ignore[type-var]


def parsed(owner: str, given: Any, texts: Mapping[str, str]) -> dict[str, Any]:
    """The values that texts mean, each by its option's kind.

    Raises:
        ValueError: an unknown option, or a text that is no such value; lists the options of the `owner`.
    """
    return _each(owner, given, texts, Option.parsed)


def _each(owner: str, given: Any, values: Mapping[str, Any], taken: Callable[[Option, Any], Any]) -> dict[str, Any]:
    """What each value becomes by `taken`, its option's method."""
    options, found = options_of(given), {}
    for name, value in values.items():
        known = _named(owner, options, name)
        try:
            found[name] = taken(known, value)
        except ValueError:
            raise ValueError(f"{owner}, {name}: expected {known.allowed}, got {value!r}; {_listed(options)}") from None
    return found
