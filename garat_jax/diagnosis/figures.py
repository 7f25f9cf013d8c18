"""The figures of a diagnosis and of a comparison, from typed results and arrays."""

from collections.abc import Sequence

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from garat_jax.diagnosis.findings import Candidate, Named
from garat_jax.diagnosis.localise import MissingTorque, Place
from garat_jax.diagnosis.measurements import Recording
from garat_jax.diagnosis.replay import Replay
from garat_jax.diagnosis.results import Diagnosis
from garat_jax.report import COLOURS, SOFT, styled

AFTER, BEFORE, GOOD = COLOURS[0], COLOURS[1], COLOURS[2]
MEASURED, FAINT = "#1c2430", "#aab3bd"
MOST_POINTS = 1500
"""Points drawn of one line or cloud: enough to see, small enough for a phone."""
BINS = 24
"""Bins of a binned mean."""
ERROR = "error [% of the spread]"
LINE_HEIGHT = 34
"""Pixels of one bar in a figure of bars."""


def words(kind: str) -> str:
    """Return an effect's name as words."""
    return kind.replace("_", " ")


def label(candidate: Candidate | Named) -> str:
    """Return an effect and its place as words."""
    return f"{words(candidate.effect)} at {candidate.target}"


def was_fitted(candidate: Candidate) -> bool:
    """Say whether a candidate was fitted, not ruled out before."""
    return bool(np.isfinite(candidate.error_after))


def errors_by_horizon(before: Sequence[Replay], after: Sequence[Replay], floor: float) -> go.Figure:
    """Draw the error against the horizon, before and after the repair, and the noise floor."""
    lines = [
        (name, colour, [(p.horizon, p.error()) for p in played])
        for played, name, colour in ((before, "model as it is", BEFORE), (after, "repaired", AFTER))
        if played
    ]
    return errors_against_horizon(lines, floor)


def errors_against_horizon(
    lines: Sequence[tuple[str, str, Sequence[tuple[float, float]]]], floor: float
) -> go.Figure:
    """Draw errors against the horizon, and the noise floor.

    Args:
        lines: Name, colour, and (seconds, error) of each line.
        floor: The noise floor.
    """
    figure = go.Figure()
    for name, colour, points in lines:
        figure.add_scatter(
            x=[seconds for seconds, _ in points],
            y=[100 * error for _, error in points],
            name=name,
            mode="lines+markers",
            line={"color": colour, "width": 2.5},
            marker={"size": 8},
            hovertemplate="%{x} s: %{y:.3g} %",
        )
    figure = styled(figure, height=300)
    _floor(figure, floor)
    figure.update_xaxes(title_text="horizon of the prediction [s]", rangemode="tozero")
    return figure.update_yaxes(title_text=ERROR, rangemode="tozero")


def traces(
    recording: Recording,
    index: int,
    signal: int,
    before: Replay,
    after: Replay | None,
    worst: Sequence[int],
) -> go.Figure:
    """Draw one signal of one recording, measured and simulated, and the deviation below.

    Args:
        recording: What was measured.
        index: The recording's number among those replayed.
        signal: The signal's number.
        before: Predictions of the model as it is.
        after: Predictions of the repaired model, if there is one.
        worst: Segments to shade.
    """
    figure = make_subplots(2, 1, shared_xaxes=True, row_heights=[0.6, 0.4], vertical_spacing=0.06)
    state = np.concatenate([recording.qpos, recording.qvel], axis=1)
    step = max(1, len(recording.time) // MOST_POINTS)
    figure.add_scatter(
        x=recording.time[::step],
        y=state[::step, signal],
        name="measured",
        mode="markers",
        marker={"color": MEASURED, "size": 3.5},
        row=1,
        col=1,
    )
    shown = [(before, "model as it is", BEFORE)]
    shown += [(after, "repaired model", AFTER)] if after else []
    for played, name, colour in shown:
        time, predicted, deviation = _path(played, recording, index, signal)
        look = {"name": name, "legendgroup": name, "line": {"color": colour, "width": 1.8}}
        figure.add_scatter(x=time, y=predicted, mode="lines", **look, row=1, col=1)
        figure.add_scatter(
            x=time, y=deviation, mode="lines", showlegend=False, **look, row=2, col=1
        )
    for s in worst:
        if before.segments.recording[s] == index:
            first, count = before.segments.first[s], int(before.segments.weight[s].sum())
            ends = recording.time[first], recording.time[first + count - 1]
            figure.add_vrect(*ends, fillcolor=BEFORE, opacity=0.12, line_width=0)
    figure = styled(figure, height=460)
    unit = before.units[signal]
    figure.update_xaxes(title_text="time [s]", row=2, col=1)
    figure.update_yaxes(title_text=f"{before.names[signal]} [{unit}]", row=1, col=1)
    return figure.update_yaxes(title_text=f"deviation [{unit}]", row=2, col=1)


def where_it_fails(places: Sequence[Place]) -> go.Figure:
    """Draw the share of the missing torque by joint and regime."""
    shown = list(places)[:10][::-1]
    figure = go.Figure(
        go.Bar(
            x=[100 * place.share for place in shown],
            y=[f"{place.signal}: {place.regime}" for place in shown],
            orientation="h",
            marker={"color": BEFORE},
            text=[f"{100 * place.share:.0f} %" for place in shown],
            textposition="auto",
            hoverinfo="skip",
        )
    )
    figure = styled(figure, height=130 + LINE_HEIGHT * len(shown), bargap=0.35)
    return figure.update_xaxes(
        title_text="share of the missing torque that goes with it [%]", range=[0, 105]
    )


def missing_torques(
    measured: MissingTorque, explained: MissingTorque | None, dof: int, unit: str
) -> go.Figure:
    """Draw one joint's missing torque against velocity, position, command and its change.

    Args:
        measured: From the measurements.
        explained: From the repaired model's predictions, as if they had been measured.
        dof: The joint's degree of freedom.
        unit: `rad` or `m`.
    """
    force = "N m" if unit == "rad" else "N"
    axes = [("velocity", f"velocity [{unit}/s]"), ("position", f"position [{unit}]")]
    if np.ptp(measured.command[:, dof]) > 0:
        axes.append(("command", f"torque commanded [{force}]"))
        axes.append(("change", f"change of the torque commanded [{force} a sample]"))
    figure = make_subplots(len(axes), 1, vertical_spacing=0.28 / len(axes))
    step = max(1, len(measured.time) // MOST_POINTS)
    for row, (field, title) in enumerate(axes, start=1):
        x, y = _abscissa(measured, field, dof, unit), measured.torque[:, dof]
        figure.add_scatter(
            x=x[::step],
            y=y[::step],
            name="measured",
            mode="markers",
            marker={"color": FAINT, "size": 3, "opacity": 0.6},
            showlegend=row == 1,
            hoverinfo="skip",
            row=row,
            col=1,
        )
        edges = np.unique(np.quantile(x, np.linspace(0, 1, BINS + 1)))
        means = {"measured, mean": (x, y, MEASURED, "markers")}
        if explained is not None:
            of_law = _abscissa(explained, field, dof, unit), explained.torque[:, dof]
            means["law found, mean"] = (*of_law, AFTER, "lines")
        for name, (at, torque, colour, mode) in means.items():
            centre, mean = _binned(at, torque, edges)
            figure.add_scatter(
                x=centre,
                y=mean,
                name=name,
                mode=mode,
                marker={"color": colour, "size": 7},
                line={"color": colour, "width": 3},
                showlegend=row == 1,
                row=row,
                col=1,
            )
        across, up = _without_far(x, 0.002, 0.05), _without_far(y, 0.005, 0.15)
        figure.update_xaxes(title_text=title, range=across, row=row, col=1)
        figure.update_yaxes(range=up, row=row, col=1)
    figure = styled(figure, height=260 * len(axes))
    return figure.update_yaxes(title_text=f"missing [{force}]", title_font_size=12)


def ranking(candidates: Sequence[Candidate]) -> go.Figure:
    """Draw by how much each fitted candidate makes the held-out error fall, with its interval.

    What makes it rise by more than any makes it fall stands at the edge, as an arrow.
    """
    shown = [c for c in candidates if was_fitted(c)][::-1]
    gains = [c.held_out_gain for c in shown]
    falls = [100 * g.high for g in gains if g.estimate > 0]
    rises = [-100 * g.low for g in gains] or [0.0]
    most = max(falls, default=float(np.median(rises)))
    beyond = [100 * g.estimate < -most for g in gains]
    at = [max(100 * g.estimate, -most) for g in gains]
    colours = [GOOD if c.passes else FAINT for c in shown]
    figure = go.Figure(
        go.Scatter(
            x=at,
            y=[label(c) for c in shown],
            mode="markers",
            marker={
                "color": colours,
                "size": 11,
                "symbol": ["triangle-left" if b else "circle" for b in beyond],
            },
            customdata=[[100 * g.estimate, 100 * g.low, 100 * g.high] for g in gains],
            hovertemplate="%{customdata[0]:.3g} [%{customdata[1]:.3g}, %{customdata[2]:.3g}]"
            "<extra></extra>",
        )
    )
    for candidate, gain, colour in zip(shown, gains, colours, strict=True):
        figure.add_scatter(
            x=[float(np.clip(100 * end, -most, most)) for end in (gain.low, gain.high)],
            y=[label(candidate)] * 2,
            mode="lines",
            line={"color": colour, "width": 3},
            hoverinfo="skip",
        )
    figure = styled(figure, height=130 + LINE_HEIGHT * len(shown), showlegend=False)
    figure.add_vline(0, line={"color": SOFT, "width": 1})
    lowest = min([0.0, *(max(100 * g.low, -most) for g in gains)])
    margin = 0.05 * (most - lowest)
    figure.update_xaxes(range=[lowest - margin, most + margin])
    return figure.update_xaxes(title_text="fall of the held-out error [% of the spread]")


def ladder(diagnosis: Diagnosis) -> go.Figure:
    """Draw the error falling as effects are added."""
    names = [
        f"+ {diagnosis.spelled(r.added.named, label)}" if r.added else "model as it is"
        for r in diagnosis.ladder
    ]
    figure = go.Figure()
    for name, errors, colour in (
        ("recordings fitted", [100 * r.error_fit for r in diagnosis.ladder], FAINT),
        ("recordings held out", [100 * r.error_holdout for r in diagnosis.ladder], AFTER),
    ):
        figure.add_scatter(
            x=names,
            y=errors,
            name=name,
            mode="lines+markers",
            line={"color": colour, "width": 2.5},
            marker={"size": 9},
            hovertemplate="%{y:.3g} %",
        )
    figure = styled(figure, height=320)
    _floor(figure, diagnosis.error.noise_floor)
    return figure.update_yaxes(title_text=ERROR, rangemode="tozero")


def _floor(figure: go.Figure, floor: float) -> None:
    figure.add_hline(
        100 * floor,
        line={"color": SOFT, "width": 1.5, "dash": "dot"},
        annotation={"text": "noise floor", "font": {"color": SOFT, "size": 12}},
        annotation_position="top left",
    )


def _path(played: Replay, recording: Recording, index: int, signal: int):
    """Return time, prediction and deviation of one recording, with breaks between segments."""
    parts = []
    for s in np.flatnonzero(played.segments.recording == index):
        first, count = int(played.segments.first[s]), int(played.segments.weight[s].sum())
        step = max(1, count * len(played.segments.first) // (4 * MOST_POINTS))
        columns = (
            recording.time[first : first + count],
            played.predicted[s, :count, signal],
            played.deviation[s, :count, signal],
        )
        parts.append([np.append(column[::step], np.nan) for column in columns])
    return tuple(np.concatenate(columns) for columns in zip(*parts, strict=True))


def _abscissa(missing: MissingTorque, field: str, dof: int, unit: str) -> np.ndarray:
    """Return a column of the missing torque; angles are taken within one turn."""
    if field == "change":
        return np.gradient(missing.command[:, dof])
    values = getattr(missing, field)[:, dof]
    if field == "position" and unit == "rad" and np.ptp(values) > 2 * np.pi:
        return (values + np.pi) % (2 * np.pi) - np.pi
    return values


def _without_far(values: np.ndarray, share: float, margin: float) -> list[float]:
    """Return an axis without this share of the values at either end, with a margin around."""
    low, high = np.quantile(values, [share, 1 - share])
    wider = margin * (high - low)
    return [float(low - wider), float(high + wider)]


def _binned(x: np.ndarray, y: np.ndarray, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean of x and y in each bin that holds a few samples."""
    if len(edges) < 2:  # x is constant
        return np.zeros(0), np.zeros(0)
    index = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, len(edges) - 2)
    counts = np.bincount(index, minlength=len(edges) - 1)
    full = counts > 4
    sums = (np.bincount(index, column, minlength=len(edges) - 1)[full] for column in (x, y))
    centre, mean = (column / counts[full] for column in sums)
    return centre, mean
