"""What a report says of the effects: how the candidates compare and what was added."""

from collections.abc import Sequence

import numpy as np

from garat_jax.diagnosis import figures
from garat_jax.diagnosis.figures import label, was_fitted, words
from garat_jax.diagnosis.findings import Candidate, Estimate, Named
from garat_jax.diagnosis.model_card import Model
from garat_jax.diagnosis.results import Diagnosis
from garat_jax.diagnosis.units import after_number
from garat_jax.report import Figure, Section, Table


def ranking_section(diagnosis: Diagnosis) -> list[Section]:
    """Return the section that says how the candidates compare; none where none was tried."""
    if not diagnosis.candidates:
        return []
    fitted = [c for c in diagnosis.candidates if was_fitted(c)]
    others = [c for c in diagnosis.candidates if not was_fitted(c)]
    drawn, tables = [], []
    if fitted:
        drawn.append(
            Figure(
                figures.ranking(diagnosis.candidates),
                "By how much the held-out recordings' error falls if this effect alone is fitted, "
                "and its 95 % interval; samples that the timestep makes hard to predict count less."
                " Green: passes every test. Grey: the table says why not. Arrow: beyond the edge.",
                "What each effect would explain",
            )
        )
        tables.append(_table_of_fitted(fitted))
    if others:
        rows = [(label(c), round(100 * c.share), c.why + _alike(c)) for c in others]
        caption = "Share: of the fitted recordings' squared error that it was expected to explain."
        folded = f"{len(others)} effect{'s' * (len(others) != 1)} ruled out before a fit"
        tables.append(Table(["effect", "share [%]", "why not"], rows, caption, folded))
    return [
        Section(
            "Which effects could explain it",
            "Every effect of the catalogue was tried wherever it can act: where a part has a name "
            "and what it needs, as flexibility needs a joint's armature, friction a geom that can "
            "touch another. Only one is added that explains much, lowers the error on recordings "
            "it was not fitted to, leads over all others for certain and has a possible sign.",
            figures=drawn,
            tables=tables,
        )
    ]


def _table_of_fitted(candidates: Sequence[Candidate]) -> Table:
    """Return the table of candidates that were fitted."""
    rows = [
        (
            label(c),
            "; ".join(_estimate(name, e) for name, e in c.parameters.items()),
            round(100 * c.share),
            100 * c.error_after,
            round(100 * c.stability),
            c.why + _alike(c),
        )
        for c in candidates
    ]
    columns = ["effect", "size", "share [%]", "error [%]", "stable [%]", "verdict"]
    return Table(
        columns,
        rows,
        "Share: of the fitted recordings' squared error that it explains. Error: on held-out "
        "recordings once it is fitted. Of what was added, both are those of the round in which it "
        "was, and the size is that of the final fit. Stable: how often it, or one that looks like "
        "it, comes out first when the recordings are resampled.",
    )


def _alike(candidate: Candidate) -> str:
    """Return a clause with the effects that the recordings cannot tell from a candidate."""
    names = [f"{words(n.effect)} at {n.target}" for n in candidate.indistinguishable_from]
    return f"; these recordings cannot tell it from {' or '.join(names)}" if names else ""


def ladder_section(diagnosis: Diagnosis) -> list[Section]:
    """Return the section that shows the error after each step; none where nothing was added."""
    if len(diagnosis.ladder) < 2:
        return []
    text = "Each step adds one effect and fits all of them again to the recordings fitted."
    caption = "The error after each step. Only the blue line, on held-out recordings, is proof."
    return [Section("The error falls", text, figures=[Figure(figures.ladder(diagnosis), caption)])]


def parameters_section(diagnosis: Diagnosis, model: Model) -> list[Section]:
    """Return the section of what was added and its sizes; none where nothing was."""
    if not diagnosis.selected:
        return []
    own = {Named(effect.kind, effect.target): effect for effect in model.effects}
    replaces = any(c.named in own for c in diagnosis.selected)

    def before(c: Candidate, name: str) -> list[float]:
        size = float(getattr(own[c.named], name)) if c.named in own else np.nan
        return [size] if replaces else []

    rows = [
        (label(c), name, e.estimate, e.low, e.high, e.unit, *before(c, name))
        for c in diagnosis.selected
        for name, e in c.parameters.items()
    ]
    kinds = dict.fromkeys(c.effect for c in diagnosis.selected)
    laws = "\n".join(f"- {words(kind)}: {model.catalogue[kind].law}" for kind in kinds)
    columns = ["effect", "parameter", "estimate", "low", "high", "unit"]
    columns += ["in the model as it is"] if replaces else []
    caption = "Estimates and their 95 % intervals; – where the recordings say nothing."
    return [Section("What was added", laws, tables=[Table(columns, rows, caption)])]


def _estimate(name: str, e: Estimate) -> str:
    ends = f" ({e.low:.3g} to {e.high:.3g})" if np.isfinite([e.low, e.high]).all() else ""
    return f"{name} {e.estimate:.3g}{ends}{after_number(e.unit)}"
