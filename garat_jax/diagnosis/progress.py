"""What is being done and since when, on stderr: one line on a terminal, elsewhere a line each."""

import contextlib
import sys
import time
from collections.abc import Callable, Iterator

from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn


def tell(message: str) -> None:
    """Write a line of progress on stderr."""
    sys.stderr.write(f"{message}\n")


@contextlib.contextmanager
def progress(first: str) -> Iterator[Callable[[str], None]]:
    """Show what is being done, and since when the block began, as long as it lasts.

    Args:
        first: What is done first.

    Yields:
        What to tell the next thing to.
    """
    console = Console(stderr=True)
    if not console.is_terminal:
        began = time.monotonic()

        def say(message: str) -> None:
            seconds = int(time.monotonic() - began)
            tell(f"{seconds // 60:3d}:{seconds % 60:02d} {message}")

        say(first)
        yield say
        return
    doing = TextColumn("{task.description}", markup=False)
    columns = SpinnerColumn(), TimeElapsedColumn(), doing
    with Progress(*columns, console=console, transient=True) as shown:
        task = shown.add_task(first, total=None)
        yield lambda message: shown.update(task, description=message)
