"""Score a diagnosis against what was hidden, and add the scores up beside what they are held to."""

import dataclasses
import itertools
import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from scipy import stats

from garat_jax.diagnosis import Diagnosis, Model, Recording
from garat_jax.diagnosis.diagnose import split, thin
from garat_jax.diagnosis.findings import Candidate, Named
from garat_jax.diagnosis.metric import make_metric
from garat_jax.diagnosis.problem import Problem
from garat_jax.diagnosis.segments import choose_grid, cut
from garat_jax.diagnosis.simulate import Simulator
from garat_jax.diagnosis.starts import settle
from garat_jax.dynamics import native_model
from garat_jax.effects import CATALOGUE

from .generate import TIMINGS, Truth
from .secrets import Secret

DELAY = "actuator_delay"
"""The kind that a nuisance delay may be named as."""
CLOSE = 0.05
HELD_CLOSE = {
    ("viscous_damping", "coefficient"),
    ("coulomb_friction", "torque"),
    ("motor_gain", "scale"),
    ("payload_mass", "mass"),
    ("actuator_delay", "delay"),
    ("sensor_delay", "delay"),
}
"""Parameters that have to come within `CLOSE`: friction, gain, mass, delay."""
PERIODIC = "cogging_torque.phase"
"""An angle: whole turns more mean the same."""
LARGEST_RATIO = 1.25
"""Held-out error after adding, over that of the true model at the nominal timestep."""


def place(model: mujoco.MjModel, target: str) -> str:
    """Return the body where a target is: a joint's, an actuator's joint's, a geom's."""
    element, _, name = target.partition("/")
    if element == "actuator":
        return model.body(model.joint(int(model.actuator(name).trnid[0])).bodyid[0]).name
    if element == "joint":
        return model.body(model.joint(name).bodyid[0]).name
    if element == "geom":
        return model.body(model.geom(name).bodyid[0]).name
    if element == "all" and model.nu == 1:
        return place(model, f"actuator/{model.actuator(0).name}")
    return name or element


def names(candidate: Candidate) -> tuple[Named, ...]:
    """Return a candidate and what the recordings cannot tell from it."""
    return (candidate.named, *candidate.indistinguishable_from)


def names_kind(candidate: Candidate, secret: Secret) -> bool:
    """Say whether a candidate, or its equivalence set, names a secret's kind."""
    return any(named.effect == secret.kind for named in names(candidate))


def names_place(candidate: Candidate, secret: Secret, model: mujoco.MjModel) -> bool:
    """Say whether it names the secret's place, with the right kind or as its own first place."""
    at = place(model, secret.target)
    same = [n for n in names(candidate) if n.effect == secret.kind]
    return any(place(model, n.target) == at for n in (candidate.named, *same))


def finds(candidate: Candidate, secret: Secret, model: mujoco.MjModel) -> bool:
    """Say whether it, or its equivalence set, names kind and place together."""
    at = place(model, secret.target)
    return any(n.effect == secret.kind and place(model, n.target) == at for n in names(candidate))


def score(found: Diagnosis, truth: Truth, model: mujoco.MjModel) -> dict[str, Any]:
    """Return what of a set's truth was found.

    Where all commands were late as a nuisance, naming a delay, or what recordings cannot tell from
    it, is right and is left out here.
    """

    def is_nuisance(candidate: Candidate) -> bool:
        is_timing = truth.delay > 0 and candidate.effect in TIMINGS
        return is_timing and any(named.effect == DELAY for named in names(candidate))

    selected = [c for c in found.selected if not is_nuisance(c)]
    ranked = [*selected, *(c for c in found.candidates if not is_nuisance(c))]
    first = ranked[0] if ranked else None
    row: dict[str, Any] = {
        "verdict": found.verdict,
        "claimed": [[str(n) for n in names(c)] for c in found.selected],
        "first": [str(n) for n in names(first)] if first else [],
        "first_fails": "" if first is None or first.passes else first.why,
        "unexplained_share": found.gap.unexplained_share,
        "seconds": found.seconds,
    }
    category = truth.case.category
    if category == "clean":
        return row | {"ok": not selected}
    if category == "outside":
        return row | {"ok": found.verdict == "unexplained"}
    estimates = [
        estimate
        for secret in truth.secrets
        for candidate in selected
        if finds(candidate, secret, model) and candidate.effect == secret.kind
        for estimate in _estimates(candidate, secret)
    ]
    row["estimates"] = estimates
    if category == "pair":
        finders = [[i for i, c in enumerate(selected) if finds(c, s, model)] for s in truth.secrets]
        each = any(len({*chosen}) == len(chosen) for chosen in itertools.product(*finders))
        return row | {"found": [bool(some) for some in finders], "ok": each}
    secret = truth.secrets[0]
    kind = first is not None and names_kind(first, secret)
    at = first is not None and names_place(first, secret, model)
    return row | {
        "kind_first": kind,
        "kind_claimed": bool(selected) and kind,
        "alone": first is not None and len(names(first)) == 1,
        "place_right": at,
        "ok": kind and at,
    }


def _estimates(candidate: Candidate, secret: Secret) -> list[dict[str, Any]]:
    return [
        {
            "parameter": f"{secret.kind}.{name}",
            "true": secret[name],
            "estimate": value.estimate,
            "low": value.low,
            "high": value.high,
            "held_close": (secret.kind, name) in HELD_CLOSE,
        }
        for name, value in candidate.parameters.items()
        if name in secret.parameters and np.isfinite(value.low)
    ]


def judge(estimate: Mapping[str, Any]) -> dict[str, Any]:
    """Return an estimate with its relative error and whether its interval covers the truth."""
    true, found = estimate["true"], estimate["estimate"]
    if estimate["parameter"] == PERIODIC:
        true = found + math.remainder(true - found, 2 * math.pi)
    error = abs(found - true) / max(abs(true), 1e-12)
    covered = estimate["low"] <= true <= estimate["high"]
    return {**estimate, "relative_error": error, "covered": covered, "close": error <= CLOSE}


def true_error(
    model: Model,
    recordings: Sequence[Recording],
    holdout: Sequence[Recording],
    found: Diagnosis,
    truth: Truth,
) -> float | None:
    """Return the held-out error of the catalogue's effects at their true parameters.

    Metric, segments and timestep are those of the diagnosis. Initial states are settled from what
    was measured; those of the diagnosis from where its fits have led, too.
    None where the catalogue has no such effect: outside it, and with a nuisance delay unless the
    catalogue has delays.
    """
    effects = _true_effects(truth)
    stated = re.search(r"segments of ([\d.e-]+) s", found.error.metric)
    if effects is None or stated is None:
        return None
    fitted, held_out, _ = split(recordings, holdout)
    everything = thin((*fitted, *held_out))
    true = dataclasses.replace(model, effects=(*model.effects, *effects))
    grid = choose_grid(everything, native_model(true.compile(engine="mujoco")).opt.timestep)
    segments = cut(everything, grid, float(stated[1]))
    problem = Problem(
        Simulator(true, (), grid),
        segments,
        segments.recording < len(fitted),
        grid.sample,
    )
    settled = settle(problem, problem.simulator.base, segments.start)
    return make_metric(problem).error(settled.residual, ~problem.fitted)


def _true_effects(truth: Truth) -> list | None:
    wanted = [(s.kind, s.target, s.parameters) for s in truth.secrets]
    if truth.delay > 0:
        wanted.append((DELAY, "all", {"delay": truth.delay}))
    if not wanted or any(kind not in CATALOGUE for kind, _, _ in wanted):
        return None
    return [CATALOGUE[kind](target=at, **parameters) for kind, at, parameters in wanted]


NOT_YET = "not in the catalogue yet"


def aggregate(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Add rows up: each measure beside its target, and the cases that fall short.

    Sets whose kind the catalogue lacks are failures of no one and successes of no one: they have a
    line of their own.
    """
    done = [row for row in rows if row["status"] != NOT_YET]
    of = {name: [r for r in done if r["category"] == name] for name in CATEGORIES}
    singles = of["single"]
    known = ("adequate", "missing_effect")  # late commands may be found, which are no secret
    clean = [{**row, "explained": row.get("verdict") in known} for row in of["clean"]]
    lines = [
        _share("right kind first", singles, "kind_first", 0.95),
        _share("right kind first and past every gate", singles, "kind_claimed", None),
        _share("of these without an equivalent", [r for r in singles if r.get("kind_first")],
               "alone", None),
        _share("right joint or body", singles, "place_right", 0.95),
        _share("pairs, both found", of["pair"], "ok", 0.85),
        _share("clean, nothing claimed", clean, "ok", 0.95),
        _share("clean, not called unexplained", clean, "explained", None),
        _share("outside, unexplained", of["outside"], "ok", 0.90),
    ]  # fmt: skip
    estimates = [judge(e) | {"case": r["case"]} for r in done for e in r.get("estimates", [])]
    close = [e for e in estimates if e["held_close"]]
    lines += [
        _share("estimates of friction, gain, mass, delay within 5 %", close, "close", 0.95),
        _share("all estimates within 5 %", estimates, "close", None),
        _share("intervals that cover", estimates, "covered", 0.90, 0.98),
    ]
    compared = [{**r, "near": r["ratio"] <= LARGEST_RATIO} for r in done if r.get("ratio")]
    lines.append(_share("error after adding at most 1.25 × the true model's", compared, "near", 1))
    seconds = [r["seconds"] for r in done if "seconds" in r]
    if seconds:
        median, most = float(np.median(seconds)), float(np.max(seconds))
        lines.append({"measure": "seconds a set", "value": median, "largest": most})
    missing = sorted(r["case"] for r in rows if r["status"] == NOT_YET)
    lines.append({"measure": NOT_YET, "count": len(missing), "cases": missing})
    return lines


CATEGORIES = ("single", "pair", "clean", "outside")


def _share(measure: str, rows, key: str, low: float | None, high: float = 1.0) -> dict[str, Any]:
    """Return the share of rows that have it, with a 95 % interval in which sets are independent.

    Rows that failed with an error do not have it.
    """
    count = len(rows)
    value = sum(bool(row.get(key)) for row in rows) / count if count else None
    line: dict[str, Any] = {"measure": measure, "value": value, "count": count}
    if value is not None:
        line["interval"] = _wilson(value, len({row["case"] for row in rows}))
    if low is not None and value is not None:
        line |= {"target": [low, high], "met": low <= value <= high}
        line["short"] = sorted({row["case"] for row in rows if not row.get(key)})
    return line


def _wilson(share: float, count: int) -> list[float]:
    """Return the 95 % interval of a share of independent cases (Wilson 1927)."""
    z = float(stats.norm.ppf(0.975))
    middle = (share + z**2 / (2 * count)) / (1 + z**2 / count)
    half = z * np.sqrt(share * (1 - share) / count + (z / (2 * count)) ** 2) / (1 + z**2 / count)
    return [max(0.0, float(middle - half)), min(1.0, float(middle + half))]
