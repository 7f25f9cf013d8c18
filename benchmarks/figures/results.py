"""Result files, and tables made of them."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent.parent
ENGINES = {"mujoco": "C MuJoCo", "mjx": "MJX"}
"""What tables call the engines."""


def exists(name: str) -> bool:
    return (ROOT / "benchmarks/results" / f"{name}.json").is_file()


def read(name: str) -> dict[str, Any]:
    return json.loads((ROOT / "benchmarks/results" / f"{name}.json").read_text(encoding="utf-8"))


def table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    marks = ["---", *["---:"] * (len(columns) - 1)]
    return "".join(f"| {' | '.join(row)} |\n" for row in (columns, marks, *rows))


def origin(name: str, result: dict[str, Any]) -> str:
    """Say where a table comes from."""
    machine, commit = result["machine"], result["git"]["commit"][:7]
    changed = ", changed tree" if result["git"]["dirty"] else ""
    device = result.get("device", "cpu")
    device = "" if device == "cpu" else f"one {device}, "
    return (
        f"\n`{result['command']}` → `benchmarks/results/{name}.json` "
        f"(commit {commit}{changed}, {device}{machine['cores']} cores of an {machine['cpu']})\n"
    )


def commits(rows: Sequence[dict[str, Any]], own: str = "") -> str:
    """Say of which commits rows, or parts of a row, are, where not all are of the file's own."""
    every = [commit for row in rows for commit in row.get("commits", [row.get("commit")])]
    found = sorted({commit[:7] for commit in every if commit})
    if len(found) > 1:
        return f"\nThe rows are of the commits {', '.join(found)}.\n"
    return (
        f"\nThe rows are of the commit {found[0]}.\n"
        if own and found not in ([], [own[:7]])
        else ""
    )


def if_measured(make: Callable[[dict[str, Any]], str], name: str, part: str = "rows") -> str:
    """Return a table with its origin, or that a file or this part of it is not there yet."""
    if exists(name) and part in (result := read(name)):
        return make(result) + origin(name, result)
    return f"Not measured yet: `python benchmarks/{name}.py`.\n"
