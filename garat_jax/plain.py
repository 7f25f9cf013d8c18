"""Values as JSON knows them. No JAX."""

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np


def to_plain(value: Any) -> Any:
    """Turn a value into what JSON knows: dicts with string keys, lists, strings, numbers, None.

    Raises:
        TypeError: The value has no such form.
    """
    if value is None or isinstance(value, str | bool | int | float):
        return value
    if isinstance(value, Path):
        return str(value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: to_plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): to_plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [to_plain(item) for item in value]
    array = np.asarray(value)
    if array.dtype == object:
        raise TypeError(
            f"{type(value).__name__} has no JSON form; "
            "expected numbers, strings, arrays, paths, dataclasses or containers of them"
        )
    return array.tolist()


def finite_or_null(value: Any) -> Any:
    """Replace each NaN and infinity in a plain value by None."""
    if isinstance(value, dict):
        return {key: finite_or_null(item) for key, item in value.items()}
    if isinstance(value, list):
        return [finite_or_null(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
