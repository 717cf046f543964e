"""TOML and JSON files as tables, and lines of text, whatever is in them: damage and excess end in one line."""

import json
import os
import re
import tomllib
from collections.abc import Callable
from typing import Any

from jaxtrapolate.atomic import os_input_error
from jaxtrapolate.errors import InputError
from jaxtrapolate.regular import open_regular

LARGEST = 1 << 20
"""Bytes: no file of settings is larger."""
BACKSLASH = "forward slashes, or single quotes around it, since in double quotes a backslash starts an escape"
"""How paths are written in TOML."""
_DEEPEST = 64
_LONG_KEY = re.compile(r"""(?m)(?:^|[\[{,])[ \t]*(?:(?:[\w-]+|"[^"\n]*"|'[^'\n]*')[ \t]*\.[ \t]*){65}""")
"""A key of more than 64 parts, which takes tomllib a time that grows with the square of them."""


def read_toml(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The table in a TOML file.

    Raises:
        InputError: missing, no regular file, more than 1 MiB, not UTF-8, not TOML, nested deeper than 64 tables or
            arrays, or an integer that 64 bits do not hold.
    """
    return _read(path, "TOML", _parse_toml)


def read_json(path: str | os.PathLike[str]) -> Any:
    """The value in a JSON file. Raises `InputError` as `read_toml` does."""
    return _read(path, "JSON", json.loads)


def read_lines(path: str | os.PathLike[str]) -> list[str]:
    """The lines of a text. Raises `InputError` as `read_toml` does."""
    return _read(path, "text", str.splitlines)


def _parse_toml(text: str) -> dict[str, Any]:
    if _LONG_KEY.search(text):
        raise RecursionError
    return tomllib.loads(text)


def _read(path: str | os.PathLike[str], kind: str, parse: Callable[[str], Any]) -> Any:
    try:
        with open_regular(path) as stream:
            data = stream.read(LARGEST + 1)
    except OSError as error:
        raise os_input_error(path, error) from error
    if len(data) > LARGEST:
        raise InputError(f"{path}: more than {LARGEST} bytes, so no {kind} file that is meant; check the path")
    try:
        value = parse(data.decode("utf-8-sig"))
        check_values(value)
    except RecursionError as error:
        raise InputError(f"{path}: not valid {kind}, nested too deeply; correct it") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not valid {kind}, it is no UTF-8 text; save it as UTF-8") from error
    except ValueError as error:  # also a number of thousands of digits
        why = " ".join(str(error).split())
        escape = kind == "TOML" and ("scape" in why or "hex" in why)
        remedy = f"write paths with {BACKSLASH}" if escape else "correct it"
        raise InputError(f"{path}: not valid {kind}, {why}; {remedy}") from error
    return value


def check_values(value: Any) -> None:
    """Raise `ValueError` where tables and lists are nested more than 64 deep, or an integer needs more than 64 bits.

    Deeper ones cannot be printed, longer ones neither printed nor turned into floats.
    """
    level = [value]
    for _ in range(_DEEPEST):
        for item in level:
            if isinstance(item, int) and not -(2**63) <= item < 2**64:
                raise ValueError(f"an integer of {item.bit_length()} bits, more than 64")
        level = [
            child
            for item in level
            if isinstance(item, dict | list | tuple)
            for child in (item.values() if isinstance(item, dict) else item)
        ]
        if not level:
            return
    raise ValueError("nested too deeply")
