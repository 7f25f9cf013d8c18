"""What is being done, on stderr: a line that changes on a terminal, elsewhere a line each."""

import contextlib
import sys
from collections.abc import Callable, Iterator

from rich.console import Console


def tell(message: str) -> None:
    """Write a line of progress on stderr."""
    sys.stderr.write(f"{message}\n")


@contextlib.contextmanager
def progress(first: str) -> Iterator[Callable[[str], None]]:
    """Show what is being done as long as the block lasts.

    Args:
        first: What is done first.

    Yields:
        What to tell the next thing to.
    """
    console = Console(stderr=True)
    if not console.is_terminal:
        tell(first)
        yield tell
        return
    with console.status(first) as status:
        yield status.update
