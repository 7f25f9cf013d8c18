"""Write reports: one self-contained HTML file that opens offline. No JAX.

A report is a lead sentence, a few numbers, and sections of prose, plotly figures and tables. Two
reports become one by concatenating their sections.
"""

import dataclasses
import functools
import importlib.resources
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2
import markupsafe
import plotly.graph_objects as go
from plotly.offline import get_plotlyjs

from garat_jax.files import write_whole

INK, SOFT, LINE = "#1c2430", "#5a6573", "#e2e6eb"
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
"""Distinguishable with colour-vision deficiencies too (Okabe and Ito 2008), in order of use."""
HEIGHT = 360
"""Pixels of a figure whose layout does not say."""
DIGITS = 4
"""Significant digits of the numbers in tables."""


@dataclasses.dataclass(frozen=True)
class Figure:
    """A plotly figure, with a caption that a stranger understands and a title if it needs one."""

    figure: go.Figure
    caption: str
    title: str = ""


@dataclasses.dataclass(frozen=True)
class Table:
    """A table; numbers among the cells are rounded and stand to the right.

    If `folded` says what it holds, it is shown on a click on that.
    """

    columns: Sequence[str]
    rows: Sequence[Sequence[Any]]
    caption: str = ""
    folded: str = ""


@dataclasses.dataclass(frozen=True)
class Section:
    """A section; a blank line in its text separates paragraphs, lines that start `- ` a list."""

    heading: str
    text: str = ""
    figures: Sequence[Figure] = ()
    tables: Sequence[Table] = ()


@dataclasses.dataclass(frozen=True)
class Fact:
    """A number to be seen first, with what it is."""

    value: str
    label: str


@dataclasses.dataclass(frozen=True)
class Reproduce:
    """How to get the results again: the command line, and lines about what it ran on."""

    command: str
    lines: tuple[str, ...] = ()

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> "Reproduce":
        """Take it from the content of a run directory's `config.json`."""
        versions = {n: v for n, v in config["versions"].items() if v is not None}
        machine, git = config["machine"], config["git"]
        lines = ["Versions: " + ", ".join(f"{name} {v}" for name, v in versions.items()) + "."]
        processor = machine["cpu"] or "unknown processor"
        lines.append(f"Machine: {processor}, {machine['cores']} cores, {machine['system']}.")
        if config["seeds"]:
            seeds = config["seeds"]
            lines.append(f"Seed{'s' * (len(seeds) > 1)}: {', '.join(map(str, seeds))}.")
        if git:
            changed = ", with changes that are not committed" if git["dirty"] else ""
            lines.append(f"Commit: {git['commit']}{changed}.")
        return cls(config["command"], tuple(lines))


def write(
    path: str | Path,
    *,
    title: str,
    lead: str,
    sections: Sequence[Section],
    reproduce: Reproduce,
    kind: str = "garat_jax report",
    facts: Sequence[Fact] = (),
) -> Path:
    """Write a report.

    Args:
        path: The HTML file.
        title: What was done to what.
        lead: The result in one sentence.
        sections: What follows, in order.
        reproduce: How to get the results again.
        kind: A line above the title.
        facts: Numbers to be seen first, at most four or so.

    Returns:
        The path of the file.
    """
    page = _template().render(
        title=title,
        lead=lead,
        kind=kind,
        facts=facts,
        sections=sections,
        reproduce=reproduce,
        plotly_js=markupsafe.Markup(get_plotlyjs()),
    )
    return write_whole(Path(path), page)


def styled(figure: go.Figure, **layout: Any) -> go.Figure:
    """Give a figure the report's look, and then the given layout."""
    axis = {
        "gridcolor": LINE,
        "linecolor": LINE,
        "zerolinecolor": LINE,
        "automargin": True,
        "title": {"standoff": 8, "font": {"size": 13, "color": SOFT}},
        "tickfont": {"size": 12, "color": SOFT},
    }
    figure.update_layout(
        template="none",
        font={"family": "system-ui, -apple-system, Segoe UI, Roboto, sans-serif", "size": 13},
        font_color=INK,
        colorway=list(COLOURS),
        paper_bgcolor="white",
        plot_bgcolor="white",
        height=HEIGHT,
        margin={"l": 8, "r": 8, "t": 44, "b": 8},
        hoverlabel={"bgcolor": "white", "bordercolor": LINE, "font": {"color": INK}},
        legend={"orientation": "h", "x": 0, "xanchor": "left", "y": 1.0, "yanchor": "bottom"},
    )
    figure.update_xaxes(**axis)
    figure.update_yaxes(**axis)
    figure.update_annotations(font={"size": 13, "color": INK})
    return figure.update_layout(**layout)


@functools.cache
def _template() -> jinja2.Template:
    source = importlib.resources.files("garat_jax") / "templates" / "report.html.j2"
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    environment.globals.update(
        blocks=_blocks, height=_height, json=_json, numeric_columns=_numeric_columns, text=_text
    )
    return environment.from_string(source.read_text(encoding="utf-8"))


def _blocks(text: str) -> list[str | list[str]]:
    """Return paragraphs as strings and lists as lists of items."""
    blocks: list[str | list[str]] = []
    for part in filter(None, (part.strip() for part in text.split("\n\n"))):
        lines = part.splitlines()
        if all(line.startswith("- ") for line in lines):
            blocks.append([line[2:] for line in lines])
        else:
            blocks.append(" ".join(lines))
    return blocks


def _height(figure: Figure) -> int:
    return int(figure.figure.layout.height or HEIGHT)


def _json(figure: Figure) -> markupsafe.Markup:
    """Return a figure as JSON that may stand inside a script element."""
    content = json.loads(figure.figure.to_json())  # pyright: ignore[reportArgumentType]
    text = json.dumps({"data": content["data"], "layout": content["layout"]})
    return markupsafe.Markup(text.replace("<", "\\u003c"))


def _is_number(cell: Any) -> bool:
    return isinstance(cell, int | float) and not isinstance(cell, bool)


def _numeric_columns(table: Table) -> list[bool]:
    columns = zip(*table.rows, strict=True) if table.rows else ((),) * len(table.columns)
    return [
        any(map(_is_number, cells)) and all(_is_number(c) or c in (None, "") for c in cells)
        for cells in columns
    ]


def _text(cell: Any) -> str:
    """Write a table's cell: numbers rounded, nothing for what is absent."""
    if cell is None:
        return ""
    if isinstance(cell, float):
        return f"{cell:.{DIGITS}g}" if math.isfinite(cell) else "–"
    return str(cell)
