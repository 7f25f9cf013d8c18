"""Checkpoints of a training state, written by Orbax: whole or not at all, and exact to the bit.

The leaves of a state are stored by their path in the tree, so the classes that make up the tree
(named tuples, Flax structs, Optax states) come from the code that restores it. Typed PRNG keys are
stored as their words; arrays without elements, which Orbax refuses, are rebuilt from the state
given to `restore`.
"""

import logging
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from garat_jax.errors import UserError

State = TypeVar("State")


def save(directory: str | Path, step: int, state: Any, keep: int = 2) -> None:
    """Write the state of a step and return when it is on the disk.

    A process killed half-way leaves the earlier checkpoints as they were.

    Args:
        directory: The folder of this run's checkpoints.
        step: The step, larger than that of any checkpoint in the folder.
        state: A pytree of arrays, numbers and typed PRNG keys.
        keep: How many of the newest checkpoints stay.

    Raises:
        ValueError: A checkpoint of this or a later step exists already.
    """
    latest = latest_step(directory)
    if latest is not None and step <= latest:
        raise ValueError(
            f"step {step} is not after step {latest}, the newest checkpoint in {directory}"
        )
    arrays = {name: _to_array(leaf) for name, leaf in _named_leaves(state).items()}
    with _manager(directory, keep) as manager:
        manager.save(step, args=ocp.args.StandardSave({n: a for n, a in arrays.items() if a.size}))


def restore(directory: str | Path, like: State, step: int | None = None) -> State:
    """Read a checkpoint into the structure of a state.

    Args:
        directory: The folder that `save` wrote to.
        like: A state of the same structure, shapes and dtypes; its values are not used.
        step: The step to read; the newest if None.

    Raises:
        ValueError: There is no such checkpoint.
        UserError: It is of a state of another structure, or damaged.
    """
    newest = latest_step(directory)
    if newest is None:
        raise ValueError(f"no checkpoint in {directory}")
    step = newest if step is None else step
    with _manager(directory) as manager:
        if step not in manager.all_steps():
            known = ", ".join(map(str, sorted(manager.all_steps())))
            raise ValueError(f"no checkpoint of step {step} in {directory}; it holds: {known}")
        templates = {name: _to_array(leaf) for name, leaf in _named_leaves(like).items()}
        expected = {name: array for name, array in templates.items() if array.size}
        _check_structure(_metadata(manager, step, directory), expected, directory)
        try:
            stored = manager.restore(step, args=ocp.args.StandardRestore(expected))
        except Exception as error:  # whatever a damaged file leads Orbax to
            raise _damaged(directory, error) from error
    leaves = [
        _from_array(stored.get(name, templates[name]), leaf)
        for name, leaf in _named_leaves(like).items()
    ]
    return jax.tree.unflatten(jax.tree.structure(like), leaves)


def latest_step(directory: str | Path) -> int | None:
    """Return the step of the newest complete checkpoint, or None if there is none."""
    if not Path(directory).is_dir():
        return None
    with _manager(directory) as manager:
        return manager.latest_step()


def _manager(directory: str | Path, keep: int | None = None) -> ocp.CheckpointManager:
    logging.getLogger("absl").setLevel(logging.ERROR)
    options = ocp.CheckpointManagerOptions(max_to_keep=keep, enable_async_checkpointing=False)
    handler = ocp.StandardCheckpointHandler()
    return ocp.CheckpointManager(Path(directory).resolve(), item_handlers=handler, options=options)


def _metadata(manager: ocp.CheckpointManager, step: int, directory: str | Path) -> Any:
    """Return what a checkpoint says that it holds."""
    try:
        metadata = manager.item_metadata(step)
        if not hasattr(metadata, "items"):
            raise ValueError("it holds nothing")
    except Exception as error:  # whatever a damaged file leads Orbax to
        raise _damaged(directory, error) from error
    return metadata


def _damaged(directory: str | Path, error: Exception) -> UserError:
    reason = str(error).splitlines()[0] if str(error) else type(error).__name__
    return UserError(
        f"the checkpoint in {directory} is damaged ({reason}); remove that folder's newest step, "
        "or start anew with --force"
    )


def _named_leaves(state: Any) -> dict[str, Any]:
    """Return the leaves by their path, such as `params.policy.kernel`."""
    pairs = jax.tree_util.tree_leaves_with_path(state)
    named = {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in pairs}
    if len(named) != len(pairs):
        raise ValueError(
            "two leaves of the state have the same path; a dictionary key may hold no dot"
        )
    return named


def _is_key(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _to_array(leaf: Any) -> np.ndarray:
    return np.asarray(jax.random.key_data(leaf) if _is_key(leaf) else leaf)


def _from_array(array: np.ndarray, like: Any) -> Any:
    """Turn a stored array into what `like` is: key, JAX array, NumPy array or number."""
    if _is_key(like):
        return jax.random.wrap_key_data(jnp.asarray(array), impl=jax.random.key_impl(like))
    if isinstance(like, jax.Array):
        return jnp.asarray(array)
    if isinstance(like, np.ndarray):
        return array
    return type(like)(array.item())


def _check_structure(metadata: Any, expected: dict[str, np.ndarray], directory: str | Path) -> None:
    stored = {name: (tuple(item.shape), np.dtype(item.dtype)) for name, item in metadata.items()}
    wanted = {name: (array.shape, array.dtype) for name, array in expected.items()}
    for name in sorted(stored.keys() | wanted.keys()):
        if stored.get(name) != wanted.get(name):
            raise UserError(
                f"the checkpoint in {directory} does not fit this program: {name} is "
                f"{stored.get(name)} there and {wanted.get(name)} here (shape and dtype); "
                "restore it with the version and settings that wrote it"
            )
