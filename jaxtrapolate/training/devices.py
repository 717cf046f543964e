"""The devices of a run: one axis, along which batches and pools are divided; weights are on all of them."""

import functools
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from jaxtrapolate.errors import InputError

AXIS = "batch"
"""The name of the mesh's one axis."""


@functools.cache
def mesh() -> Mesh:
    """All devices of all hosts, each host's in a row."""
    devices = sorted(jax.devices(), key=lambda d: (d.process_index, d.id))
    return Mesh(np.array(devices), (AXIS,), axis_types=(AxisType.Auto,))


def replicated() -> NamedSharding:
    """Whole on every device."""
    return NamedSharding(mesh(), PartitionSpec())


def divided() -> NamedSharding:
    """Divided along the leading axis."""
    return NamedSharding(mesh(), PartitionSpec(AXIS))


def check_divisible(batch: int) -> None:
    """Raise `InputError` unless each device gets the same number of items of a batch."""
    if batch % jax.device_count():
        raise InputError(f"batch: {batch} items cannot be divided evenly among {jax.device_count()} devices")


def own_part(count: int) -> range:
    """The numbers, of `count`, that this host's devices hold of an array that is `divided`."""
    slices = divided().addressable_devices_indices_map((count,)).values()
    ranges = [range(count)[index[0]] for index in slices if index is not None]
    return range(min(r.start for r in ranges), max(r.stop for r in ranges))


def distribute(tree: Any) -> Any:
    """Global arrays, `divided`, of what each host has of them."""
    if jax.process_count() == 1:
        return jax.device_put(tree, divided())
    return jax.make_array_from_process_local_data(divided(), jax.tree.map(np.asarray, tree))


def collect(tree: Any) -> Any:
    """NumPy arrays of global ones, on every host."""
    if jax.process_count() > 1:
        tree = multihost_utils.process_allgather(tree, tiled=True)
    return jax.tree.map(np.asarray, tree)


def local(tree: Any) -> Any:
    """Arrays that are whole on every device, as arrays on this host's first."""
    return jax.tree.map(lambda a: a.addressable_data(0), tree)
