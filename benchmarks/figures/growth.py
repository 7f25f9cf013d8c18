"""Draw how steps a second grow: `python benchmarks/figures/growth.py`.

It reads `benchmarks/results/growth.json` and writes `docs/figures/growth.svg`.
"""

import dataclasses
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import tyro
from transfer import BOTTOM, HEIGHT, ROOT, WIDTH, Panel, line, text

from garat_jax.report import COLOURS, LINE, SOFT

DASHES = {"trpo": "none", "random actions": "5 4"}
DECADES = (1_000, 10_000, 100_000, 1_000_000)
AXES = {"envs": "environments of one seed", "seeds": "seeds of 50 environments"}


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Draw how steps a second grow with environments and seeds."""

    source: Path = ROOT / "benchmarks" / "results" / "growth.json"
    """The result file."""
    out: Path = ROOT / "docs" / "figures" / "growth.svg"
    """The picture."""


@dataclasses.dataclass(frozen=True)
class LogPanel:
    """A panel with logarithmic axes."""

    panel: Panel
    ticks: Sequence[float]

    def x(self, value: float) -> float:
        low, high = math.log(self.ticks[0]), math.log(self.ticks[-1])
        return self.panel.x((math.log(value) - low) / (high - low))

    def y(self, value: float) -> float:
        return self.panel.y(math.log10(value))

    def frame(self, title: str, label: str) -> list[str]:
        marks = [text(self.panel.left, 28, title, size=15, weight=600)]
        for value in DECADES:
            y = self.y(value)
            if self.panel.low <= math.log10(value) <= self.panel.high:
                marks.append(line(self.panel.left, y, self.panel.right, y, LINE))
                name = f"{value:,}"
                marks.append(text(self.panel.left - 6, y + 4, name, anchor="end", colour=SOFT))
        for tick in self.ticks:
            marks.append(text(self.x(tick), BOTTOM + 18, f"{tick:g}", anchor="middle", colour=SOFT))
        middle = self.panel.x(0.5)
        marks.append(text(middle, BOTTOM + 38, label, anchor="middle", colour=SOFT))
        return marks

    def curve(self, points: Sequence[tuple[float, float]], colour: str, dash: str) -> list[str]:
        pixels = [(self.x(x), self.y(y)) for x, y in points]
        joined = " ".join(f"{x:.1f},{y:.1f}" for x, y in pixels)
        return [
            f'<polyline points="{joined}" fill="none" stroke="{colour}" stroke-width="1.8" '
            f'stroke-dasharray="{dash}"/>',
            *(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="2.5" fill="{colour}"/>' for x, y in pixels),
        ]


def draw(rows: Sequence[dict[str, Any]]) -> str:
    """Return the picture of the rows of a growth benchmark."""
    rates = [math.log10(row["steps_per_second"]) for row in rows]
    low, high = math.floor(10 * min(rates)) / 10, math.ceil(10 * max(rates)) / 10
    envs = list(dict.fromkeys(row["env"] for row in rows))
    marks = []
    for grows, (left, right) in {"envs": (70, 530), "seeds": (620, 880)}.items():
        chosen = [row for row in rows if row["grows"] == grows]
        ticks = sorted({row[grows] for row in chosen})
        panel = LogPanel(Panel(left, right, low, high), ticks)
        marks += panel.frame("Environment steps a second" if grows == "envs" else "", AXES[grows])
        for env, colour in zip(envs, COLOURS, strict=False):
            for agent, dash in DASHES.items():
                points = [
                    (row[grows], row["steps_per_second"])
                    for row in chosen
                    if row["env"] == env and row["agent"] == agent
                ]
                marks += panel.curve(points, colour, dash)
    return "".join([*marks, *legend(envs)])


def legend(envs: Sequence[str]) -> list[str]:
    marks = []
    y = HEIGHT - 8
    for number, (env, colour) in enumerate(zip(envs, COLOURS, strict=False)):
        x = 70 + 152 * number
        marks += [line(x, y - 4, x + 22, y - 4, colour)]
        marks += [text(x + 28, y, env.replace("_", " "), colour=colour)]
    for number, (agent, dash) in enumerate(DASHES.items()):
        x = 680 + 82 * number
        marks.append(line(x, y - 4, x + 22, y - 4, SOFT, dash=dash))
        marks.append(text(x + 28, y, agent.replace("trpo", "TRPO"), colour=SOFT))
    return marks


def main() -> None:
    arguments = tyro.cli(Arguments)
    rows = json.loads(arguments.source.read_text(encoding="utf-8"))["rows"]
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" '
        'font-family="system-ui, sans-serif">'
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="white"/>{draw(rows)}</svg>\n',
        encoding="utf-8",
    )
    print(arguments.out.name)


if __name__ == "__main__":
    main()
