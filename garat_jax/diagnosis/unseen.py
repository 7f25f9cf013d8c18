"""Which effects recordings cannot show, because nothing in them would make such an effect act."""

from collections.abc import Collection

import numpy as np

from garat_jax.diagnosis.evidence import Evidence
from garat_jax.diagnosis.findings import Named, Unseen
from garat_jax.diagnosis.problem import Problem
from garat_jax.diagnosis.screen import SCREENED
from garat_jax.diagnosis.segments import QUIET, Segments
from garat_jax.diagnosis.simulate import Simulator
from garat_jax.diagnosis.starts import Fit
from garat_jax.diagnosis.trials import firsts, others

SEEN = 5.0
"""Standard deviations of noise that all an effect changes, at a size that is small but visible
where it acts, must exceed: a test of dozens of candidates needs about four."""
STILL = (
    f"the recordings excite nothing: no signal moves by more than {QUIET:g} times its noise, so "
    "that a model may agree with them whatever it lacks"
)
"""What is said of recordings in which nothing moves."""


def is_still(segments: Segments) -> bool:
    """Say whether no signal moves by more than noise could hide."""
    return not np.any(segments.spread > QUIET * segments.noise)


def unseen(
    problem: Problem[Simulator], current: Fit, seen: Collection[Named] = ()
) -> tuple[Unseen, ...]:
    """List the candidates that would change the signals by less than noise hides.

    Each is tried at its usual sizes (`Effect.starts`), and with each of its parameters if they act
    alone; initial states are projected out, as where candidates are scored.

    Args:
        problem: The recordings and the model with every candidate.
        current: A fit.
        seen: Those of which the recordings show a larger size.
    """
    simulator, theta = problem.simulator, current.theta
    fitted = np.flatnonzero(problem.fitted)
    chosen = fitted[:: max(1, len(fitted) // SCREENED)]
    rows, trials = firsts(problem, theta, ())
    alone = [t for t in trials if t.is_only and simulator.effects[t.effect].independent]
    rows, alone = others(simulator, theta, rows, alone)
    thetas = np.tile(theta, (len(rows), 1))
    for moved, row in zip(thetas, rows, strict=True):
        moved[list(row.values)] = list(row.values.values())
    change = Evidence(problem, current, chosen).change(thetas)
    size = np.linalg.norm(change, axis=0) * np.sqrt(len(fitted) / len(chosen))
    shown = {t.effect for t in (*trials, *alone) if size[list(t.rows)].max() > SEEN}
    hidden = dict.fromkeys(t.effect for t in trials if t.effect not in shown)
    effects = [simulator.effects[index] for index in hidden]
    return tuple(
        Unseen(e.kind, e.target, tuple(p.name for p in e.parameters()))
        for e in effects
        if Named(e.kind, e.target) not in seen
    )
