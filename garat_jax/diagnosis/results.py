"""What a diagnosis says: typed, printable, and the content of diagnosis.json."""

import dataclasses
import html
import math
from collections.abc import Callable, Mapping
from typing import Any, Literal

import plotly.graph_objects as go

from garat_jax.diagnosis.findings import (
    MOST_NAMED,
    Candidate,
    Drift,
    Experiment,
    Named,
    Repeated,
    Unseen,
    list_unseen,
)
from garat_jax.diagnosis.judge import NIL, NO_CERTAIN_LEAD, TOO_FEW
from garat_jax.diagnosis.localise import Place
from garat_jax.diagnosis.metric import Errors
from garat_jax.effects import CATALOGUE
from garat_jax.errors import choose
from garat_jax.plain import finite_or_null, to_plain

FORMAT = "garat-diagnosis/1"
OFFER = (
    "what no effect explains, an action transformer may learn from the recordings: garat ground "
    "MODEL DATA... --method gat, or garat; garat compare --grounded then says how much that is."
)
"""What is said where the verdict is `unexplained`."""
MOST_LISTED = 6
"""Candidates that are printed, the first; so is what passes, wherever it stands."""
Verdict = Literal["adequate", "missing_effect", "unexplained"]


@dataclasses.dataclass(frozen=True)
class Rung:
    """One step of the ladder: the errors once an effect was added."""

    added: Candidate | None
    error_fit: float
    error_holdout: float


@dataclasses.dataclass(frozen=True)
class Diagnosis:
    """Where a model fails and which effect it is missing; fields as in diagnosis.json.

    `conditions` holds the diagnoses of recordings made under other conditions, in which the model
    has the effects that were selected here; one of the same kind and place replaces it there. The
    parameters of `selected` then fit all conditions together, save those in which most of the gap
    stays; errors and candidates are of each condition by itself.

    `longest` holds the errors over longer segments than those that were fitted, the longest within
    which small changes do not grow; None where those fitted are as long. `finer` holds those at a
    finer timestep, where the integrator's error hides much at the model's own; None elsewhere, and
    where nothing was found that could explain the errors. `on_time` holds those of `error` with the
    delays that were found in the model from the start, or of `finer`; None where none was found.

    `own` names the effects that the model has and that may have another size: one of them that was
    selected takes the place of the model's.
    """

    model: str
    data: tuple[str, ...]
    holdout: tuple[str, ...]
    versions: Mapping[str, str | None]
    seconds: float
    verdict: Verdict
    error: Errors
    where: tuple[Place, ...]
    candidates: tuple[Candidate, ...]
    selected: tuple[Candidate, ...]
    ladder: tuple[Rung, ...]
    next_experiment: Experiment | None
    drifts: tuple[Drift, ...] = ()
    repeatability: tuple[Repeated, ...] = ()
    warnings: tuple[str, ...] = ()
    unseen: tuple[Unseen, ...] = ()
    still: bool = False
    left: tuple[Place, ...] = ()
    conditions: Mapping[str, "Diagnosis"] = dataclasses.field(default_factory=dict)
    longest: Errors | None = None
    finer: Errors | None = None
    on_time: Errors | None = None
    own: tuple[Named, ...] = ()

    def added(self, rung: Rung) -> str:
        """Say what a rung of the ladder adds, at its final size."""
        if rung.added is None:
            return "the model as it is"
        return f"+ {self.spelled(rung.added.named)} ({rung.added.sizes})"

    def spelled(self, named: Named, spell: Callable[[Named], str] = str) -> str:
        """Spell an effect; of one that the model has, that another size, or none, was found."""
        if named not in self.own:
            return spell(named)
        none = " (none)" if any(c.named == named and _is_none(c) for c in self.selected) else ""
        return f"another size{none} of {spell(named)}"

    def under(self, condition: str) -> tuple[Candidate, ...]:
        """Return all effects under a condition: the shared ones, some replaced, and its own."""
        own = {c.named: c for c in self.conditions[condition].selected}
        return tuple(({c.named: c for c in self.selected} | own).values())

    def to_json(self) -> dict[str, Any]:
        """Return the content of diagnosis.json; what is not finite is null."""
        plain = to_plain(dataclasses.replace(self, conditions={}))
        plain["conditions"] = {name: found.to_json() for name, found in self.conditions.items()}
        return {"format": FORMAT, **finite_or_null(plain)}

    def plot(self, what: str = "ladder") -> go.Figure:
        """Draw the `ladder` of errors, the `ranking` of effects, or `where` the model fails.

        Raises:
            UserError: There is no such drawing.
        """
        from garat_jax.diagnosis import figures

        drawings: dict[str, Callable[[], go.Figure]] = {
            "ladder": lambda: figures.ladder(self),
            "ranking": lambda: figures.ranking(self.candidates),
            "where": lambda: figures.where_it_fails(self.where),
        }
        return choose("drawing", what, drawings)()

    def _repr_html_(self) -> str:
        """Return what a notebook shows."""
        return f"<pre>{html.escape(str(self))}</pre>"

    @property
    def sentence(self) -> str:
        """What is wrong, in one sentence."""
        error, over = self.decisive, self.over
        if error.is_too_coarse:
            return error.coarseness
        floor = f"{error.noise_floor:.3g}"
        fall = f"held-out error{over} {error.before:.3g} → {error.after:.3g}{self.farther()}"
        fall += f", noise floor {floor}"
        if self.verdict == "adequate":
            return (
                f"The model is adequate: its held-out error {error.before:.3g} is near the noise "
                f"floor {floor}{self.blindness}."
            )
        names = " and ".join(c.with_alike(self.spelled) for c in self.selected)
        if self.verdict == "missing_effect":
            return f"Missing: {names}; {fall}{self.but}."
        if names:
            return f"Found {names}; {fall}; but {self.rest}."
        if rivals := self.rivals():
            return f"None of {rivals} leads for certain, and none is added: {self.rest}."
        if self.is_too_short:
            return f"Too little was recorded to be certain of what is missing: {self.rest}."
        if dropped := self.dropped():
            return (
                f"{dropped} would explain much, but not for certain at a timestep of 0, and is not "
                f"added: {self.rest}; give the model a smaller timestep to be certain."
            )
        return f"Nothing in the catalogue explains the error: {self.rest}."

    @property
    def is_too_short(self) -> bool:
        """Whether too little could be fitted to be certain of any effect."""
        return any(candidate.why == TOO_FEW for candidate in self.candidates)

    def dropped(self, spell: Callable[[Named], str] = str) -> str:
        """Spell the first candidate that only the timestep's error keeps back; empty if none is."""
        return next((spell(c.named) for c in self.candidates if c.why == NIL), "")

    def rivals(self, spell: Callable[[Named], str] = str) -> str:
        """Spell the first candidates that only rivals keep back; empty if there are not several."""
        held_back = [c.named for c in self.candidates if c.why == NO_CERTAIN_LEAD]
        if len(held_back) < 2:
            return ""
        return ", ".join(spell(named) for named in held_back[:MOST_NAMED])

    @property
    def rest(self) -> str:
        """What stays unexplained, as a clause."""
        if self.loud:
            over = self._over(self.gap)
            return f"that of {', '.join(self.loud)}{over} stays well above its noise floor"
        share = 100 * self.gap.unexplained_share
        over = self._over(self.gap)
        return f"{share:.0f} % of the error{over}{self.beside_delays} stays unexplained"

    @property
    def beside_delays(self) -> str:
        """Of which error much is left, where it is what delays leave, as a clause; else empty."""
        if self.gap is not self.on_time:
            return ""
        num = sum(c.is_delay for c in self.selected)
        return " that the delay alone leaves" if num == 1 else " that the delays alone leave"

    @property
    def but(self) -> str:
        """A clause with the signals that stay well above their noise floor; empty if none does.

        Where an effect explains the error of all signals together, of a signal with little noise
        something may be left that this noise does not hide.
        """
        if self.verdict != "missing_effect" or not self.error.above_floor:
            return ""
        times = {}
        for name in self.error.above_floor:
            of_signal = self.error.per_signal[name]
            times[name] = float(of_signal["after"]) / float(of_signal["noise_floor"])
        if len(times) == 1:
            ((name, size),) = times.items()
            return f", but that of {name} stays at {size:.2g} times its own noise floor"
        listed = " and ".join(f"{name} (at {size:.2g} times)" for name, size in times.items())
        return f", but those of {listed} stay above their own noise floors"

    @property
    def loud(self) -> tuple[str, ...]:
        """The signals well above their noise floor, where only these tell of a gap."""
        of_delays = self.gap is self.on_time and all(c.is_delay for c in self.selected)
        alone = not self.selected or of_delays
        return self.gap.above_floor if alone and self.gap.is_near_floor else ()

    @property
    def gap(self) -> Errors:
        """The errors of which much is left: those on time where these show it, too.

        Beside what a delay makes even much may be little.
        """
        is_told = self.verdict == "unexplained" and self.decisive is self.error
        is_told &= not self.error.is_too_coarse
        if is_told and self.on_time and not self.on_time.is_explained:
            return self.on_time
        return self.decisive

    @property
    def decisive(self) -> Errors:
        """The errors that decide.

        Those at a finer timestep, or over the longest segments, where these alone show a gap.
        """
        measured = [e for e in (self.error, self.finer, self.longest) if e is not None]
        if self.verdict != "unexplained":
            return self.error
        return next((e for e in measured if not self._is_right(e)), self.error)

    @property
    def shown(self) -> Errors:
        """The errors beside what is simulated at the model's own timestep."""
        return self.error if self.decisive is self.finer else self.decisive

    def _is_right(self, error: Errors) -> bool:
        """Whether errors alone would say that nothing, or nothing more, is missing."""
        return error.is_explained if self.selected else error.is_adequate

    @property
    def over(self) -> str:
        """Over how long segments the decisive errors are, in words; empty if that is not known."""
        return self._over(self.decisive)

    def _over(self, error: Errors) -> str:
        at = f" at a timestep of {error.timestep:.2g} s" if self._is_finer(error) else ""
        return f" over {error.horizon:.2g} s{at}" if math.isfinite(error.horizon) else ""

    def _is_finer(self, error: Errors) -> bool:
        return self.finer is not None and error.timestep == self.finer.timestep

    def farther(self, spell: Callable[[float], str] = "{:.3g}".format) -> str:
        """Return a clause with the errors over longer segments, where they were measured."""
        far = self.longest
        if far is None or far is self.decisive or not self.selected:
            return ""
        return f" (over {far.horizon:.2g} s {spell(far.before)} → {spell(far.after)})"

    @property
    def is_left(self) -> bool:
        """Whether a gap stays that is the model's, not the integrator's."""
        return self.verdict == "unexplained" and not self.decisive.is_too_coarse

    @property
    def is_gap_finer(self) -> bool:
        """Whether much is left at a finer timestep alone."""
        return self._is_finer(self.gap)

    @property
    def left_lines(self) -> list[str]:
        """What the gap that stays goes with, in words; nothing if none stays."""
        if self.is_left and self.is_gap_finer:
            timestep = f"{self.gap.timestep:.2g} s"
            return [f"it shows at a timestep of {timestep}: a model that has it may tell more"]
        lines = [place.evidence for place in self.left[:3]]
        nothing = ["the torque that is still missing follows no simple pattern"]
        return (lines or nothing) if self.is_left else []

    @property
    def blindness(self) -> str:
        """A clause with what the recordings cannot show; empty if they show everything."""
        why = " excite nothing (all that moves is noise): they" if self.still else ""
        if not self.unseen:
            return ""
        return f", but the recordings{why} cannot show {list_unseen(self.unseen, MOST_NAMED)}"

    def __str__(self) -> str:
        lines = [self.sentence]
        lines += [f"  warning: {warning}" for warning in self.warnings]
        if self.verdict != "adequate" and (self.selected or not self.is_left):
            lines += [f"  where: {place.evidence}" for place in self.where[:3]]
        if self.unseen:
            lines.append(f"  not shown by these recordings: {list_unseen(self.unseen)}")
        final = {c.named for c in self.selected} if len(self.selected) > 1 else set()
        for c in [c for i, c in enumerate(self.candidates) if i < MOST_LISTED or c.passes]:
            fitted = f", held-out error {c.error_after:.3g}, stability {c.stability:.2f}"
            share = f"share {c.share:.2f}{fitted if math.isfinite(c.error_after) else ' expected'}"
            share = f"when it was added {share}" if c.named in final else share
            said = "; ".join(part for part in (c.sizes, share, c.why) if part)
            lines.append(f"  {'*' if c.passes else ' '} {c.named}: {said}")
        for rung in self.ladder:
            errors = f"fit {rung.error_fit:.4g}, held-out {rung.error_holdout:.4g}"
            lines.append(f"  {self.added(rung)}: {errors}")
        lines += [f"  left: {line}" for line in self.left_lines]
        lines += [f"  drift: {drift}" for drift in self.drifts]
        if self.next_experiment:
            lines.append(f"  next: {self.next_experiment.how}")
        if self.is_left:
            lines.append(f"  or: {OFFER}")
        return "\n".join([*lines, *self.other_conditions])

    @property
    def other_conditions(self) -> list[str]:
        """What was found under other conditions, line by line."""
        lines, shared = [], [c.named for c in self.selected]
        for name, found in self.conditions.items():
            lines.append(f"Under the condition {name}, with the above: {found.sentence}")
            own = [warning for warning in found.warnings if warning not in self.warnings]
            lines += [f"  warning: {warning}" for warning in own]
            for c in found.selected:
                instead = " (instead of the shared one)" if c.named in shared else ""
                lines.append(f"  {c.named}{instead}: {c.sizes}")
        return lines


def _is_none(candidate: Candidate) -> bool:
    """Say whether an effect of the catalogue was found to have no size."""
    law = CATALOGUE.get(candidate.effect)
    nominal = {p.name: p.nominal for p in law.parameters()} if law else {}
    estimates = candidate.parameters.items()
    return bool(estimates) and all(e.estimate == nominal.get(name) for name, e in estimates)
