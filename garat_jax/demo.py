"""The tour: ground a simulator with GARAT, then find a hidden effect, and a real one."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from garat_jax import report, summary
from garat_jax.diagnosis import run_diagnose
from garat_jax.diagnosis.convert import free_pendulum
from garat_jax.diagnosis.hidden import Hidden, make_recordings
from garat_jax.diagnosis.report import diagnosis_lead
from garat_jax.diagnosis.results import Diagnosis
from garat_jax.envs.pairs import PAIRS
from garat_jax.presets import garat
from garat_jax.report import Fact, Section
from garat_jax.runs import RunDirectory
from garat_jax.terminal import say
from garat_jax.transfer import run_transfer

PAIR = "inverted_pendulum_heavy"
SEEDS = 5
RETRAINING = 10
"""Iterations, a sixth of the preset's; policies solve the grounded source in the first five."""
REAL = 2
"""Real recordings that are fitted, half of what there is; the other half adds time, not insight."""
PENDULUM = Path(__file__).parent / "envs" / "assets" / "pendulum.xml"


def run_demo(run: RunDirectory, seed: int, measurements: Path | None) -> None:
    """Take the tour; a resumed one goes on within the transfer and diagnoses anew.

    Args:
        run: Where the results go: `transfer/`, `diagnosis/`, `real/` and `report.html`.
        seed: Draws everything: the seeds of the transfer, the hidden effect, the noise.
        measurements: Folder with recordings of a free pendulum, for the third stop.

    Raises:
        UserError: The folder holds no such recordings.
    """
    console = Console(stderr=True)
    real = free_pendulum(measurements, run.path("real_measurements")) if measurements else None
    console.rule("1. Transfer: ground the source in the target's data")
    config = garat(PAIRS[PAIR], seeds=SEEDS)
    config = dataclasses.replace(config, first_seed=seed, num_retraining=RETRAINING)
    seeds = range(seed, seed + SEEDS)
    part = _part(run, "transfer", {"pair": PAIR}, seeds, resume=run.resumed)
    transfer = run_transfer(config, part)
    say(summary.describe(transfer))

    console.rule("2. A hidden effect: which physics does the model lack?")
    hidden = make_recordings(PENDULUM, run.path("measurements"), seed)
    part = _part(run, "diagnosis", {"model": PENDULUM}, [seed], force=run.resumed)
    found, pages = run_diagnose(PENDULUM, hidden.fit, hidden.holdout, part)
    truth = _truth(found, hidden)
    say(truth.text)
    sections = [
        *_titled("Transfer", summary.sections(transfer, PAIRS[PAIR].summary)),
        *_titled("Hidden effect", [truth, *pages]),
    ]
    if real is not None:
        console.rule("3. Real measurements: a pendulum that swings freely")
        part = _part(run, "real", {"model": real.model}, [], force=run.resumed)
        pages = run_diagnose(real.model, real.fit[:REAL], real.holdout, part).sections
        sections += _titled("Real pendulum", pages)
    report.write(
        run.path("report.html"),
        title="What garat does with a simulator that is wrong",
        lead=f"{summary.lead(transfer)} {diagnosis_lead(found)}",
        facts=_facts(transfer, found),
        sections=sections,
        reproduce=report.Reproduce.from_config(run.read_json("config.json")),
        kind="The tour",
    )


def _part(
    run: RunDirectory, name: str, config: Mapping[str, Any], seeds: Sequence[int], **again: bool
) -> RunDirectory:
    """Make the folder of one stop, whose `again` says what becomes of an earlier one."""
    command = run.read_json("config.json")["command"]
    return RunDirectory.create(run.path(name), config, command, seeds, **again)


def _titled(title: str, sections: Sequence[Section]) -> list[Section]:
    return [dataclasses.replace(s, heading=f"{title}: {s.heading}") for s in sections]


def _truth(found: Diagnosis, hidden: Hidden) -> Section:
    """Say what was hidden, and whether it was found."""
    sizes = ", ".join(f"{name} {value:.4g}" for name, value in hidden.parameters.items())
    named = [(c.effect, c.target) for c in found.selected]
    verdict = "found it" if named == [(hidden.kind, hidden.target)] else "did not find just that"
    return Section(
        "What was hidden",
        f"The recordings came from C MuJoCo at a 32 times finer timestep, with sensor noise and "
        f"{hidden.kind} at {hidden.target} ({sizes}). The diagnosis, which saw the recordings "
        f"alone, {verdict}.",
    )


def _facts(transfer: Mapping[str, Any], found: Diagnosis) -> list[Fact]:
    method, more, *_ = summary.facts(transfer)
    before, after, floor = (
        f"{100 * error:.2g} %"
        for error in (found.error.before, found.error.after, found.error.noise_floor)
    )
    return [method, more, Fact(f"{before} → {after}", f"held-out error; noise makes {floor}")]
