"""What a transfer experiment's numbers are, and what is left out of them."""

import json

import numpy as np
import pytest

from garat_jax import summary
from garat_jax.runs import RunDirectory

SEEDS = [0, 1, 2]
KEYS = {
    "format", "pair", "method", "seeds", "returns", "scaled", "controls", "transition_error",
    "baselines", "target_transitions", "env_steps", "seconds",
}  # fmt: skip


def summarise(source=(100.0, 100.0, 100.0), target=(1000.0, 1000.0, 1000.0), count=3, **changed):
    """Summarise made-up results; the method gets 1000, 550 and 100."""
    seeds = SEEDS[:count]
    returns = {
        "source_policy": np.asarray(source[:count]),
        "target_policy": np.asarray(target[:count]),
        "method": np.asarray([1000.0, 550.0, 100.0][:count]),
        "more_source_training": np.full(count, 190.0),
        "action_noise": np.full(count, 280.0),
    }
    errors = {
        "source": np.asarray([1.0, 2.0, 4.0][:count]),
        "grounded": np.asarray([0.1, 0.4, 1.0][:count]),
        "zero_action": np.asarray([0.5, 0.5, 1.0][:count]),
        "constant_action": np.asarray([0.4, 0.5, 1.0][:count]),
    }
    curve = [{"step": n, "error": [1.0 / n] * count} for n in (1, 2)]
    arguments = {
        "pair": "some_pair",
        "method": "garat",
        "seeds": seeds,
        "solved_return": 950.0,
        "source_solved": np.ones(count, bool),
        "returns": returns,
        "errors": errors,
        "curve": curve,
        "target_transitions": 5000,
        "num_episodes": 50,
        "env_steps": {"source_policy": np.full(count, 10)},
        "seconds": {"compile": 1.0, "run": 2.0},
    }
    return summary.summarise(**(arguments | changed))


def test_it_has_what_the_format_promises_and_is_plain_json():
    result = summarise()
    assert result["format"] == "garat-transfer/1"
    assert result.keys() >= KEYS
    assert result["returns"].keys() == {"source_policy", "target_policy", "method"}
    assert result["controls"].keys() == {"more_source_training", "action_noise"}
    assert result["transition_error"].keys() == {"source", "grounded", "zero_action"}
    assert json.loads(json.dumps(result, allow_nan=False)) == result


def test_returns_are_scaled_from_the_source_policy_to_the_target_policy():
    result = summarise()
    assert result["scaled"]["per_seed"] == pytest.approx([1.0, 0.5, 0.0])
    assert result["scaled"]["mean"] == pytest.approx(0.5)
    assert result["scaled"]["standard_error"] == pytest.approx(0.5 / np.sqrt(3))
    controls = {name: c["scaled"]["mean"] for name, c in result["controls"].items()}
    assert controls == pytest.approx({"more_source_training": 0.1, "action_noise": 0.2})


def test_errors_are_told_as_shares_of_the_sources():
    result = summarise()
    assert result["error_ratio"] == pytest.approx([0.1, 0.2, 0.25])
    assert result["baselines"]["zero_action"]["ratio"] == pytest.approx([0.5, 0.25, 0.25])
    assert result["transition_error_curve"] == {
        "update": [1, 2],
        "grounded": [[1.0] * 3, [0.5] * 3],
    }


@pytest.mark.parametrize(
    ("source", "target"),
    [
        ((100.0, 400.0, 100.0), (1000.0, 1000.0, 1000.0)),  # works in the target as it is
        ((100.0, 100.0, 100.0), (1000.0, 500.0, 1000.0)),  # nothing to compare with
        ((100.0, 500.0, 100.0), (1000.0, 500.0, 1000.0)),  # nor a scale
    ],
)
def test_a_seed_that_is_not_meaningful_is_left_out(source, target):
    result = summarise(source, target)
    assert result["meaningful"] == [True, False, True]
    assert result["scaled"]["per_seed"] == [1.0, None, 0.0]
    assert result["scaled"]["mean"] == 0.5
    assert result["controls"]["action_noise"]["scaled"]["per_seed"][1] is None


@pytest.mark.parametrize(
    ("source", "target", "is_meaningful"),
    [(-40.0, -7.9, True), (-40.0, -9.0, False), (-8.1, -7.0, False), (-6.0, -7.0, False)],
)
def test_returns_may_be_costs(source, target, is_meaningful):
    """What solves the target loses at most 5 % of -8, and the source policy loses much more."""
    result = summarise((source,), (target,), count=1, solved_return=-8.0)
    assert result["meaningful"] == [is_meaningful]


def test_one_meaningful_seed_has_no_standard_error():
    result = summarise(count=1)
    assert (result["scaled"]["mean"], result["scaled"]["standard_error"]) == (1.0, None)


def test_the_errors_of_a_seed_that_is_not_meaningful_are_not_averaged_in():
    result = summarise((100.0, 400.0, 100.0))  # ratios 0.1, 0.2, 0.25; zero action 0.5, 0.25, 0.25
    assert "is off by 0.17 times" in summary.lead(result)
    assert "share of the source's: 0.175; with zero action 0.375." in summary.describe(result)
    assert summary.facts(result)[-1].value == "0.17"


def test_where_no_seed_is_meaningful_the_errors_are_means_of_all():
    result = summarise((900.0, 900.0, 900.0))
    assert "share of the source's: 0.183; with zero action 0.333." in summary.describe(result)


@pytest.fixture
def run(tmp_path):
    return RunDirectory.create(tmp_path / "run", {"pair": "some_pair"}, "garat transfer x", SEEDS)


def written(run: RunDirectory, result) -> str:
    summary.write_report(run, result, "a heavier thing")
    return (run.root / "report.html").read_text(encoding="utf-8")


def test_the_report_tells_the_result_and_names_the_seeds_left_out(run):
    text = written(run, summarise((100.0, 400.0, 100.0), num_episodes=7))
    assert "a heavier thing" in text
    assert "every seed (dots), 7 episodes each" in text
    assert "0.50 ± 0.50" in text
    works = "the source policy works in the target as it is"
    assert f"Left out as not meaningful: seed 1: {works}." in text


def test_when_no_seed_is_meaningful_there_is_no_mean_and_the_report_says_so(run):
    result = summarise((900.0, 900.0, 900.0))
    nothing = {"mean": None, "standard_error": None, "per_seed": [None] * 3}
    assert result["scaled"] == nothing
    assert result["controls"]["action_noise"]["scaled"] == nothing
    assert summary.facts(result)[0].value == "–"
    text = written(run, result)
    reason = "the source policy works in the target as it is"
    said = "; ".join(f"seed {seed}: {reason}" for seed in SEEDS)
    assert f"Left out as not meaningful: {said}." in text
    assert summary.lead(result).startswith(f"No seed is meaningful: {said}. Nothing")


@pytest.mark.parametrize(
    ("method", "control", "said"),
    [
        ([1000.0, 990.0, 1000.0], [190.0, 200.0, 150.0], "the difference is the work of grounding"),
        ([1000.0, 990.0, 1000.0], [980.0, 995.0, 970.0], "do not show that it is grounding that"),
        ([1000.0] * 3, [999.0] * 3, "reaches 1.00: these seeds do not show that it is grounding"),
        ([1000.0], [190.0], "reaches 0.10; one seed cannot tell whether that is chance"),
    ],
)
def test_the_better_control_stands_beside_the_method(method, control, said):
    count = len(method)
    returns = {
        "source_policy": np.full(count, 100.0),
        "target_policy": np.full(count, 1000.0),
        "method": np.asarray(method),
        "more_source_training": np.asarray(control),
        "action_noise": np.full(count, 100.0),
    }
    result = summarise(count=count, returns=returns)
    assert "More source training, the better of two controls, reaches" in summary.lead(result)
    assert said in summary.lead(result)
    assert ("standard error" in summary.describe(result)) == (count > 1)


def test_it_says_which_condition_each_seed_left_out_fails():
    result = summarise(
        (100.0, 900.0, 100.0),
        (1000.0, 1000.0, 500.0),
        source_solved=np.asarray([False, True, True]),
    )
    first, target, lost = summary.REASONS
    assert result["not_meaningful_because"] == [first, lost, target]


def test_a_grounding_without_updates_can_be_reported(run):
    assert "some_pair" in written(run, summarise(curve=[]))


def test_a_seed_whose_source_policy_solved_nothing_is_not_meaningful():
    result = summarise(source_solved=np.asarray([True, False, True]))
    assert result["meaningful"] == [True, False, True]
    assert result["scaled"]["per_seed"][1] is None
