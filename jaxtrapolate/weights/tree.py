"""Weights as a tree of arrays and as arrays by name, "path/of/param"."""

import hashlib
from collections.abc import Mapping
from typing import Any, TypeVar

import jax
import numpy as np

from jaxtrapolate.files.tables import parse

T = TypeVar("T")
C = TypeVar("C")


def named(tree: Any) -> dict[str, Any]:
    """The leaves of a pytree by the path that leads to them, "path/of/param", in the tree's order.

    Raises:
        ValueError: two leaves with one name.
    """
    found: dict[str, Any] = {}
    for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]:
        name = jax.tree_util.keystr(path, simple=True, separator="/")
        if name in found:
            raise ValueError(f"weights: two arrays have the name {name!r}")
        found[name] = leaf
    return found


def nested(arrays: Mapping[str, Any]) -> dict[str, Any]:
    """Arrays by name as nested dictionaries: the inverse of `named` for such trees.

    Raises:
        ValueError: a name that is also the first part of another's path.
    """
    tree: dict[str, Any] = {}
    for name, value in arrays.items():
        *path, last = name.split("/")
        place = tree
        for part in path:
            place = place.setdefault(part, {})
            if not isinstance(place, dict):
                raise ValueError(f"weights: the array {part!r} is in the path of {name!r}")
        if last in place:
            raise ValueError(f"weights: the array {name!r} is in the path of another")
        place[last] = value
    return tree


def fit(template: T, tree: Any, *, source: str) -> T:
    """The weights `tree` in the structure of `template`, after checking that names and shapes are the same.

    Args:
        template: a pytree of arrays, or of anything with shape and dtype.
        tree: a pytree with leaves of the same names, such as nested dictionaries.
        source: where they are from, for messages.

    Returns:
        The leaves of `tree`, each of the template's dtype, as JAX arrays.

    Raises:
        ValueError: one line that names arrays that are missing, that nothing takes, or of another shape.
    """
    expected, given = named(template), named(tree)
    wrong = []
    if missing := [name for name in expected if name not in given]:
        wrong.append(f"missing {_listed(missing)}")
    if extra := [name for name in given if name not in expected]:
        wrong.append(f"nothing takes {_listed(extra)}")
    for name, leaf in expected.items():
        if name in given and tuple(np.shape(given[name])) != tuple(leaf.shape):
            wrong.append(f"{name} is {list(np.shape(given[name]))}, expected {list(leaf.shape)}")
    if wrong:
        raise ValueError(f"{source}: weights that do not fit: {'; '.join(wrong[:4])}")
    leaves = [jax.numpy.asarray(given[name], leaf.dtype) for name, leaf in expected.items()]
    return jax.tree.unflatten(jax.tree.structure(template), leaves)


def fingerprint(tree: Any) -> str:
    """Eight hexadecimal digits of the SHA-256 of all names, shapes and values: weights that differ have another."""
    digest = hashlib.sha256()
    for name, leaf in named(tree).items():
        array = np.asarray(leaf)
        digest.update(f"{name} {array.dtype} {array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:8]


def _listed(names: list[str]) -> str:
    return ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")


def configured(kind: type[C], stated: Mapping[str, Any], *, source: str) -> C:
    """A dataclass from what a file of weights states about it (`tables.parse`); the rest has its default.

    Raises:
        ValueError: one line that names `source` and an entry that the configuration does not have or take.
    """
    try:
        return parse(kind, stated)
    except ValueError as error:
        raise ValueError(f"{source}: {kind.__name__}: {error}") from error
