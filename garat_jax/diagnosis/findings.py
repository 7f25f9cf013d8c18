"""What a diagnosis found: candidates, their sizes, what each recording shows and what none does."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence

from garat_jax.diagnosis.units import after_number

DELAYS = ("actuator_delay", "sensor_delay")
"""Effects that come late and are no part of the mechanism. A common delay stands for them, too."""
TIMINGS = (*DELAYS, "actuator_lag")
"""Effects that may stand for a delay where the recordings do not tell them from one."""
MOST_NAMED = 4
"""Effects that a sentence names at most: of rivals, or of those that recordings cannot show."""


@dataclasses.dataclass(frozen=True)
class Interval:
    """A number with its 95 % interval."""

    estimate: float
    low: float
    high: float


@dataclasses.dataclass(frozen=True)
class Estimate(Interval):
    """A parameter with its 95 % interval and unit; the ends are NaN where the data say nothing."""

    unit: str

    def __str__(self) -> str:
        known = math.isfinite(self.low) and math.isfinite(self.high)
        ends = f" [{self.low:.4g}, {self.high:.4g}]" if known else ""
        return f"{self.estimate:.4g}{ends}{after_number(self.unit)}"


@dataclasses.dataclass(frozen=True)
class Named:
    """An effect at a place."""

    effect: str
    target: str

    def __str__(self) -> str:
        return f"{self.effect} at {self.target}"


@dataclasses.dataclass(frozen=True)
class Experiment:
    """What to record next to tell indistinguishable effects apart."""

    separates: tuple[Named, ...]
    how: str


@dataclasses.dataclass(frozen=True)
class Unseen(Named):
    """An effect that the recordings cannot show, up to a size.

    Attributes:
        parameters: Its parameters' names.
        up_to: Change of a parameter, from no effect, below which it stays hidden: of the first, or
            of the one that shows most if they act alone. Infinite if all that its bounds allow
            stays hidden, or if the law has a threshold.
        unit: That parameter's unit.
    """

    parameters: tuple[str, ...]
    up_to: float
    unit: str

    @property
    def size(self) -> str:
        """Up to which size it stays hidden, in words; empty if at any."""
        known = math.isfinite(self.up_to)
        return f"up to {self.up_to:.2g}{after_number(self.unit)}" if known else ""


def list_unseen(unseen: Sequence[Unseen], most: int | None = None) -> str:
    """Return effects, by kind and with their parameters, in words; the first `most` kinds."""
    places: dict[str, list[str]] = {}
    for one in unseen:
        size = f" ({one.size})" if one.size else ""
        what = f"{one.effect} ({', '.join(one.parameters)})"
        places.setdefault(what, []).append(f"{one.target}{size}")
    named = [f"{what} at {' and '.join(at)}" for what, at in places.items()]
    more = named[most:] if most is not None else []
    return ", ".join(named[:most]) + (f" and {len(more)} more" if more else "")


@dataclasses.dataclass(frozen=True)
class Candidate:
    """An effect that may be missing, and what the recordings say about it.

    Attributes:
        effect: Its kind.
        target: Where it would act.
        parameters: Estimates by name.
        share: Share of the fitted residual's squares that it explains.
        p_value: Corrected for the number of candidates.
        error_after: Held-out error with the effect, NaN if it was not fitted.
        held_out_gain: How much the held-out error falls, samples counting as they are trusted.
        stability: Share of block resamples in which it, or one indistinguishable from it, is first.
        indistinguishable_from: Effects that these recordings cannot tell from it.
        passes: Whether it passes every gate.
        why: The gate that it fails, or what speaks for it.
    """

    effect: str
    target: str
    parameters: Mapping[str, Estimate]
    share: float
    p_value: float
    error_after: float
    held_out_gain: Interval
    stability: float
    indistinguishable_from: tuple[Named, ...]
    passes: bool
    why: str

    @property
    def named(self) -> Named:
        """The effect and its place."""
        return Named(self.effect, self.target)

    @property
    def is_delay(self) -> bool:
        """Whether it is, or for all that the recordings tell may be, a delay."""
        alike = {named.effect for named in (self.named, *self.indistinguishable_from)}
        return self.effect in TIMINGS and not alike.isdisjoint(DELAYS)

    @property
    def sizes(self) -> str:
        """The parameters with their intervals and units."""
        return ", ".join(f"{name} {value}" for name, value in self.parameters.items())

    def with_alike(self, name: Callable[[Named], str] = str) -> str:
        """Name the effect, and those that the recordings cannot tell from it, by `name`."""
        alike = [name(other) for other in self.indistinguishable_from]
        if not alike:
            return name(self.named)
        others = " or ".join(alike) if len(alike) < 3 else f"one of {len(alike)} others"
        return f"{name(self.named)} (or {others}: these recordings cannot tell)"


def apart(selected: Sequence[Candidate]) -> tuple[Candidate, ...]:
    """Return effects that were found, none of them named as what another is not told from."""
    taken = {c.named for c in selected}
    return tuple(
        dataclasses.replace(
            c, indistinguishable_from=tuple(n for n in c.indistinguishable_from if n not in taken)
        )
        for c in selected
    )


@dataclasses.dataclass(frozen=True)
class Sighting:
    """What one recording alone shows of a parameter, and of the effect that it belongs to.

    Attributes:
        recording: Its name.
        estimate: The parameter; NaN where the recording does not show it.
        low: The lower end of its 95 % interval.
        high: The upper end.
        error_without: Error in this recording, of its signals' spread, without the effect.
        error_with: The same with it.
        ahead: Rivals of the effect that are expected to explain more of this recording.
        horizon: Seconds that the recording was followed for at a time.
    """

    recording: str
    estimate: float
    low: float
    high: float
    error_without: float
    error_with: float
    ahead: tuple[Named, ...]
    horizon: float

    @property
    def is_sized(self) -> bool:
        """Whether this recording by itself tells the parameter, within an interval."""
        return all(map(math.isfinite, (self.estimate, self.low, self.high)))

    @property
    def is_needed(self) -> bool:
        """Whether the effect is what this recording by itself would have asked for first."""
        return self.error_with < self.error_without and not self.ahead


@dataclasses.dataclass(frozen=True)
class Repeated:
    """One parameter of an effect that was found, recording by recording.

    Attributes:
        effect: The effect's kind.
        target: Where it acts.
        parameter: The parameter.
        unit: Its unit.
        recordings: What each recording shows.
        p_value: Probability of such differences if the size is the same in all (Cochran's Q).
        agree: Whether that is not improbable.
    """

    effect: str
    target: str
    parameter: str
    unit: str
    recordings: tuple[Sighting, ...]
    p_value: float
    agree: bool


@dataclasses.dataclass(frozen=True)
class Drift:
    """A parameter that changes while it is recorded.

    Attributes:
        effect: The effect's kind.
        target: Where it acts.
        parameter: The parameter.
        begin: Its value where the recordings begin.
        end: Its value where they end, if it changes evenly.
        change: By how much it changes.
        p_value: Probability of such a change if the parameter is constant.
        share: Share of what the constant parameter leaves unexplained.
        instead: Whether the effect is not what was added, but what the recordings do not tell from
            that while it is constant.
    """

    effect: str
    target: str
    parameter: str
    begin: float
    end: float
    change: Estimate
    p_value: float
    share: float
    instead: bool = False

    def __str__(self) -> str:
        way = "falls" if self.end < self.begin else "rises"
        unit = after_number(self.change.unit)
        instead = ", taken in place of what was added" if self.instead else ""
        return (
            f"{self.parameter} of {self.effect} at {self.target} {way} from {self.begin:.3g} to "
            f"{self.end:.3g}{unit} within a recording{instead}"
        )
