"""Recordings of one rig under several conditions: with and without a payload, cold and warm.

What is found in the recordings of the base condition is shared: the model has it when those of
every other condition are diagnosed. What is found there is that condition's own; it may be a shared
effect of another size. At the end all parameters are fitted to all recordings.
"""

import dataclasses
import functools
import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

from garat_jax.diagnosis.compare import read_recordings
from garat_jax.diagnosis.diagnose import diagnose, split, thin
from garat_jax.diagnosis.findings import Candidate
from garat_jax.diagnosis.fit import fit
from garat_jax.diagnosis.guesses import with_guesses
from garat_jax.diagnosis.horizon import choose_horizon, cut_longer
from garat_jax.diagnosis.judge import estimates
from garat_jax.diagnosis.measurements import Recording, checked
from garat_jax.diagnosis.metric import UNEXPLAINED
from garat_jax.diagnosis.model_card import Model, check_model, save_card
from garat_jax.diagnosis.problem import Problem
from garat_jax.diagnosis.results import Diagnosis
from garat_jax.diagnosis.segments import Segments, grid_for
from garat_jax.diagnosis.simulate import Simulator
from garat_jax.diagnosis.slots import Slot
from garat_jax.diagnosis.starts import as_measured
from garat_jax.diagnosis.timestep import count_timestep
from garat_jax.diagnosis.view import as_effects, repaired
from garat_jax.dynamics import native_model
from garat_jax.effects import Effect
from garat_jax.errors import UserError
from garat_jax.runs import RunDirectory


def diagnose_conditions(
    model: Model,
    recordings: Sequence[Recording],
    conditions: Mapping[str, Sequence[Recording]],
    holdout: Sequence[Recording] = (),
    say: Callable[[str], None] = lambda message: None,
) -> Diagnosis:
    """Find what a model lacks, and what changes from the base condition to others.

    Args:
        model: The model under diagnosis.
        recordings: What was measured in the base condition.
        conditions: What was measured in each of the others, by its name.
        holdout: Recordings of the base condition to prove the shared effects on.
        say: Told what is being done.

    Returns:
        The diagnosis of the base condition, with that of each other one in `conditions`: there the
        model has the shared effects, and a selected one of the same kind and place replaces one.
        The selected effects' parameters are those that fit the recordings of all conditions
        together, save those in which much of the error stays unexplained; errors and candidates are
        of each condition by itself.

    Raises:
        UserError: The recordings of a condition are too short to be diagnosed.
    """
    check_conditions(model, conditions)
    base = diagnose(model, recordings, holdout, say)
    return add_conditions(model, base, recordings, conditions, holdout, say)


def add_conditions(
    model: Model,
    base: Diagnosis,
    recordings: Sequence[Recording],
    conditions: Mapping[str, Sequence[Recording]],
    holdout: Sequence[Recording] = (),
    say: Callable[[str], None] = lambda message: None,
) -> Diagnosis:
    """Find what changes from the base condition, whose diagnosis is given, to others.

    Args and result are those of `diagnose_conditions`.
    """
    shared = as_effects(model, base.selected)
    found = {}
    for name, measured in conditions.items():
        say(f"the condition {name}")
        found[name] = diagnose(model, measured, say=say, shared=shared)
    clear = [name for name, other in found.items() if _is_clear(other)]
    together = (base, *(found[name] for name in clear))
    if clear and _is_clear(base) and any(d.selected for d in together):
        say("fitting all conditions together")
        fitted = [split(recordings, holdout)[0], *(split(conditions[n], ())[0] for n in clear)]
        base, *others = _fit_together(model, fitted, together)
        found |= dict(zip(clear, others, strict=True))
    return dataclasses.replace(base, conditions=found)


def read_all(
    model: Model,
    data: Sequence[Path],
    holdout: Sequence[Path],
    conditions: Mapping[str, Sequence[Path]] | None,
    columns: Path | None = None,
) -> tuple[list[Recording], list[Recording], dict[str, list[Recording]]]:
    """Read recordings, those held out and those of each condition; see `read_recordings`."""
    others = conditions or {}
    everything = [*data, *holdout, *itertools.chain.from_iterable(others.values())]
    read = functools.partial(read_recordings, model, columns=columns, among=everything)
    return read(data), read(holdout), {name: read(paths) for name, paths in others.items()}


def check_conditions(model: Model, conditions: Mapping[str, Sequence[Recording]]) -> None:
    """Refuse recordings that cannot be diagnosed, before the base condition takes its time.

    Raises:
        UserError: A condition has none, or too short ones, or samples too far apart, or the model
            is none.
    """
    check_model(model)
    for name, measured in conditions.items():
        try:
            fitted, held_out, _ = split(checked(measured), ())
            grid_for(thin((*fitted, *held_out)), native_model(model.compile(engine="mujoco")))
        except UserError as error:
            raise UserError(f"under the condition {name}: {error}") from error


def write_cards(run: RunDirectory, model: Model, found: Diagnosis) -> None:
    """Write what was found as model.toml, and model-CONDITION.toml for each other condition.

    Args:
        run: Where to write.
        model: The model that was diagnosed, its MJCF in the run's folder.
        found: Its diagnosis.
    """
    save_card(run.path("model.toml"), repaired(model, found.selected))
    for name in found.conditions:
        save_card(run.path(f"model-{name}.toml"), repaired(model, found.under(name)))


def _is_clear(found: Diagnosis) -> bool:
    """Say whether so little of the error stays, in what is fitted, that it cannot mislead a fit."""
    error = found.error
    return error.unexplained_share <= UNEXPLAINED if found.selected else error.is_adequate


class _Place(NamedTuple):
    """What one parameter of all conditions together stands for.

    Attributes:
        column: The parameter in one condition's `theta`.
        condition: The condition that it belongs to; 0 for all that have no own value.
    """

    column: int
    condition: int


class JointSimulator:
    """One simulator for the segments of several conditions, with shared and own parameters.

    It stands for a `Simulator` where parameters are fitted.

    Attributes:
        effects: The effects shared by all, then each condition's own.
        slots: Their parameters, in the order of `theta`.
        base: Values to begin with, [num_parameters].
    """

    def __init__(
        self, simulator: Simulator, selected: Sequence[Sequence[Effect]], condition: np.ndarray
    ):
        """Lay the parameters out.

        Args:
            simulator: Simulates one condition; it holds every kind and place that was selected.
            selected: The effects of each condition, the shared ones first.
            condition: Which condition each recording was made in.
        """
        self._simulator, self._selected, self._condition = simulator, selected, condition
        self.effects = tuple(effect for own in selected for effect in own)
        index = {(e.kind, e.target): i for i, e in enumerate(simulator.effects)}
        owners = [number for number, own in enumerate(selected) for _ in own]
        slots, places = [], []
        for number, (owner, effect) in enumerate(zip(owners, self.effects, strict=True)):
            for column, slot in enumerate(simulator.slots):
                if slot.effect == index[effect.kind, effect.target]:
                    value = float(getattr(effect, slot.parameter.name))
                    slots.append(Slot(number, slot.parameter, value))
                    places.append(_Place(column, owner))
        self.slots, self._places = tuple(slots), tuple(places)
        self.base = np.asarray([slot.base for slot in slots])

    @property
    def host(self) -> mujoco.MjModel:
        """The compiled MuJoCo model."""
        return self._simulator.host

    def refined(self, factor: int) -> "JointSimulator":
        """Return the same with `factor` physics substeps in place of each."""
        finer = self._simulator.refined(factor)
        return JointSimulator(finer, self._selected, self._condition)

    def predict(self, theta: np.ndarray, start: np.ndarray, segments: Segments) -> np.ndarray:
        """Predict every segment's signals under its own condition; see `Simulator.predict`."""
        result = np.empty((len(theta), *segments.measured.shape))
        conditions = self._condition[segments.recording]
        for number in np.unique(conditions):
            here = conditions == number
            own = theta[:, here] if theta.ndim > 2 else theta
            there = self._under(own, int(number))
            result[:, here] = self._simulator.predict(there, start[:, here], segments.take(here))
        return result

    def _under(self, theta: np.ndarray, condition: int) -> np.ndarray:
        """Return the parameters of one condition [.., columns] from all [.., num_parameters]."""
        own = np.tile(self._simulator.base, (*theta.shape[:-1], 1))
        for owner in (0, condition):
            for j, place in enumerate(self._places):
                if place.condition == owner:
                    own[..., place.column] = theta[..., j]
        return own


def _fit_together(
    model: Model, recordings: Sequence[Sequence[Recording]], diagnoses: Sequence[Diagnosis]
) -> list[Diagnosis]:
    """Fit what was selected to the recordings of all conditions; return the diagnoses with it."""
    everything = thin([r for some in recordings for r in some])
    condition = np.repeat(np.arange(len(recordings)), [len(some) for some in recordings])
    selected = [as_effects(model, d.selected) for d in diagnoses]
    kinds = {(e.kind, e.target): e for own in selected for e in own}
    had = {(e.kind, e.target): e for e in model.effects}
    host = native_model(model.compile(engine="mujoco"))
    grid = grid_for(everything, host)
    unmoved = [
        had[named] if named in had else type(e)(target=e.target, **e.at(host, e.target))
        for named, e in kinds.items()
    ]
    acting = [number for number, named in enumerate(kinds) if named in had]
    simulator = Simulator(model.without(unmoved), unmoved, grid, acting=acting)
    joint = JointSimulator(simulator, selected, condition)
    _, segments = choose_horizon(joint, everything, grid)
    fitted = np.ones(len(segments.start), bool)
    problem = Problem(joint, segments, fitted, grid.sample)
    if longer := cut_longer(problem, everything, grid, joint.base):
        problem, start = longer[0], longer[1].start
    else:
        start, _ = as_measured(problem, joint.base)
    candidates = [c for d in diagnoses for c in d.selected]
    free = [
        j
        for j, slot in enumerate(joint.slots)
        if _is_fitted(candidates[slot.effect], slot.parameter.name)
    ]
    best = count_timestep(problem, fit(problem, joint.base, start, free))
    best = with_guesses(problem, range(len(candidates)), best)
    refined = iter(
        dataclasses.replace(c, parameters=estimates(problem, number, best))
        for number, c in enumerate(candidates)
    )
    return [_with_selected(d, tuple(next(refined) for _ in d.selected)) for d in diagnoses]


def _with_selected(diagnosis: Diagnosis, selected: tuple[Candidate, ...]) -> Diagnosis:
    """Return a diagnosis with other sizes of what was selected, in its ladder too."""
    sized = {candidate.named: candidate for candidate in selected}
    ladder = tuple(
        rung if rung.added is None else dataclasses.replace(rung, added=sized[rung.added.named])
        for rung in diagnosis.ladder
    )
    return dataclasses.replace(diagnosis, selected=selected, ladder=ladder)


def _is_fitted(candidate: Candidate, parameter: str) -> bool:
    """Say whether the candidate's own diagnosis fitted one of its parameters."""
    estimate = candidate.parameters.get(parameter)
    return estimate is not None and bool(np.isfinite([estimate.low, estimate.high]).all())
