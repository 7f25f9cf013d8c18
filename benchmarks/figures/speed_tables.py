"""The tables of docs/performance.md on learning: beside others, by parts, growing, together."""

from typing import Any

from results import ENGINES, ROOT, commits, if_measured, table

WORLDS = {
    "inverted_pendulum": "InvertedPendulum",
    "hopper": "Hopper",
    "half_cheetah": "HalfCheetah",
    "walker2d": "Walker2d",
    "ant": "Ant",
    "minitaur": "Minitaur",
}
"""Names of environments, in the order of the columns."""
ALGORITHMS = {
    "trpo": "TRPO",
    "ppo": "PPO",
    "trpo, Fisher from a fifth": "TRPO, Fisher from a fifth",
}
PARTS = {
    "rollout": "rollout",
    "advantages": "advantages",
    "policy": "policy's step",
    "direction": "of that, Fisher products",
    "value": "value fit",
    "statistics": "statistics",
}


def throughput() -> str:
    return if_measured(_throughput, "throughput")


def throughput_gpu() -> str:
    return if_measured(_throughput, "throughput_gpu")


def _throughput(result: dict[str, Any]) -> str:
    """One row a side and one column a world: steps/s, and in brackets what it is compared with."""
    rows = result["rows"]
    worlds = [name for name in WORLDS if any(row["env"] == name for row in rows)]
    cells: dict[str, dict[str, str]] = {}
    for row in rows:
        cells.setdefault(_side(row), {})[row["env"]] = _rate(row)
    lines = [(side, *(found.get(name, "") for name in worlds)) for side, found in cells.items()]
    return table(("steps/s", *(WORLDS[name] for name in worlds)), lines) + _ceiling(rows, worlds)


def _ceiling(rows: list[dict[str, Any]], worlds: list[str]) -> str:
    """Say how much faster than the peer's TRPO the engine is that both step, at random actions."""
    parts = []
    for name in worlds:
        of_world = [row for row in rows if row["env"] == name]
        engine = [r["steps_per_second"] for r in of_world if r["agent"] == "engine alone"]
        peers = [
            r["steps_per_second"]
            for r in of_world
            if r["agent"] == "sb3-contrib trpo" and r["stepped"] != OWN
        ]
        if engine and peers:
            parts.append(f"{max(engine) / max(peers):.1f} times on {WORLDS[name]}")
    if not parts:
        return ""
    return (
        "\nStepping the physics alone, without a learner, is faster than sb3-contrib's TRPO by "
        f"{', '.join(parts)}: about the most that a learner in the same world could gain.\n"
    )


def _side(row: dict[str, Any]) -> str:
    """Name a row's side."""
    library, _, algorithm = row["agent"].rpartition(" ")
    if "version" in row:
        name = f"{library} {ALGORITHMS[algorithm]}"
        return f"{name} in Gymnasium's own world" if row.get("stepped") == OWN else name
    name = ALGORITHMS.get(row["agent"], row["agent"])
    if row["agent"] in ALGORITHMS:
        name = f"**{name}**"
    seeds = "" if row["seeds"] == 1 else f", {row['seeds']} seeds"
    envs = "" if row["envs"] == PRESET_ENVS else f", {row['envs']} environments"
    return f"{name}{seeds}{envs}{', MJX' if row['engine'] == 'mjx' else ''}"


FIGURE = "figures/growth.svg"
"""What figures/growth.py draws, seen from docs/."""
PRESET_ENVS = 50
OWN = "Gymnasium's own"
"""How `torch_peers.py` calls it."""


def _rate(row: dict[str, Any]) -> str:
    rate = f"{row['steps_per_second']:,.0f}"
    if "ours_over_this" in row:
        return f"{rate} (× {row['ours_over_this']:.1f})"
    if row["agent"] in ALGORITHMS:
        shares = [row["share_of_random_actions"], row.get("share_of_engine_alone")]
        told = [f"{100 * share:.0f} %" for share in shares if share is not None]
        return f"{rate} ({', '.join(told)})"
    return rate


def parts() -> str:
    return if_measured(_parts, "throughput", "parts_of_a_trpo_iteration")


def _parts(result: dict[str, Any]) -> str:
    """One row a world and number of seeds: what each part of an iteration of TRPO takes."""
    costs = result["parts_of_a_trpo_iteration"]
    rows = [
        (
            f"{WORLDS[cost['env']]}, {cost['seeds']} seed{'s' if cost['seeds'] > 1 else ''}",
            *(f"{1e3 * cost['seconds'][part]:.1f}" for part in PARTS),
            f"{1e3 * cost['seconds']['iteration']:.0f}",
        )
        for cost in costs
    ]
    return table(("ms in an iteration", *PARTS.values(), "whole iteration"), rows)


def learning() -> str:
    return if_measured(_learning, "learning")


def _learning(result: dict[str, Any]) -> str:
    """One row a world, trust region and agent: mean returns at each point of the training."""
    fewest = min(len(row["solved"]) for row in result["rows"])
    more = {n: f", {n} seeds" for row in result["rows"] if (n := len(row["solved"])) > fewest}
    lines = [
        (
            f"{WORLDS[row['env']]}, KL ≤ {row['max_kl']:g}, {row['agent']}"
            + more.get(len(row["solved"]), ""),
            *(f"{sum(returns) / len(returns):,.0f}" for returns in row["returns"][:-1]),
            f"**{row['mean']:,.0f} ± {row['standard_error']:,.0f}**",
        )
        for row in result["rows"]
    ]
    steps = [f"{steps:,} steps" for steps in result["rows"][0]["steps"]]
    return table(("mean return", *steps), lines) + commits(result["rows"])


def targets() -> str:
    return if_measured(_targets, "learning", "targets")


def _targets(result: dict[str, Any]) -> str:
    """One row a pair: what ours reaches in its target, and how many seeds solve it."""
    lines = [
        (
            row["env"],
            f"{row['max_kl']:g}",
            f"{row['steps'][-1]:,}",
            *(f"{sum(returns) / len(returns):,.4g}" for returns in row["returns"]),
            f"{row['solved_return']:,.4g}",
            f"{sum(row['solved'])} of {len(row['solved'])}",
        )
        for row in result["targets"]
    ]
    points = len(result["targets"][0]["steps"])
    parts = [f"after {100 * (k + 1) // points} %" for k in range(points)]
    columns = ("target of", "KL ≤", "steps", *parts, "solved from", "seeds that solve it")
    return table(columns, lines) + commits(result["targets"])


def start() -> str:
    return if_measured(_start, "start")


def _start(result: dict[str, Any]) -> str:
    """One row an engine: seconds from the command to the first update, without and with a cache."""
    lines = [
        (
            ENGINES[row["engine"]],
            f"{row['cold_seconds']:.1f}",
            f"{row['warm_seconds']:.1f}",
        )
        for row in result["rows"]
    ]
    return table(("engine", "empty cache, s", "second start, s"), lines)


def growth() -> str:
    return if_measured(_growth, "growth")


def growth_gpu() -> str:
    return if_measured(_sizes, "growth_gpu")


def _growth(result: dict[str, Any]) -> str:
    """The figure, and the tables below it."""
    figure = f"![Steps a second against environments and against seeds]({FIGURE})\n\n"
    return (figure if (ROOT / "docs" / FIGURE).is_file() else "") + _sizes(result)


def _sizes(result: dict[str, Any]) -> str:
    """One row a world and one column a size: steps/s of TRPO, and of random actions below it."""
    rows, text = result["rows"], ""
    for grows, what in (("envs", "environments"), ("seeds", "seeds of 50 environments")):
        chosen = [row for row in rows if row["grows"] == grows]
        sizes = sorted({row[grows] for row in chosen})
        lines = []
        for name in dict.fromkeys(row["env"] for row in chosen):
            for agent in ("trpo", "random actions"):
                found = {
                    row[grows]: f"{row['steps_per_second']:,.0f}"
                    for row in chosen
                    if row["env"] == name and row["agent"] == agent
                }
                side = f"{WORLDS[name]}, {ALGORITHMS.get(agent, agent)}"
                lines.append((side, *(found.get(size, "") for size in sizes)))
        text += table((f"steps/s, {what}:", *(f"{size:,}" for size in sizes)), lines) + "\n"
    return text.rstrip("\n") + "\n"


def seeds_together() -> str:
    return if_measured(_seeds_together, "seeds_together")


def _seeds_together(result: dict[str, Any]) -> str:
    rows = [
        (
            f"{WORLDS[row['env']]}, {row['seeds']} × {row['steps_of_each']:,} steps",
            row["cache"],
            f"{row['together_seconds']:.0f}",
            f"{row['one_after_another_seconds']:.0f}",
            f"{row['ratio']:.2f}",
        )
        for row in result["rows"]
    ]
    columns = ("", "compilation cache", "together [s]", "one after another [s]", "ratio")
    return table(columns, rows)


def memory() -> str:
    return if_measured(_memory, "memory")


def _memory(result: dict[str, Any]) -> str:
    parts = ("peak", "iteration", "states")
    rows = [
        (row["pair"], *(f"{row[f'{part}_mebibytes']:,.0f}" for part in parts))
        for row in result["rows"]
    ]
    head = ("process", "on the way in an iteration", "states, before and after it")
    return table((f"{result['rows'][0]['seeds']} seeds, MiB at most", *head), rows)
