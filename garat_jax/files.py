"""Files: written whole or not at all, told apart by their names, TOML read. No JAX."""

import contextlib
import os
import tomllib
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

from garat_jax.errors import UserError, unknown_name


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


def read_toml(path: Path, file_format: str, keys: Collection[str]) -> dict[str, Any]:
    """Read a TOML file that names its format.

    Args:
        path: The file; it may begin with a byte order mark, as some editors write.
        file_format: What its `format` has to be.
        keys: Those that it may have.

    Raises:
        UserError: It cannot be read, is of another format, or has another key.
    """
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise UserError(f"{path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: no valid TOML: not UTF-8 text; save it as UTF-8") from error
    except ValueError as error:
        raise UserError(f"{path}: no valid TOML: {error}") from error
    if content.get("format") != file_format:
        raise UserError(f"{path}: format is {content.get('format')!r}; expected {file_format!r}")
    for key in content:
        if key not in keys:
            raise UserError(f"{path}: {unknown_name('key', key, keys)}")
    return content
