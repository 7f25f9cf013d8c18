"""Which of several candidates counts, by what each leaves."""

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
import pytest

from garat_jax.diagnosis.contend import Contender
from garat_jax.diagnosis.findings import Interval
from garat_jax.diagnosis.judge import (
    BEHIND,
    NO_CERTAIN_GAIN,
    NO_CERTAIN_LEAD,
    PASSING,
    TOO_FEW,
    _at_end,
    _failed_gate,
    is_certain,
    judge,
    simplest,
)
from garat_jax.diagnosis.metric import make_metric, noise_floor
from garat_jax.diagnosis.problem import FEWEST_SEGMENTS
from garat_jax.diagnosis.screen import Score
from garat_jax.diagnosis.starts import settle
from garat_jax.effects import CoggingTorque, GravityScale
from tests.diagnosis.test_fit import make_problem, record

TIME = np.arange(800) / 200.0
SIMPLE, RICH = "gravity_scale", "cogging_torque"


@pytest.fixture(scope="module")
def problem():
    effects = [CoggingTorque("joint/hinge"), GravityScale("world")]
    problem = make_problem([record(TIME), record(TIME)], effects)
    fitted = np.arange(len(problem.fitted)) < len(problem.fitted) // 2
    return dataclasses.replace(problem, fitted=fitted)


def judged(
    problem,
    left_by_rich: float,
    left_by_simple: float,
    p_value: float = 1e-9,
    large: float = 10.0,
    other_noise: bool = False,
    num_held_out: int | None = None,
    in_turn: Mapping[int, Interval] = MappingProxyType({}),
):
    """Judge two laws that do much the same to a large residual, and leave some of the noise.

    Args:
        problem: What is fitted.
        left_by_rich: How much of the noise the richer law leaves.
        left_by_simple: And the simpler.
        p_value: The simpler one's.
        large: What the residual is beside the noise, in its units.
        other_noise: Whether the richer law leaves noise of its own, and was expected to.
        num_held_out: In how many of the segments that are held out the laws do anything; None: all.
        in_turn: Falls of the error with each recording held out in turn.
    """
    start = settle(problem, problem.simulator.base, problem.segments.start)
    rng = np.random.default_rng(0)
    noise = rng.normal(size=start.residual.shape)
    wave = large * np.sin(np.arange(noise.size)).reshape(noise.shape)
    if num_held_out is not None:
        wave[np.flatnonzero(~problem.fitted)[num_held_out:]] = 0.0
    another = rng.normal(size=noise.shape)
    current = dataclasses.replace(start, residual=noise + wave)

    def contender(effect: int, columns, left: float, p_value: float) -> Contender:
        size = tuple(0.1 for _ in columns)
        score = Score(effect, columns, size, {}, 0.9, p_value, True, wave.ravel())
        nothing = np.full(len(columns), np.nan)
        fit = dataclasses.replace(
            current, free=columns, residual=left * noise, low=nothing, high=nothing
        )
        return Contender(score, fit)

    rich = contender(0, (0, 1, 2), left_by_rich, 1e-9)
    if other_noise:
        score = dataclasses.replace(rich.score, contribution=(wave + 3.0 * another).ravel())
        fit = dataclasses.replace(rich.fit, residual=left_by_rich * another)
        rich = dataclasses.replace(rich, score=score, fit=fit)
    simple = contender(1, (3,), left_by_simple, p_value)
    metric = make_metric(problem)
    floor = noise_floor(problem, metric, start)
    scores = [rich.score, simple.score]
    found = judge(problem, metric, current, scores, [rich, simple], floor, in_turn)
    return [candidate for candidate, _ in found]


def test_of_laws_that_both_reach_the_noise_the_simpler_counts(problem):
    first, second = judged(problem, 0.7, 0.8)
    assert (first.effect, second.effect) == (SIMPLE, RICH)
    assert [named.effect for named in first.indistinguishable_from] == [RICH]
    assert first.passes


@pytest.mark.parametrize(("missing", "passes"), [(0, True), (1, False)])
def test_nothing_passes_where_too_few_segments_are_fitted(problem, missing, passes):
    num_fitted = FEWEST_SEGMENTS - missing
    fitted = problem.fitted & (np.cumsum(problem.fitted) <= num_fitted)
    first, _ = judged(dataclasses.replace(problem, fitted=fitted), 0.7, 0.8)
    assert first.passes == passes
    assert passes or first.why == TOO_FEW


def test_nothing_passes_where_a_moment_is_held_out(problem):
    held_out = np.flatnonzero(~problem.fitted)
    kept = np.union1d(np.flatnonzero(problem.fitted), held_out[:1])
    first, _ = judged(problem.take(kept), 0.7, 0.8)
    num_blocks = len(np.unique(problem.blocks()[0]))
    assert num_blocks < FEWEST_SEGMENTS
    assert first.why == TOO_FEW


@pytest.mark.parametrize(("left", "equals"), [(1.0, [RICH]), (1.3, [])])
def test_laws_that_do_not_do_the_same_are_equals_where_both_reach_the_noise(problem, left, equals):
    first, _ = judged(problem, left, left, large=2.0 * left, other_noise=True)
    assert first.effect == SIMPLE
    assert [named.effect for named in first.indistinguishable_from] == equals
    assert first.passes


def test_a_richer_law_counts_where_the_simpler_leaves_more_than_noise(problem):
    first, second = judged(problem, 0.9, 1.3)
    assert (first.effect, second.effect) == (RICH, SIMPLE)
    assert first.indistinguishable_from == ()
    assert first.passes and not second.passes


def test_a_simpler_law_that_fails_a_gate_does_not_count(problem):
    first, second = judged(problem, 0.7, 0.8, p_value=0.5)
    assert (first.effect, second.effect) == (RICH, SIMPLE)
    assert first.passes and not second.passes


@pytest.mark.parametrize("left_by_rich", [2.0, 1.85])
def test_more_parameters_do_not_tell_a_law_from_one_that_it_does_not_refine(problem, left_by_rich):
    simple, rich = judged(problem, left_by_rich, 2.0)
    assert (simple.effect, rich.effect) == (SIMPLE, RICH)
    assert [named.effect for named in simple.indistinguishable_from] == [RICH]
    assert [named.effect for named in rich.indistinguishable_from] == [SIMPLE]


def test_an_equal_of_the_best_that_passes_every_gate_comes_first(problem):
    best, equal = judged(problem, 1.75, 2.0)
    assert (best.effect, equal.effect) == (SIMPLE, RICH)
    assert [named.effect for named in best.indistinguishable_from] == [RICH]
    first, second = judged(problem, 1.75, 2.0, p_value=0.5)
    assert (first.effect, second.effect) == (RICH, SIMPLE)
    assert first.passes and not second.passes


@pytest.mark.parametrize(("num_held_out", "passes"), [(1, True), (0, False)])
def test_a_law_that_seldom_acts_counts_if_it_does_on_what_is_held_out(
    problem, num_held_out, passes
):
    first, *_ = judged(problem, 1.0, 1.0, num_held_out=num_held_out)
    assert first.held_out_gain.low <= 0
    assert first.passes == passes


@pytest.mark.parametrize(("low", "passes"), [(0.1, True), (-0.1, False)])
def test_with_each_recording_held_out_in_turn_the_fall_has_to_be_certain_too(problem, low, passes):
    fall = Interval(1.0, low, 2.0)
    first, *_ = judged(problem, 1.0, 1.0, num_held_out=0, in_turn={0: fall, 1: fall})
    assert first.passes == passes
    said = "passes every gate with each recording held out in turn (the error falls by 1, 0.1 to 2)"
    assert first.why.startswith(said) if passes else first.why == NO_CERTAIN_GAIN
    assert first.held_out_gain.estimate == 0.0
    (first, *_) = judged(problem, 1.0, 1.0, in_turn={0: fall, 1: fall})
    assert first.why == PASSING


def test_a_fall_is_certain_if_no_resample_rises_by_more_than_a_trifle_of_it():
    assert is_certain(Interval(1.0, 0.1, 2.0))
    assert is_certain(Interval(1.0, -0.001, 2.0))
    assert not is_certain(Interval(1.0, -0.1, 2.0))
    assert not is_certain(Interval(-1.0, -2.0, 0.1))
    assert not is_certain(Interval(0.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, ""),
        ({"p_value": 0.02}, "not significant (corrected p = 0.02)"),
        ({"share": 0.049}, "explains only 4.9 % of the residual"),
        ({"gain": Interval(1.0, -0.1, 2.0)}, NO_CERTAIN_GAIN),
        ({"lead": 0.0}, NO_CERTAIN_LEAD),
        ({"lead": -np.inf}, BEHIND),
        ({"stability": 0.79}, "first in only 79 % of the resamples"),
    ],
    ids=lambda value: " and ".join(value) or "none" if isinstance(value, dict) else None,
)
def test_each_gate_stops_what_passes_all_others(changes, said):
    good = {"p_value": 1e-9, "share": 0.5, "gain": Interval(1.0, 0.5, 2.0)}
    good |= {"lead": 0.1, "stability": 1.0}
    score = Score(0, (0,), (0.1,), {}, 0.9, (good | changes)["p_value"], True, np.zeros(1))
    rest = {name: value for name, value in (good | changes).items() if name != "p_value"}
    assert _failed_gate(score, **rest) == said


def test_a_value_that_is_a_bound_but_for_rounding_is_the_bound():
    *_, phase = CoggingTorque.parameters()
    assert _at_end(phase, phase.high - 1e-12) == phase.high
    assert _at_end(phase, phase.low + 1e-12) == phase.low
    assert _at_end(phase, 1e-12) == phase.nominal
    inside = phase.high - 1e-6
    assert _at_end(phase, inside) == inside


def test_of_fits_that_leave_no_more_than_noise_the_simplest_that_is_not_led_counts(
    problem, monkeypatch
):
    metric = make_metric(problem)
    start = settle(problem, problem.simulator.base, problem.segments.start)
    floor = noise_floor(problem, metric, start)
    monkeypatch.setattr("garat_jax.diagnosis.judge.noise_floor", lambda *of: floor)
    noise = np.random.default_rng(0).normal(size=start.residual.shape)
    times = np.max(metric.by_signal(noise, ~problem.fitted) / floor.by_signal)

    def leaving(left: float, num_free: int):
        residual = left / times * noise  # `left` times the floor, of one of the signals
        return dataclasses.replace(start, residual=residual, free=tuple(range(num_free)))

    best, as_rich = leaving(1.0, 3), leaving(1.0, 3)
    simple, simpler, nearer = leaving(1.01, 2), leaving(1.02, 1), leaving(1.015, 1)
    led, loud = leaving(1.05, 1), leaving(1.15, 1)
    loud.residual[problem.fitted] *= 0.1  # not led, but above the floor where it counts
    assert simplest(problem, metric, best, [as_rich]) is best
    assert simplest(problem, metric, best, [simple, best]) is simple
    assert simplest(problem, metric, best, [simple, simpler]) is simpler
    assert simplest(problem, metric, best, [simpler, nearer]) is nearer
    assert simplest(problem, metric, best, [led]) is best  # by 10 % of the squares
    assert simplest(problem, metric, best, [loud]) is best
