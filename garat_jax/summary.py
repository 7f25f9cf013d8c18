"""What a transfer experiment found: `summary.json` and the report. No JAX."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
from scipy import stats

from garat_jax import report
from garat_jax.plain import to_plain
from garat_jax.report import Fact, Figure, Section, Table
from garat_jax.runs import RunDirectory

SOURCE_FRACTION = 0.3
"""A seed is meaningful only if its source policy gets less than this share of the target's."""
TARGET_FRACTION = 0.95
"""And only if its target policy gets at least this share of what counts as solved."""
CONTROLS = {"more_source_training": "more source training", "action_noise": "action noise only"}
"""What is trained beside the method, and what that is called."""
REASONS = (
    "the source policy does not solve the source",
    "the policy trained in the target does not solve it",
    "the source policy works in the target as it is",
)
"""Why a seed is not meaningful."""


def summarise(
    *,
    pair: str,
    method: str,
    seeds: Sequence[int],
    solved_return: float,
    source_solved: np.ndarray,
    returns: Mapping[str, np.ndarray],
    errors: Mapping[str, np.ndarray],
    curve: Sequence[Mapping[str, Any]],
    target_transitions: int,
    num_episodes: int,
    env_steps: Mapping[str, np.ndarray],
    seconds: Mapping[str, float],
) -> dict[str, Any]:
    """Return the content of `summary.json` (format "garat-transfer/1").

    Args:
        pair: The pair's name.
        method: The method's name.
        seeds: The seeds.
        solved_return: Return from which the task counts as solved.
        source_solved: Whether the source policy solved the source, [seeds].
        returns: Mean target returns [seeds] of `source_policy`, `target_policy`, `method` and the
            controls.
        errors: Held-out transition errors [seeds] of `source`, `grounded` and the baselines.
        curve: The logged lines of the grounding.
        target_transitions: How many target transitions the method saw.
        num_episodes: Episodes that each mean return is of.
        env_steps: Environment steps that each policy saw, [seeds]; those of the source policy that
            it came from are among them.
        seconds: Wall time spent compiling and running.
    """
    source, target = returns["source_policy"], returns["target_policy"]
    solved = solved_return - (1.0 - TARGET_FRACTION) * abs(solved_return)
    is_lost = target - source > (1.0 - SOURCE_FRACTION) * np.abs(target)  # returns may be costs
    kept = np.stack([source_solved, target >= solved, is_lost])
    meaningful = np.asarray(kept.all(axis=0))
    scaled = {
        name: scale(returns[name], source, target, meaningful) for name in ("method", *CONTROLS)
    }
    content = {
        "format": "garat-transfer/1",
        "pair": pair,
        "method": method,
        "seeds": seeds,
        "returns": {name: returns[name] for name in ("source_policy", "target_policy", "method")},
        "source_solved": source_solved,
        "meaningful": meaningful,
        "not_meaningful_because": [None if k.all() else REASONS[np.argmin(k)] for k in kept.T],
        "scaled": scaled["method"],
        "controls": {name: {"returns": returns[name], "scaled": scaled[name]} for name in CONTROLS},
        "transition_error": {name: errors[name] for name in ("source", "grounded", "zero_action")},
        "error_ratio": errors["grounded"] / errors["source"],
        "baselines": {
            name: {"error": errors[name], "ratio": errors[name] / errors["source"]}
            for name in ("zero_action", "constant_action")
        },
        "transition_error_curve": {
            "update": [line["step"] for line in curve],
            "grounded": [line["error"] for line in curve],
        },
        "target_transitions": target_transitions,
        "num_episodes": num_episodes,
        "env_steps": env_steps,
        "seconds": seconds,
    }
    return to_plain(content)


def scale(
    returns: np.ndarray, source: np.ndarray, target: np.ndarray, meaningful: np.ndarray
) -> dict[str, Any]:
    """Scale returns so that the source policy is 0 and the target policy 1.

    Args:
        returns: Mean target returns, [seeds].
        source: Those of the source policies, [seeds].
        target: Those of the target policies, [seeds].
        meaningful: Which seeds count; the others are None in `per_seed` and not averaged in.

    Returns:
        Mean, standard error of the mean (None where it cannot be had) and values per seed.
    """
    gap = np.where(meaningful, target - source, 1.0)
    values = (returns - source) / gap
    counted = values[meaningful]
    spread = counted.std(ddof=1) / np.sqrt(len(counted)) if len(counted) > 1 else None
    return {
        "mean": counted.mean() if len(counted) else None,
        "standard_error": spread,
        "per_seed": [
            float(value) if good else None for value, good in zip(values, meaningful, strict=True)
        ],
    }


def counted(summary: Mapping[str, Any], values: Sequence[float]) -> np.ndarray:
    """Return those of some values, [seeds], that count: of meaningful seeds, or all if none is."""
    meaningful = np.asarray(summary["meaningful"], bool)
    return np.asarray(values, float)[meaningful if meaningful.any() else slice(None)]


def _error_ratio(summary: Mapping[str, Any]) -> float:
    """Return the mean error of one step of the grounded source, as a share of the source's."""
    return float(counted(summary, summary["error_ratio"]).mean())


def write_report(run: RunDirectory, summary: Mapping[str, Any], difference: str) -> None:
    """Write `report.html` for a summary; `difference` says how target and source differ."""
    report.write(
        run.path("report.html"),
        title=f"{summary['pair']}: {summary['method']}",
        lead=lead(summary),
        facts=facts(summary),
        sections=sections(summary, difference),
        reproduce=report.Reproduce.from_config(run.read_json("config.json")),
        kind="Transfer to another world",
    )


def lead(summary: Mapping[str, Any]) -> str:
    """Say in two sentences what came out."""
    mean = summary["scaled"]["mean"]
    if mean is None:
        return (
            f"No seed is meaningful: {_left_out(summary)}. Nothing can be said about the method "
            "from this run."
        )
    return (
        f"After grounding, the policy reaches {mean:.2f} of the way from the source policy (0) to "
        "a policy trained in the target (1), and one step of the grounded source is off by "
        f"{_error_ratio(summary):.2f} times what one step of the source is. "
        f"{_beside_controls(summary)}"
    )


def _beside_controls(summary: Mapping[str, Any]) -> str:
    """Say whether the better control leaves it to grounding that the policy transfers."""
    scaled = {name: summary["controls"][name]["scaled"] for name in CONTROLS}
    name = max(CONTROLS, key=lambda name: scaled[name]["mean"])
    beside = f"{CONTROLS[name].capitalize()}, the better of two controls, reaches"
    beside += f" {scaled[name]['mean']:.2f}"
    lead = counted(summary, summary["scaled"]["per_seed"])
    lead -= counted(summary, scaled[name]["per_seed"])
    if len(lead) == 1:
        return f"{beside}; one seed cannot tell whether that is chance."
    half = stats.t.ppf(0.975, len(lead) - 1) * lead.std(ddof=1) / np.sqrt(len(lead))
    shows = round(summary["scaled"]["mean"], 2) > round(scaled[name]["mean"], 2)
    if shows and lead.mean() > half:
        return f"{beside}: the difference is the work of grounding."
    return f"{beside}: these seeds do not show that it is grounding that helps."


def _left_out(summary: Mapping[str, Any]) -> str:
    """Say which seeds are not meaningful, and why."""
    reasons = zip(summary["seeds"], summary["not_meaningful_because"], strict=True)
    return "; ".join(f"seed {seed}: {reason}" for seed, reason in reasons if reason)


def describe(summary: Mapping[str, Any]) -> str:
    """Return the result in a few lines for a terminal."""
    controls = summary["controls"]
    baseline = counted(summary, summary["baselines"]["zero_action"]["ratio"]).mean()
    has_spread = summary["scaled"]["standard_error"] is not None
    spread = ", mean ± standard error" if has_spread else ""
    lines = [
        lead(summary),
        f"Scaled return in the target (0: source policy, 1: policy trained there){spread}:",
        f"  {summary['method']:<22}{_with_error(summary['scaled'])}",
        *(
            f"  {label:<22}{_with_error(controls[name]['scaled'])}"
            for name, label in CONTROLS.items()
        ),
        f"Error of one step, share of the source's: {_error_ratio(summary):.3f}; "
        f"with zero action {baseline:.3f}.",
    ]
    return "\n".join(lines)


def facts(summary: Mapping[str, Any]) -> list[Fact]:
    """Return the numbers to be seen first."""
    scaled = {"method": summary["scaled"]} | {
        name: summary["controls"][name]["scaled"] for name in CONTROLS
    }
    labels = {
        "method": f"{summary['method']}, scaled return",
        "more_source_training": "control: more source training",
        "action_noise": "control: action noise only",
    }
    shown = [Fact(_with_error(scaled[name]), label) for name, label in labels.items()]
    return [*shown, Fact(f"{_error_ratio(summary):.2f}", "error, share of the source's")]


def _with_error(scaled: Mapping[str, Any]) -> str:
    if scaled["mean"] is None:
        return "–"
    if scaled["standard_error"] is None:
        return f"{scaled['mean']:.2f}"
    return f"{scaled['mean']:.2f} ± {scaled['standard_error']:.2f}"


def sections(summary: Mapping[str, Any], difference: str) -> list[Section]:
    """Return the report's sections; the demo's report takes them too."""
    return [
        Section(
            "Does the policy transfer?",
            f"The target is {difference}. A policy that solves the source fails there. "
            f"{summary['method']} learns from {summary['target_transitions']} transitions of the "
            "target how the source's actions must be changed so that it moves like the target; "
            "the policy then trains on in that grounded source.\n\n"
            "Two controls say whether grounding did the work: as much more training in the "
            "ungrounded source, and the same training with noise on the actions.",
            figures=[Figure(_returns_figure(summary), _returns_caption(summary))],
            tables=[_returns_table(summary)],
        ),
        Section(
            "Does the grounded source move like the target?",
            "Each held-out step of the target is taken again in the source: same state, same "
            "action, one step. The error is the distance between the two next observations (L2).",
            figures=[
                Figure(
                    _error_figure(summary),
                    "Mean error of one step over the adversarial updates, one line a seed. Dashed: "
                    "the source as it is, and the source when every action is replaced by zero "
                    "(means over the meaningful seeds, or all if none is). A method below the zero "
                    "line has learned more than to weaken the actions.",
                )
            ],
        ),
    ]


def _bars(summary: Mapping[str, Any]) -> dict[str, list[float | None]]:
    count = len(summary["seeds"])
    return {
        "source policy": [0.0] * count,
        "more source training": summary["controls"]["more_source_training"]["scaled"]["per_seed"],
        "action noise only": summary["controls"]["action_noise"]["scaled"]["per_seed"],
        summary["method"]: summary["scaled"]["per_seed"],
        "policy trained in the target": [1.0] * count,
    }


def _returns_figure(summary: Mapping[str, Any]) -> go.Figure:
    figure = go.Figure()
    for name, values in _bars(summary).items():
        kept = [value for value in values if value is not None]
        own = name == summary["method"]
        figure.add_bar(
            x=[name],
            y=[float(np.mean(kept)) if kept else None],
            marker_color=report.COLOURS[0] if own else "#c5ccd6",
            showlegend=False,
        )
        figure.add_scatter(
            x=[name] * len(kept),
            y=kept,
            mode="markers",
            marker={"color": report.INK, "size": 6, "opacity": 0.6},
            showlegend=False,
        )
    return report.styled(figure, yaxis_title="scaled return in the target")


def _returns_caption(summary: Mapping[str, Any]) -> str:
    left_out = _left_out(summary)
    note = f" Left out as not meaningful: {left_out}." if left_out else ""
    episodes = summary["num_episodes"]
    return f"Mean over seeds (bars) and every seed (dots), {episodes} episodes each.{note}"


def _returns_table(summary: Mapping[str, Any]) -> Table:
    columns = {
        "source policy": summary["returns"]["source_policy"],
        "more source training": summary["controls"]["more_source_training"]["returns"],
        "action noise only": summary["controls"]["action_noise"]["returns"],
        summary["method"]: summary["returns"]["method"],
        "target policy": summary["returns"]["target_policy"],
    }
    rows = [
        [seed, *(round(values[i], 1) for values in columns.values()), "yes" if good else "no"]
        for i, (seed, good) in enumerate(zip(summary["seeds"], summary["meaningful"], strict=True))
    ]
    return Table(
        ["seed", *columns, "meaningful"], rows, "Mean return in the target, unscaled, by seed."
    )


def _error_figure(summary: Mapping[str, Any]) -> go.Figure:
    figure = go.Figure()
    curve = summary["transition_error_curve"]
    values = np.asarray(curve["grounded"])
    for i, seed in enumerate(summary["seeds"]):
        figure.add_scatter(
            x=curve["update"],
            y=values[:, i] if values.size else [],
            name=f"grounded, seed {seed}",
            line={"color": report.COLOURS[0], "width": 1.5},
            opacity=0.75,
            showlegend=False,
        )
    labels = {"source": "source as it is", "zero_action": "zero action"}
    for colour, (name, label) in zip(report.COLOURS[1:], labels.items(), strict=False):
        mean = float(counted(summary, summary["transition_error"][name]).mean())
        figure.add_hline(
            y=mean,
            line={"color": colour, "dash": "dash"},
            annotation_text=label,
            annotation_position="top right",
        )
    top = 1.15 * float(np.max([summary["transition_error"]["source"], *curve["grounded"]]))
    return report.styled(
        figure,
        xaxis_title="adversarial update",
        yaxis_title="error of one step",
        yaxis_range=[0, top],
    )
