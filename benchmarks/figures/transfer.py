"""Draw the README's figure of a transfer: `python benchmarks/figures/transfer.py`.

It reads `benchmarks/results/transfer_PAIR.json` and writes `docs/figures/transfer_PAIR.svg`.
"""

import dataclasses
import json
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from garat_jax.report import COLOURS, INK, LINE, SOFT
from garat_jax.summary import counted

ROOT = Path(__file__).resolve().parent.parent.parent
WIDTH, HEIGHT = 900, 330
TOP, BOTTOM = 56, 262
PALE = "#c5ccd6"


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Draw the figure of a transfer from its result file."""

    pair: str = "inverted_pendulum_heavy"
    """The pair."""


@dataclasses.dataclass(frozen=True)
class Panel:
    """Axes in a picture: from data to pixels.

    Attributes:
        left: Pixel of the left end.
        right: Pixel of the right end.
        low: Value at the bottom.
        high: Value at the top.
    """

    left: float
    right: float
    low: float
    high: float

    def y(self, value: float) -> float:
        return BOTTOM - (value - self.low) / (self.high - self.low) * (BOTTOM - TOP)

    def x(self, fraction: float) -> float:
        return self.left + fraction * (self.right - self.left)

    def frame(self, title: str, ticks: Sequence[float]) -> list[str]:
        """Draw title, grid and tick labels."""
        marks = [text(self.left, 28, title, size=15, weight=600)]
        for tick in ticks:
            y = self.y(tick)
            marks.append(line(self.left, y, self.right, y, LINE))
            marks.append(text(self.left - 8, y + 4, f"{tick:g}", anchor="end", colour=SOFT))
        return marks


def text(x: float, y: float, content: str, **style: Any) -> str:
    size, weight = style.get("size", 12), style.get("weight", 400)
    anchor, colour = style.get("anchor", "start"), style.get("colour", INK)
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size}" font-weight="{weight}" '
        f'text-anchor="{anchor}" fill="{colour}">{escape(content)}</text>'
    )


def line(x1: float, y1: float, x2: float, y2: float, colour: str, dash: str = "none") -> str:
    return (
        f'<line x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}" stroke="{colour}" '
        f'stroke-width="1.5" stroke-dasharray="{dash}"/>'
    )


def returns(summary: dict[str, Any]) -> list[str]:
    """Draw scaled returns: a bar for the mean, a dot a seed."""
    controls = {name: control["scaled"] for name, control in summary["controls"].items()}
    bars = {
        "source\npolicy": ([0.0], PALE),
        "more\ntraining": (controls["more_source_training"]["per_seed"], PALE),
        "action\nnoise": (controls["action_noise"]["per_seed"], PALE),
        "GARAT": (summary["scaled"]["per_seed"], COLOURS[0]),
        "trained in\nthe target": ([1.0], PALE),
    }
    kept = {name: [v for v in values if v is not None] for name, (values, _) in bars.items()}
    panel = Panel(50, 430, min(0.0, *(min(v) for v in kept.values())), 1.1)
    marks = panel.frame("Return in the target, scaled", (0, 0.25, 0.5, 0.75, 1))
    for number, (name, (_, colour)) in enumerate(bars.items()):
        x, width = panel.x((number + 0.5) / len(bars)), 44
        top, base = panel.y(float(np.mean(kept[name]))), panel.y(0.0)
        marks.append(
            f'<rect x="{x - width / 2:.1f}" y="{top:.1f}" width="{width}" '
            f'height="{max(base - top, 1.5):.1f}" fill="{colour}"/>'
        )
        marks += [
            f'<circle cx="{x:.1f}" cy="{panel.y(v):.1f}" r="3" fill="{INK}" opacity="0.6"/>'
            for v in kept[name]
            if len(kept[name]) > 1
        ]
        for row, part in enumerate(name.split("\n")):
            marks.append(text(x, BOTTOM + 20 + 15 * row, part, anchor="middle", colour=SOFT))
    return marks


def errors(summary: dict[str, Any]) -> list[str]:
    """Draw the held-out error of one step over the updates, as a share of the source's."""
    curve = summary["transition_error_curve"]
    source = np.asarray(summary["transition_error"]["source"])
    ratios = np.asarray(curve["grounded"]) / source
    updates = np.asarray(curve["update"])
    panel = Panel(520, 880, 0.0, 1.1 * max(1.0, float(ratios.max())))
    marks = panel.frame("Error of one step, share of the source's", (0, 0.25, 0.5, 0.75, 1))
    for seed in ratios.T:
        points = " ".join(
            f"{panel.x(u / updates[-1]):.1f},{panel.y(r):.1f}"
            for u, r in zip(updates, seed, strict=True)
        )
        marks.append(
            f'<polyline points="{points}" fill="none" stroke="{COLOURS[0]}" stroke-width="1.5" '
            'opacity="0.75"/>'
        )
    levels = {
        "the source as it is": (1.0, COLOURS[1]),
        "actions replaced by zero": (
            float(counted(summary, summary["baselines"]["zero_action"]["ratio"]).mean()),
            COLOURS[2],
        ),
    }
    for name, (level, colour) in levels.items():
        y = panel.y(level)
        marks.append(line(panel.left, y, panel.right, y, colour, dash="6 4"))
        marks.append(text(panel.right, y - 6, name, anchor="end", colour=colour))
    marks += [
        text(panel.x(u / updates[-1]), BOTTOM + 20, f"{u:g}", anchor="middle", colour=SOFT)
        for u in range(0, int(updates[-1]) + 1, 10)
    ]
    middle = panel.x(0.5)
    marks.append(text(middle, BOTTOM + 40, "adversarial update", anchor="middle", colour=SOFT))
    return marks


def main() -> None:
    pair = tyro.cli(Arguments).pair
    path = ROOT / "benchmarks" / "results" / f"transfer_{pair}.json"
    summary = json.loads(path.read_text(encoding="utf-8"))["rows"][0]
    marks = [*returns(summary), *errors(summary)]
    picture = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" '
        'font-family="system-ui, sans-serif">'
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="white"/>{"".join(marks)}</svg>\n'
    )
    out = ROOT / "docs" / "figures" / f"transfer_{pair}.svg"
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(picture, encoding="utf-8")
    print(out.relative_to(ROOT))


if __name__ == "__main__":
    main()
