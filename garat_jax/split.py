"""Work split over devices: seeds over one axis of a mesh, environments over the other.

Outside of a program all arrays are whole and lie on one device. `over_seeds` hands each device its
seeds; `rollout` lets each step its share of the environments and puts the shares together again, so
that what learns from them sees the batch that one device would have made.
"""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from garat_jax.errors import UserError

SEEDS, ENVS = "seeds", "envs"


def make_mesh(num_seeds: int, num_envs: int) -> Mesh | None:
    """Arrange as many of the devices as divide the seeds and the environments; None for one.

    Where two arrangements take as many devices, the one with more on the seeds is taken: they
    have nothing to tell each other.

    Raises:
        UserError: Several processes run this, and the work leaves some of their devices without.
    """
    devices = jax.devices()
    shapes = [
        (seeds, envs)
        for seeds in range(1, len(devices) + 1)
        for envs in range(1, len(devices) // seeds + 1)
        if num_seeds % seeds == 0 and num_envs % envs == 0
    ]
    shape = max(shapes, key=lambda shape: (math.prod(shape), shape))
    if jax.process_count() > 1 and math.prod(shape) < len(devices):
        raise UserError(
            f"{num_seeds} seeds of {num_envs} environments cannot be split over {len(devices)} "
            "devices of several processes; choose numbers of seeds and devices that divide"
        )
    if math.prod(shape) == 1:
        return None
    return Mesh(np.asarray(devices[: math.prod(shape)]).reshape(shape), (SEEDS, ENVS))


def over_seeds(function: Callable, axes: Any, mesh: Mesh | None) -> Callable:
    """Apply a function to the arguments of every seed, on the devices of a mesh.

    Args:
        function: Of one seed.
        axes: As `jax.vmap`'s `in_axes`: 0 where an argument has one entry a seed, else None.
        mesh: The devices; None for one.
    """
    batched = jax.vmap(function, in_axes=axes)
    if mesh is None:
        return batched
    specs = jax.tree.map(
        lambda axis: P() if axis is None else P(SEEDS), axes, is_leaf=lambda axis: axis is None
    )
    # MJX and host calls say nothing about what varies over a mesh, so it cannot be checked.
    return jax.shard_map(batched, mesh=mesh, in_specs=specs, out_specs=P(SEEDS), check_vma=False)


def compile_on(mesh: Mesh, function: Callable, arguments: tuple, options: Any) -> Any:
    """Compile a function that runs on a mesh; whole arrays go in and come out.

    Returns:
        The compiled program, and a function that calls it.
    """
    everywhere = NamedSharding(mesh, P())
    local = [d for d in mesh.devices.flat if d.process_index == jax.process_index()]

    def place(array: Any) -> jax.Array:
        array = jnp.asarray(array)
        copies = [jax.device_put(array, device) for device in local]
        return jax.make_array_from_single_device_arrays(array.shape, everywhere, copies)

    jitted = jax.jit(function, out_shardings=everywhere, compiler_options=options)
    compiled = jitted.lower(*jax.tree.map(place, arguments)).compile()

    def run(*arguments: Any) -> Any:
        results = compiled(*jax.tree.map(place, arguments))
        return jax.tree.map(lambda array: array.addressable_data(0), results)

    return compiled, run


def num_shares(num_envs: int) -> int:
    """Return over how many devices a batch of environments is split, where this is traced."""
    mesh = jax.sharding.get_abstract_mesh()
    count = mesh.shape[ENVS] if ENVS in mesh.manual_axes else 1
    return count if num_envs % count == 0 else 1


def own_share(tree: Any, shares: int, axis: int = 0) -> Any:
    """Return this device's share of arrays that are split along an axis."""
    if shares == 1:
        return tree

    def cut(array: jax.Array) -> jax.Array:
        size = array.shape[axis] // shares
        return jax.lax.dynamic_slice_in_dim(array, jax.lax.axis_index(ENVS) * size, size, axis)

    return jax.tree.map(cut, tree)


def anywhere(flag: jax.Array) -> jax.Array:
    """Say whether a flag [] is set on any device: what ends a loop has to end it on all at once."""
    axes = tuple(jax.sharding.get_abstract_mesh().manual_axes)
    return jax.lax.pmax(flag.astype(jnp.int32), axes) > 0 if axes else flag


def join(tree: Any, shares: int, axis: int = 0) -> Any:
    """Put the shares of all devices together along an axis."""
    if shares == 1:
        return tree
    return jax.tree.map(lambda x: jax.lax.all_gather(x, ENVS, axis=axis, tiled=True), tree)
