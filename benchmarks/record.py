"""Writes the results of benchmarks, each with what is needed to get them again."""

import datetime
import functools
import json
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from garat_jax.plain import to_plain
from garat_jax.provenance import provenance

FORMAT = "garat-benchmark/1"
RESULTS = Path(__file__).resolve().parent / "results"


def write_result(
    name: str,
    rows: Sequence[Mapping[str, Any]],
    *,
    seeds: Sequence[int],
    command: str,
    details: Mapping[str, Any] | None = None,
    folder: Path = RESULTS,
) -> Path:
    """Write one benchmark's rows; see `result_path` for where.

    Args:
        name: The benchmark.
        rows: One mapping a row of the table or a point of the figure.
        seeds: The seeds that the rows come from.
        command: The command line that makes the rows again, from the root of the repository.
        details: What else the file holds, by name: how the rows were chosen, or what explains them.
        folder: Where the file goes.

    Returns:
        The path of the file.

    Raises:
        ValueError: There are no rows, or one holds a NaN or an infinity.
    """
    if not rows:
        raise ValueError(f"benchmark {name!r} has no rows; expected one or more")
    path = result_path(name, folder)
    result = {
        "format": FORMAT,
        "name": path.stem,
        "command": command,
        "seeds": list(seeds),
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        **_made_by(),
        "device": _device().device_kind,
        **(details or {}),
        "rows": rows,
    }
    text = json.dumps(to_plain(result), indent=2, allow_nan=False) + "\n"
    folder.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return path


def result_path(name: str, folder: Path = RESULTS) -> Path:
    """Return a benchmark's result file: `<name>.json`, on an accelerator `<name>_gpu.json`."""
    platform = _device().platform
    return folder / f"{name if platform == 'cpu' else f'{name}_{platform}'}.json"


@functools.cache
def _made_by() -> dict[str, Any]:
    """Return `provenance()` before this process first wrote a result: writing changes the tree."""
    return provenance()


def _device():
    import jax  # late: benchmarks set variables that JAX reads when it is imported

    return jax.devices()[0]


def command_line() -> str:
    """Return the command that makes the rows again, without where they are to go."""
    words = sys.argv[1:]
    if "--out" in words:
        place = words.index("--out")
        words = words[:place] + words[place + 2 :]
    return shlex.join(["python", f"benchmarks/{Path(sys.argv[0]).name}", *words])
