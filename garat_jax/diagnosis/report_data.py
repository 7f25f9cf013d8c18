"""Sections about the recordings themselves, about what is left, and about measured torques."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import plotly.graph_objects as go

from garat_jax.diagnosis.figures import label, words
from garat_jax.diagnosis.findings import Drift, Named, Repeated, Unseen
from garat_jax.diagnosis.quality import Quality
from garat_jax.diagnosis.residuals import Residuals
from garat_jax.diagnosis.results import OFFER, Diagnosis
from garat_jax.diagnosis.torque import TorqueError
from garat_jax.report import COLOURS, SOFT, Figure, Section, Table, styled

if TYPE_CHECKING:
    from garat_jax.diagnosis.compare import Comparison

MOST_DRAWN = 4
"""Signals whose correlations are drawn, the least random first."""


def recordings_section(recordings: Sequence[Quality]) -> Section:
    """Return what the recordings are worth: rates, gaps, noise, steps and command lags."""
    rows = [
        (
            q.name,
            round(q.seconds, 2),
            round(q.rate, 1),
            "even" if q.irregularity < 0.01 else f"varies by {100 * q.irregularity:.0f} %",
            q.gaps,
            q.velocity,
            "; ".join(_lag(name, lag) for name, lag in q.command_lag.items()) or "no commands",
        )
        for q in recordings
    ]
    channels = [
        (q.name, name, c.unit, c.noise, c.step if c.step > 0 else "none seen")
        for q in recordings
        for name, c in q.channels.items()
    ]
    return Section(
        "What the recordings are worth",
        "Noise and steps of the sensors limit what any model can predict. A command lag means that "
        "the torque, as the motion shows it, follows the recorded command that much later.",
        tables=[
            Table(
                [
                    "recording",
                    "seconds",
                    "rate [Hz]",
                    "sampling",
                    "gaps",
                    "velocity",
                    "command lag",
                ],
                rows,
                "Velocities that were not measured are estimated from positions and are not held "
                "against the model.",
            ),
            Table(
                ["recording", "signal", "unit", "noise", "step"],
                channels,
                "Noise: standard deviation of what changes from sample to sample at random. Step: "
                "the smallest difference between two values, of an encoder for example.",
            ),
        ],
    )


def residuals_section(residuals: Residuals, sentence: str, horizon: float) -> Section:
    """Return whether what the model leaves is random."""
    rows = [
        (
            w.signal,
            "its own past",
            max(w.correlation, key=abs, default=0.0),
            w.bound,
            f"{w.outside} of {len(w.correlation)}",
            "random" if w.white else "not random",
        )
        for w in residuals.whiteness
    ]
    rows += [
        (
            i.signal,
            i.input,
            max(i.correlation, key=abs, default=0.0),
            i.bound,
            f"{i.outside} of {len(i.correlation)}",
            "random" if i.independent else "not random",
        )
        for i in residuals.independence
    ]
    columns = ["signal", "against", "largest", "bound", "beyond", "verdict"]
    return Section(
        "Is what the model leaves random?",
        f"{sentence}\n\nThe deviations of predictions over {horizon:g} s are correlated with "
        "themselves and with the commands of some samples before. Noise stays within the bounds; "
        "what goes beyond them is something that a better model could explain.",
        figures=[
            Figure(
                _correlations(residuals),
                "Correlation of each deviation with itself some time before. Dotted: 99 % of pure "
                "noise stays within.",
                "Autocorrelation of the deviations",
            )
        ],
        tables=[
            Table(
                columns,
                rows,
                "Largest: the largest correlation at any lag, -1 to 1. Beyond: at how many lags it "
                "exceeds the bound; noise does so at two at most.",
            )
        ],
    )


def torque_section(torques: Sequence[TorqueError]) -> list[Section]:
    """Return how measured torques and the model's differ; nothing without measurements."""
    if not torques:
        return []
    rows = [
        (
            t.joint,
            t.unit,
            t.measured_rms,
            t.motion_rmse,
            round(t.motion_fit_percent, 1),
            t.actuator_rmse,
            round(t.actuator_fit_percent, 1),
        )
        for t in torques
    ]
    columns = ["joint", "unit", "measured", "motion", "fit [%]", "actuators", "fit [%]"]
    return [
        Section(
            "Measured torques",
            "A good controller makes the position right whatever the model lacks; the torque that "
            "it had to give then tells. Two torques of the model are held against the measured "
            "one: the torque that the recorded motion takes in the model (inverse dynamics), and "
            "the torque that its actuators give for the recorded commands.\n\n"
            "Where the first differs, friction, mass or load is wrong; where the second differs, "
            "the actuators are.",
            tables=[
                Table(
                    columns,
                    rows,
                    "Measured: root mean square. Motion, actuators: root mean square difference. "
                    "Fit: 100 % is the same torque, 0 % is no better than the mean.",
                )
            ],
        )
    ]


def repeatability_section(diagnosis: Diagnosis) -> list[Section]:
    """Return whether each recording alone shows the same effect and size; nothing without any."""
    found = [(r, "") for r in diagnosis.repeatability]
    for name, other in diagnosis.conditions.items():
        found += [(r, f" ({name})") for r in other.repeatability]
    if not found:
        return []
    rows = [
        (
            f"{r.effect.replace('_', ' ')} at {r.target}{where}: {r.parameter}"
            + (f" [{r.unit}]" if r.unit not in ("", "1") else ""),
            s.recording,
            s.estimate,
            f"{s.low:.4g} to {s.high:.4g}" if s.is_sized else "–",
            100 * s.error_without,
            100 * s.error_with,
            _words(s.ahead) or "none",
        )
        for r, where in found
        for s in r.recordings
    ]
    needs = {(r.effect, r.target, where): r for r, where in found}
    lines = [_need(r, where) for (_, _, where), r in needs.items()]
    for r, where in found:
        name = f"{r.parameter} of {r.effect.replace('_', ' ')} at {r.target}{where}"
        if sum(s.is_sized for s in r.recordings) < 2:
            lines.append(f"- {name}: no two recordings tell its size, so none can be compared.")
        elif r.agree:
            lines.append(f"- {name}: the recordings agree within their intervals.")
        else:
            lines.append(
                f"- {name}: the recordings differ by more than their intervals allow "
                f"(p = {r.p_value:.2g}); the effect may change with time, temperature or load, or "
                "stand in for another one."
            )
    columns = ["effect", "recording", "estimate", "95 % interval"]
    columns += ["error without [%]", "with it [%]", "rivals ahead"]
    horizons = {s.horizon: None for r, _ in found for s in r.recordings}
    followed = " or ".join(f"{horizon:.2g}" for horizon in horizons)
    caption = (
        f"Each recording fitted alone, followed for {followed} s at a time, with its 95 % "
        "interval; – where it does not show it. Errors are of that recording's spread; rivals "
        "ahead promise to explain clearly more of it."
    )
    text = "\n".join(lines)
    return [Section("The same in every recording?", text, tables=[Table(columns, rows, caption)])]


def _need(repeated: Repeated, where: str) -> str:
    """Say in which recordings the effect is what each by itself would have asked for first."""
    seen = repeated.recordings
    name = f"{repeated.effect.replace('_', ' ')} at {repeated.target}{where}"
    others = [s for s in seen if not s.is_needed]
    if not others:
        return f"- {name}: every recording by itself asks for this effect first."
    doubts = "; ".join(
        f"{s.recording} for {_words(s.ahead)}" if s.ahead else f"{s.recording} does not need it"
        for s in others
    )
    return f"- {name}: {len(seen) - len(others)} of {len(seen)} recordings ask for it; {doubts}."


def _words(named: Sequence[Named]) -> str:
    return ", ".join(map(label, named))


def drift_section(drifts: Sequence[Drift]) -> list[Section]:
    """Return which parameters change while they are recorded; nothing if none does."""
    if not drifts:
        return []
    lines = [
        f"- The {drift} (95 % interval of the change {drift.change.low:.3g} to "
        f"{drift.change.high:.3g}); that explains {100 * drift.share:.0f} % of what else is left."
        for drift in drifts
    ]
    lines.append(
        "\nA gain that falls is a supply that sags or a motor that warms up; friction that falls "
        "is grease that warms up. No effect of the catalogue changes with time."
    )
    return [Section("What drifts", "\n".join(lines))]


def unseen_section(unseen: Sequence[Unseen]) -> list[Section]:
    """Return which effects the recordings cannot show; nothing if they show all."""
    if not unseen:
        return []
    rows = [
        (words(one.effect), one.target, ", ".join(one.parameters), one.size or "any")
        for one in unseen
    ]
    text = (
        "An effect of these kinds and places would change the signals by less than their noise "
        "hides, up to the size that is given, of the first parameter. That none was found does not "
        "say that there is none: record motions in which it acts."
    )
    table = Table(["effect", "place", "parameters", "hidden"], rows)
    return [Section("What these recordings cannot show", text, tables=[table])]


def warnings_section(warnings: Sequence[str], known: int) -> list[Section]:
    """Return all warnings; nothing if a reader knows so many of them already."""
    lines = "\n".join(f"- {warning}" for warning in warnings)
    return [Section("All warnings", lines)] if len(warnings) > known else []


def next_section(diagnosis: Diagnosis) -> list[Section]:
    """Return which experiment separates what looks alike; nothing if nothing does."""
    experiment = diagnosis.next_experiment
    if experiment is None:
        return []
    names = " and ".join(f"{words(n.effect)} at {n.target}" for n in experiment.separates)
    text = f"These recordings cannot tell {names} apart.\n\n{experiment.how}"
    return [Section("What to record next", text)]


def left_section(diagnosis: Diagnosis) -> list[Section]:
    """Return what the leftover of an unexplained gap goes with; nothing of another verdict."""
    if not diagnosis.is_left:
        return []
    evidence = "\n".join(f"- {line}" for line in diagnosis.left_lines)
    return [Section("What is left", f"{evidence}\n\n{OFFER[0].upper()}{OFFER[1:]}")]


def conditions_section(diagnosis: Diagnosis) -> list[Section]:
    """Return which parameters all conditions share and which are one's own; nothing without any."""
    if not diagnosis.conditions:
        return []
    found = [("all", c) for c in diagnosis.selected]
    found += [(name, c) for name, other in diagnosis.conditions.items() for c in other.selected]
    rows = [
        (name, label(c), parameter, e.estimate, e.low, e.high, e.unit)
        for name, c in found
        for parameter, e in c.parameters.items()
    ]
    columns = ["condition", "effect", "parameter", "estimate", "low", "high", "unit"]
    text = "\n".join(f"- {name}: {d.sentence}" for name, d in diagnosis.conditions.items())
    caption = (
        "Effects of all conditions were found in the base recordings. Where a condition has one of "
        "them again, it acts there in its place. Where the base condition and others are explained "
        "well, sizes were fitted to their recordings together, without those held out."
    )
    return [Section("Under other conditions", text, tables=[Table(columns, rows, caption)])]


def side_by_side_section(comparison: "Comparison") -> list[Section]:
    """Return how several models of the same recordings do; nothing if there is only one."""
    if not comparison.also:
        return []
    models = [(comparison.model, comparison.horizons)]
    models += [(other.model, other.horizons) for other in comparison.also]
    seconds = [h.seconds for h in comparison.horizons]
    errors = [(name, *(100 * h.error for h in horizons)) for name, horizons in models]
    stated = seconds.index(comparison.horizon)
    by_signal = [
        (signal, size["unit"], name, size["rmse"], round(size["fit_percent"], 1))
        for signal in comparison.horizons[0].per_signal
        for name, horizons in models
        for size in [horizons[stated].per_signal[signal]]
    ]
    return [
        Section(
            "Models side by side",
            "Every model predicts the same segments of the same recordings, each from the initial "
            "states that fit it best. A model that was fitted to, or learned from, some of these "
            "recordings has an advantage there: give recordings that it has not seen.",
            figures=[
                Figure(
                    comparison.plot(),
                    "Error against the horizon of the prediction, as a share of the signals' "
                    "spread. Dotted: what noise and the integrator alone would make.",
                )
            ],
            tables=[
                Table(
                    ["model", *(f"{s:g} s" for s in seconds)],
                    errors,
                    "Error in per cent of the signals' spread, by horizon.",
                ),
                Table(
                    ["signal", "unit", "model", "error", "fit [%]"],
                    by_signal,
                    f"Root mean square error of each signal over {comparison.horizon:g} s, in its "
                    "own unit, and fit, 100 (1 - |y - ŷ| / |y - mean y|).",
                ),
            ],
        )
    ]


def _lag(name: str, lag: float) -> str:
    return f"{name}: {1000 * lag + 0.0:.0f} ms" if np.isfinite(lag) else f"{name}: not seen"


def _correlations(residuals: Residuals) -> go.Figure:
    drawn = sorted(residuals.whiteness, key=lambda w: -w.outside)[:MOST_DRAWN]
    figure = go.Figure()
    for whiteness, colour in zip(drawn, COLOURS, strict=False):
        figure.add_scatter(
            x=[1000 * s for s in whiteness.seconds],
            y=list(whiteness.correlation),
            name=whiteness.signal,
            mode="lines+markers",
            line={"color": colour, "width": 1.8},
            marker={"size": 5},
        )
    figure = styled(figure, height=300)
    for bound in sorted({b for w in drawn for b in (w.bound, -w.bound)}):
        figure.add_hline(bound, line={"color": SOFT, "width": 1.5, "dash": "dot"})
    figure.update_xaxes(title_text="lag [ms]", rangemode="tozero")
    return figure.update_yaxes(title_text="correlation", range=[-1.05, 1.05])
