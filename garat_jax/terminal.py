"""Words on the terminal: lines as they are, tables, complaints. No JAX."""

import sys
from collections.abc import Sequence

from rich.console import Console
from rich.table import Table

from garat_jax.commandline import PROGRAM


def complain(message: str, status: int) -> int:
    """Print one line on stderr and return the exit status that goes with it."""
    line = " ".join(message.split())
    sys.stderr.write(f"{PROGRAM}: {line}\n")
    return status


def say(message: str) -> None:
    """Print one line on stdout, as it is."""
    Console(soft_wrap=True, highlight=False, markup=False, emoji=False).print(message)


def print_table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table, as wide as the terminal or, where there is none, as its content."""
    table = Table(*columns)
    for row in rows:
        table.add_row(*row)
    console = Console()
    width = console.width if console.is_terminal else max(console.width, 160)
    Console(width=width, markup=False, emoji=False).print(table)
