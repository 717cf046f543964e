"""Networks from files of weights."""

from collections.abc import Callable, Mapping
from os import PathLike
from typing import Any, TypeVar

from flax import nnx

from jaxtrapolate.weights import fit, read_weights

M = TypeVar("M", bound=nnx.Module)


def load_network(
    path: str | PathLike[str], method: str, build: Callable[[Mapping[str, Any]], Callable[[], M]]
) -> tuple[M, Mapping[str, Any]]:
    """A method's network with the weights in a file, and what the file states that the method is built with.

    Args:
        path: of a file or folder, see `read_weights`.
        method: whose weights these have to be.
        build: gives, for what the file states, the function that builds the network. It is never run, only traced.

    Raises:
        OSError: the file cannot be read.
        ValueError: one line that names the file: damaged, of another method, or with weights that do not fit.
    """
    weights = read_weights(path)
    if weights.method not in (method, None):
        raise ValueError(f"{weights.source}: weights of method {weights.method!r}, expected {method!r}")
    structure, state = nnx.split(nnx.eval_shape(build(weights.config)))
    nnx.replace_by_pure_dict(state, fit(nnx.to_pure_dict(state), weights.tree, source=weights.source))
    return nnx.merge(structure, state), weights.config
