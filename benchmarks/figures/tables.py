"""Write the tables of README.md and docs/ from the result files.

`python benchmarks/figures/tables.py` replaces what stands between `<!-- table NAME -->` and
`<!-- end -->`; with `--check` it only says whether anything would change.
"""

import dataclasses
import functools
import re
import sys
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import speed_tables
import tyro
from results import ENGINES, ROOT, commits, origin, read, table

from garat_jax.summary import counted

BLOCK = re.compile(r"(<!-- table (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Write the tables of README.md and docs/ from the result files."""

    check: bool = False
    """Change nothing; exit with 1 if a table is not what its result file gives."""


def spread(scaled: dict[str, Any]) -> str:
    if scaled["mean"] is None:
        return "not meaningful"
    return f"{scaled['mean']:.2f} ± {scaled['standard_error']:.2f}"


def transfer() -> str:
    name = "transfer_inverted_pendulum_heavy"
    result = read(name)
    row = result["rows"][0]
    controls, returns = row["controls"], row["returns"]

    def mean(values: Sequence[float]) -> str:
        return f"{np.mean(values):.0f}"

    rows = [
        ("source policy", "0", mean(returns["source_policy"])),
        (
            "control: as much more training in the source",
            spread(controls["more_source_training"]["scaled"]),
            mean(controls["more_source_training"]["returns"]),
        ),
        (
            "control: as much training with action noise",
            spread(controls["action_noise"]["scaled"]),
            mean(controls["action_noise"]["returns"]),
        ),
        ("**GARAT**", f"**{spread(row['scaled'])}**", mean(returns["method"])),
        ("policy trained in the target", "1", mean(returns["target_policy"])),
    ]
    columns = ("trained in", "scaled return in the target", "return (of 1000)")
    ratio = counted(row, row["error_ratio"])
    zero = counted(row, row["baselines"]["zero_action"]["ratio"])
    text = (
        f"\nMean ± standard error over {sum(row['meaningful'])} meaningful of "
        f"{len(row['seeds'])} seeds, 50 episodes each, {row['target_transitions']} target "
        f"transitions. Error of one step, as a share of the source's: **{ratio.mean():.3f}** "
        f"(worst seed {ratio.max():.3f}); with every action replaced by zero {zero.mean():.2f}.\n"
    )
    return table(columns, rows) + text + origin(name, result)


def variants() -> str:
    result = read("grounding_variants")
    rows = [
        (
            row["variant"],
            "diverged" if row["mean"] is None else f"{row['mean']:.3f}",
            "" if row["worst"] is None else f"{row['worst']:.3f}",
        )
        for row in result["rows"]
    ]
    columns = ("variant", "error ratio after 50 updates, mean", "worst seed")
    return table(columns, rows) + origin("grounding_variants", result)


def flags() -> str:
    result = read("xla_flags")
    emitters = {True: "on (XLA's default)", False: "off", None: "–"}
    rows = [
        (
            row["model"].replace("_", " "),
            ENGINES[row["engine"]],
            emitters[row["fusion_emitters"]],
            f"{row['steps_per_second']:,.0f}",
            f"{row['compile_processor_seconds']:.1f}",
        )
        for row in result["rows"]
    ]
    columns = ("model", "engine", "fusion emitters", "steps/s", "compilation, processor seconds")
    return table(columns, rows) + origin("xla_flags", result)


def optimisation_level() -> str:
    result = read("optimisation_level")
    rows = [
        (
            row["pair"].replace("_", " "),
            row["agent"],
            "XLA's default" if row["level"] is None else str(row["level"]),
            f"{row['compile_seconds']:.1f}",
            f"{row['iteration_seconds']:.2f}",
        )
        for row in result["rows"]
    ]
    columns = ("pair", "agent", "level", "compilation, s", "an iteration, s")
    return table(columns, rows) + origin("optimisation_level", result)


def profiling_clock() -> str:
    result = read("profiling_clock")
    ways = tuple(result["rows"][0]["steps_per_second"])
    rows = []
    for row in result["rows"]:
        rates = [row["steps_per_second"][way] for way in ways]
        gains = (f"{rate:,.0f} (× {rate / rates[0]:.2f})" for rate in rates[1:])
        rows.append((row["pair"].replace("_", " "), f"{rates[0]:,.0f}", *gains))
    columns = ("source of", "as MuJoCo's package is", "without the clock", "without islands, too")
    return table(columns, rows) + origin("profiling_clock", result)


def hidden_effects(seed: int, category: str = "") -> str:
    """One row a measure, beside what it is held to; of all the sets of a seed, or of a category."""
    name = f"hidden_effects_seed_{seed}{category and '_'}{category}"
    result = read(name)
    lines = []
    for line in result["table"]:
        if line.get("interval") is None:
            continue
        target = line.get("target")
        low, high = line["interval"]
        lines.append(
            (
                line["measure"],
                f"{100 * line['value']:.0f} %",
                f"{100 * low:.0f}–{100 * high:.0f} %",
                str(line["count"]),
                "" if target is None else _span(*target),
            )
        )
    seconds = next(line for line in result["table"] if line["measure"] == "seconds a set")
    text = (
        f"\n{result['sample']} of {result['cases']} sets of recordings, seed "
        f"{result['seeds'][0]}; a set took {seconds['value']:.0f} s (median), at most "
        f"{seconds['largest']:.0f} s. The result file names the sets that fall short.\n"
    )
    columns = ("measure", "share", "95 % interval", "of", "held to")
    of = commits(result["rows"], result["git"]["commit"])
    return table(columns, lines) + text + of + origin(name, result)


def hidden_effects_others(seeds: tuple[int, ...]) -> str:
    """One row a measure and one column a seed, with where each came from."""
    results = {seed: read(f"hidden_effects_seed_{seed}") for seed in seeds}
    shares = [
        {line["measure"]: line for line in result["table"] if line.get("interval") is not None}
        for result in results.values()
    ]
    rows = [
        (
            measure,
            *(f"{100 * of[measure]['value']:.0f} % of {of[measure]['count']}" for of in shares),
        )
        for measure in shares[0]
    ]
    sets = [f"{result['sample']} of {result['cases']}" for result in results.values()]
    columns = ("measure", *(f"seed {seed}" for seed in seeds))
    origins = [
        commits(result["rows"]) + origin(f"hidden_effects_seed_{seed}", result)
        for seed, result in results.items()
    ]
    return table(columns, [*rows, ("sets of recordings", *sets)]) + "".join(origins)


def timing() -> str:
    """One row a set: what each tool took and found; mujoco.sysid is told what to fit."""
    result = read("hidden_effects_timing")
    rows = []
    for row in result["rows"]:
        (secret,) = row["secrets"]
        ((_, true),) = secret["parameters"].items()
        ran, theirs = row["sysid_median"] is not None, row["sysid_found"]
        rows.append(
            (
                f"{row['robot']}, 4 × {row['seconds']:g} s, {secret['kind']} {true:g}",
                f"{row['garat_median']:.1f}",
                f"{row['limit']:g}",
                f"{row['garat_with_training_options_median']:.1f}",
                ", ".join(f"{c['effect']} {_sizes(c)}" for c in row["garat_found"]),
                f"{row['sysid_median']:.1f}" if ran else "–",
                f"{theirs['estimate']:.4g} ± {theirs['half_interval']:.2g}" if ran else theirs,
            )
        )
    options = "with training's options, s"
    columns = ("set", "diagnosis, s", "held to, s", options, "found", "mujoco.sysid, s", "fitted")
    return table(columns, rows) + origin("hidden_effects_timing", result)


def _sizes(found: dict[str, Any]) -> str:
    sizes = found["parameters"].values()
    return " ".join(f"{v['estimate']:.4g} ± {(v['high'] - v['low']) / 2:.2g}" for v in sizes)


def _span(low: float, high: float) -> str:
    return f"≥ {100 * low:.0f} %" if high == 1 else f"{100 * low:.0f}–{100 * high:.0f} %"


def real_data() -> str:
    result = read("real_data")

    def said(found: dict[str, Any]) -> str:
        name, size = next((k, v) for k, v in found.items() if isinstance(v, dict))
        alike = found["indistinguishable_from"]
        others = alike if len(alike) < 3 else [f"one of {len(alike)} others"]
        sized = f"{found['effect']} at {found['target']}, {name} {size['estimate']:.3g}"
        return " or ".join((f"{sized} {size['unit']}", *others))

    def named(row: dict[str, Any]) -> str:
        return "; ".join(said(found) for found in row["selected"]) or "–"

    rows = [
        (
            row["case"].replace("_", " "),
            row["verdict"].replace("_", " "),
            named(row),
            f"{row['error']['before']:.3g} → {row['error']['after']:.3g}",
            f"{row['error']['noise_floor']:.3g}",
            f"{row['error']['unexplained_share']:.2f}",
            f"{row['whole_runs']['before']:.2g} → {row['whole_runs']['after']:.2g}",
        )
        for row in result["rows"]
    ]
    columns = ("recordings", "verdict", "missing", "held-out error", "noise floor", "unexplained")
    columns = (*columns, "whole runs, rad")
    return table(columns, rows) + origin("real_data", result)


def ground() -> str:
    result = read("ground")
    rows = [
        (
            f"{row['case']}: {label}",
            *(f"{100 * errors[label]:.2f}" if label in errors else "–" for errors in by_horizon),
        )
        for row in result["rows"]
        for by_horizon in [[row["horizons"].get(h, {}) for h in ("0.2", "0.5", "1.0", "2.0")]]
        for label in row["errors"]
    ]
    columns = ("held-out error, % of the signals' spread", "0.2 s", "0.5 s", "1 s", "2 s")
    return table(columns, rows) + origin("ground", result)


def fidelity() -> str:
    """MuJoCo's defaults, the fastest settings faithful in both engines, and one iteration."""
    paths = sorted((ROOT / "benchmarks/results").glob("fidelity_*.json"))
    results = [read(path.stem) for path in paths]
    results = [result for result in results if result.get("device", "cpu") == "cpu"]
    if not results:
        return "Not measured yet: `python benchmarks/fidelity.py`.\n"
    lines = []
    for result in results:
        rows: dict[tuple[str, int, int], dict[str, Any]] = {}
        for row in result["rows"]:
            settings = row["solver"], row["iterations"], row["ls_iterations"]
            rows.setdefault(settings, {})[row["engine"]] = row
        strict = next(iter(rows))
        faithful = [name for name, of in rows.items() if all(r["faithful"] for r in of.values())]
        best = max(faithful, key=lambda name: rows[name]["mjx"]["steps_per_second"])
        single = next(name for name in rows if name[1] == 1)
        lines += [
            _settings(rows[name], rows[strict], best)
            for name in dict.fromkeys((strict, best, single))
        ]
    columns = (
        "target of",
        "solver",
        *(f"MJX, {steps}" for steps in ("1 step", "5 steps", "50 steps")),
        *(f"C, {steps}" for steps in ("1 step", "5 steps", "50 steps")),
        "growth of 1e-7, 50 steps",
        "not finite",
        "speed of MJX",
        "of C",
        "faithful in",
    )
    machine = results[0]["machine"]
    commits = ", ".join(sorted({result["git"]["commit"][:7] for result in results}))
    return table(columns, lines) + (
        "\n`python benchmarks/fidelity.py` → `benchmarks/results/fidelity_*.json` "
        f"(commit {commits}, {machine['cores']} cores of an {machine['cpu']})\n"
    )


def _settings(
    engines: dict[str, Any], strict: dict[str, Any], best: tuple[str, int, int]
) -> tuple[str, ...]:
    mjx = engines["mjx"]
    settings = mjx["solver"], mjx["iterations"], mjx["ls_iterations"]
    name = "{} {}/{}".format(*settings)
    trusted = [{"mjx": "MJX", "mujoco": "C"}[e] for e, row in engines.items() if row["faithful"]]
    return (
        mjx["pair"],
        f"**{name}**" if settings == best else name,
        *(f"{row['qvel_error'][h]:.0e}" for row in engines.values() for h in ("1", "5", "50")),
        f"{mjx['qvel_growth']['50']:.0e}",
        str(sum(row["not_finite"] for row in engines.values())),
        *(
            f"{row['steps_per_second'] / strict[engine]['steps_per_second']:.1f} x"
            for engine, row in engines.items()
        ),
        " and ".join(trusted) or "neither",
    )


TABLES: dict[str, Callable[[], str]] = {
    "transfer": transfer,
    "variants": variants,
    "throughput": speed_tables.throughput,
    "throughput_gpu": speed_tables.throughput_gpu,
    "parts": speed_tables.parts,
    "learning": speed_tables.learning,
    "targets": speed_tables.targets,
    "start": speed_tables.start,
    "growth": speed_tables.growth,
    "growth_gpu": speed_tables.growth_gpu,
    "seeds_together": speed_tables.seeds_together,
    "memory": speed_tables.memory,
    "flags": flags,
    "fidelity": fidelity,
    "optimisation_level": optimisation_level,
    "profiling_clock": profiling_clock,
    "hidden_effects": functools.partial(hidden_effects, 16),
    "hidden_effects_outside": functools.partial(hidden_effects, 16, "outside"),
    "hidden_effects_pairs": functools.partial(hidden_effects, 14, "pair"),
    "hidden_effects_others": functools.partial(
        hidden_effects_others, (15, 12, 11, 10, 9, 8, 7, 6, 5, 4)
    ),
    "timing": timing,
    "real_data": real_data,
    "ground": ground,
}


def filled(text: str) -> str:
    """Return a document with its tables as the result files give them."""
    return BLOCK.sub(lambda block: block[1] + TABLES[block[2]]() + block[3], text)


def main() -> None:
    check = tyro.cli(Arguments).check
    stale = []
    for path in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))):
        text = path.read_text(encoding="utf-8")
        if filled(text) != text:
            stale.append(path.relative_to(ROOT).as_posix())
            if not check:
                path.write_text(filled(text), encoding="utf-8")
    if stale:
        print(("stale: " if check else "written: ") + ", ".join(stale))
    sys.exit(1 if stale and check else 0)


if __name__ == "__main__":
    main()
