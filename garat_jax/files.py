"""Files: written whole or not at all, and told apart by their names. No JAX."""

import contextlib
import os
from collections.abc import Collection, Iterator
from pathlib import Path


@contextlib.contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Give a file to write beside another, whose place it takes when the block ends.

    If the block fails, what lay there stays as it was. A link stays a link.
    """
    path = path.resolve()
    temporary = path.with_name(f".{os.getpid()}.{path.name}")
    try:
        yield temporary
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def write_whole(path: Path, text: str) -> Path:
    """Write a text file whole or not at all, and return its path."""
    with written_whole(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return path


def distinct_names(paths: Collection[Path]) -> dict[Path, str]:
    """Name files by the last parts of their paths, as many of them as tell all files apart."""
    names: dict[Path, str] = {}
    whole = {path: Path(path).absolute() for path in paths}
    longest = max((len(path.parts) for path in whole.values()), default=1)
    for num in range(1, longest + 1):
        names = {path: Path(*w.parts[-num:]).as_posix() for path, w in whole.items()}
        if len({*names.values()}) == len({*whole.values()}):
            break
    return names
