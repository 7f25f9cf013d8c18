"""Hide an effect and find it; hide none and say so; hide one outside the catalogue and say that.

Data come from C MuJoCo at a 32nd of the model's timestep. Thresholds were chosen on seeds 0 to 9.
"""

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace

import pytest

from garat_jax.diagnosis import Recording, compare, diagnose, load_model
from garat_jax.diagnosis.convert import free_pendulum
from garat_jax.diagnosis.diagnose import verdict_of
from garat_jax.diagnosis.held_out import HeldOut
from garat_jax.diagnosis.hidden import DRAWN, OUTSIDE, make_recordings
from garat_jax.diagnosis.judge import NIL
from garat_jax.diagnosis.metric import Errors
from garat_jax.diagnosis.report import diagnosis_lead
from garat_jax.errors import UserError
from garat_jax.runs import RunDirectory

PENDULUM = Path(__file__).parents[2] / "envs" / "assets" / "pendulum.xml"
FASTEST = {"num_recordings": 3, "seconds": 4.0, "rate": 125.0}


def find(folder, seed: int, kind: str, **size):
    hidden = make_recordings(PENDULUM, folder, seed, kind=kind, **size)
    model = load_model(PENDULUM)
    host = model.compile().host.model
    fit, holdout = ([Recording.read(p, host) for p in part] for part in hidden[:2])
    return hidden, diagnose(model, fit, holdout)


def check_found(hidden, found):
    first = found.candidates[0]
    named = {(first.effect, first.target)}
    named |= {(n.effect, n.target) for n in first.indistinguishable_from}
    assert (hidden.kind, hidden.target) in named
    assert found.verdict == "missing_effect"
    assert found.error.after < 1.25 * found.error.noise_floor < 0.5 * found.error.before
    assert found.ladder[0].error_holdout > found.ladder[-1].error_holdout
    assert [rung.added for rung in found.ladder[1:]] == list(found.selected)
    if first.effect == hidden.kind:
        for name, value in first.parameters.items():
            assert value.estimate == pytest.approx(hidden.parameters[name], rel=0.05)


@pytest.mark.parametrize("kind", ["coulomb_friction", "motor_gain"])
def test_a_hidden_effect_is_found_and_sized(tmp_path, kind):
    check_found(*find(tmp_path, 20, kind, **FASTEST))


@pytest.mark.parametrize(
    ("recordings", "said"),
    [
        ([], "there are no recordings"),
        ("run1.csv", "expected a list of recordings, not 'run1.csv' alone"),
        (["run1.csv"], "expected recordings, not 'run1.csv'; Recording.read"),
    ],
)
def test_what_is_no_recording_is_refused(recordings, said):
    for use in (diagnose, compare):
        with pytest.raises(UserError, match=said):
            use(load_model(PENDULUM), recordings)


def test_nothing_is_claimed_from_too_few_pieces(tmp_path):
    made = make_recordings(
        PENDULUM, tmp_path, 20, num_recordings=1, seconds=0.6, rate=125.0, kind="coulomb_friction"
    )
    model = load_model(PENDULUM)
    (path,) = (*made.fit, *made.holdout)
    found = diagnose(model, [Recording.read(path, model)])
    assert found.verdict == "unexplained"
    assert not found.selected and not found.drifts
    assert found.sentence.startswith("Too little was recorded to be certain of what is missing")


def test_what_a_timestep_of_0_does_not_need_is_said_and_what_passes_is_printed(tmp_path):
    _, found = find(tmp_path, 20, "coulomb_friction", **FASTEST)
    (first, *others), many = found.candidates, 10 * found.candidates[1:]
    assert first.passes and f"  * {first.named}" in str(
        dataclasses.replace(found, candidates=(*many, first))
    )
    dropped = dataclasses.replace(first, passes=False, why=NIL)
    nothing = dataclasses.replace(
        found, verdict="unexplained", selected=(), ladder=(), candidates=(dropped, *others)
    )
    for said in (nothing.sentence, diagnosis_lead(nothing)):
        assert "would explain much, but not for certain at a timestep of 0" in said


def test_a_clean_model_is_adequate(tmp_path):
    _, found = find(tmp_path, 20, "none", **FASTEST)
    assert found.verdict == "adequate"
    assert found.next_experiment is None
    assert not found.selected
    assert not any(candidate.passes for candidate in found.candidates)
    unseen = {one.effect for one in found.unseen}
    assert not unseen & {"viscous_damping", "coulomb_friction", "motor_gain", "gravity_tilt"}


def test_an_effect_outside_the_catalogue_is_unexplained_and_the_result_is_plain(tmp_path):
    _, found = find(tmp_path, 20, "periodic_disturbance", **FASTEST)
    assert found.verdict == "unexplained"
    assert found.error.unexplained_share > 0.3
    content = found.to_json()
    assert content["format"] == "garat-diagnosis/1"
    assert "NaN" not in json.dumps(content, allow_nan=False)
    assert "unexplained" in str(found)
    assert content["left"] == []  # at no speed, command or position more than at others
    assert "  left: the torque that is still missing follows no simple pattern" in str(found)
    assert "garat ground MODEL DATA... --method gat" in str(found)


@pytest.mark.parametrize(
    ("after", "floor", "share", "explained"),
    [
        (0.1, 0.08, 0.06, True),
        (0.1, 0.06, 0.08, False),
        (0.5, 0.35, 0.36, False),
        (0.04, 0.02, 0.035, True),
    ],
    ids=["near the floor", "above the floor", "much is left", "hardly any is left"],
)
def test_a_gap_is_explained_if_little_is_left_and_that_near_the_floor(
    after, floor, share, explained
):
    assert Errors("", "1", 1.0, after, floor, share, {}).is_explained is explained


def test_what_is_left_of_a_model_that_runs_away_is_held_against_the_spread():
    of = {"metric": "", "horizon": 1.0, "timestep": 0.01, "per_signal": {}}
    errors = Errors.above(0.01, 0.01, before=1e6, after=0.3, **of)
    assert errors.unexplained_share == pytest.approx(0.3, rel=1e-2)
    assert not errors.is_explained


EXPLAINED = Errors("", "1", 1.0, 0.1, 0.08, 0.06, {})
LEFT = dataclasses.replace(EXPLAINED, after=0.5, unexplained_share=0.5)
LOUD = dataclasses.replace(EXPLAINED, above_floor=("qvel.hinge",))
COARSE = dataclasses.replace(EXPLAINED, integrator=0.8)
FOUND = (SimpleNamespace(effect="coulomb_friction"),)


@pytest.mark.parametrize(
    ("adequate", "selected", "measured", "verdict"),
    [
        (True, (), (EXPLAINED,), "adequate"),
        (True, (), (EXPLAINED, EXPLAINED), "adequate"),
        (True, (), (EXPLAINED, LOUD), "unexplained"),
        (True, (), (COARSE,), "unexplained"),
        (False, (), (EXPLAINED,), "unexplained"),
        (False, FOUND, (EXPLAINED,), "missing_effect"),
        (False, FOUND, (EXPLAINED, EXPLAINED, EXPLAINED), "missing_effect"),
        (False, FOUND, (EXPLAINED, LEFT), "unexplained"),
        (False, FOUND, (LEFT, EXPLAINED), "unexplained"),
        (False, FOUND, (EXPLAINED, None, LEFT), "unexplained"),
        (False, FOUND, (EXPLAINED, None, None, LEFT), "unexplained"),
        (False, FOUND, (EXPLAINED, None, None, EXPLAINED), "missing_effect"),
    ],
)
def test_longest_segments_and_a_finer_timestep_have_a_say_in_the_verdict(
    adequate, selected, measured, verdict
):
    assert verdict_of(adequate, selected, HeldOut(*measured)) == verdict


@pytest.mark.slow
@pytest.mark.parametrize("seed", [20, 21])
@pytest.mark.parametrize("kind", DRAWN)
def test_every_kind_that_a_pendulum_shows_is_found(tmp_path, kind, seed):
    check_found(*find(tmp_path, seed, kind))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20, 26))
def test_nothing_is_claimed_on_clean_models(tmp_path, seed):
    assert find(tmp_path, seed, "none")[1].verdict == "adequate"


@pytest.mark.slow
@pytest.mark.parametrize("seed", [20, 21])
@pytest.mark.parametrize("kind", OUTSIDE)
def test_effects_outside_the_catalogue_are_unexplained(tmp_path, kind, seed):
    assert find(tmp_path, seed, kind)[1].verdict == "unexplained"


@pytest.mark.slow
def test_the_free_pendulum_lacks_viscous_damping_and_not_coulomb_friction(tmp_path, shared_data):
    data = free_pendulum(shared_data / "free_pendulum", tmp_path)
    model = load_model(data.model)
    host = model.compile().host.model
    recordings, holdout = (
        [Recording.read(p, host) for p in part] for part in (data.fit, data.holdout)
    )
    found = diagnose(model, recordings, holdout)
    assert found.candidates[0].effect == "viscous_damping"
    assert found.selected[0].effect == "viscous_damping"
    assert "coulomb_friction" not in [candidate.effect for candidate in found.selected]
    assert found.verdict == "missing_effect"


@pytest.mark.slow
def test_the_command_writes_the_diagnosis_and_a_report(tmp_path):
    from garat_jax.diagnosis import run_diagnose

    hidden = make_recordings(PENDULUM, tmp_path / "data", 22, kind="torque_offset", **FASTEST)
    run = RunDirectory.create(tmp_path / "run", {}, "garat diagnose", [])
    found = run_diagnose(PENDULUM, (*hidden.fit, *hidden.holdout), (), run).diagnosis
    assert found.selected[0].effect == "torque_offset"
    assert run.read_json("diagnosis.json")["holdout"] == ["recording_2.csv"]
    assert (run.root / "report.html").is_file()
    assert found.next_experiment is None
