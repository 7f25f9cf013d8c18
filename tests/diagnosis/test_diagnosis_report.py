"""The diagnosis report: says each verdict in words and holds every part."""

import dataclasses
import re

import numpy as np
import pytest

from garat_jax.diagnosis import Diagnosis, Recording, figures, load_model
from garat_jax.diagnosis.findings import Candidate, Estimate, Experiment, Interval, Named, apart
from garat_jax.diagnosis.hidden import make_recordings
from garat_jax.diagnosis.judge import NO_CERTAIN_LEAD
from garat_jax.diagnosis.leftover import leftover
from garat_jax.diagnosis.localise import BY_CONTACTS, Place
from garat_jax.diagnosis.metric import Errors
from garat_jax.diagnosis.problem import Problem
from garat_jax.diagnosis.report import (
    diagnosis_facts,
    diagnosis_lead,
    diagnosis_sections,
    write_diagnosis,
)
from garat_jax.diagnosis.report_data import warnings_section
from garat_jax.diagnosis.results import Rung
from garat_jax.diagnosis.segments import choose_grid, cut
from garat_jax.diagnosis.simulate import Simulator
from garat_jax.diagnosis.starts import settle
from garat_jax.diagnosis.view import look, repaired
from garat_jax.runs import RunDirectory
from tests import models

NAN = float("nan")
FRICTION = Candidate(
    effect="coulomb_friction",
    target="joint/hinge",
    parameters={"torque": Estimate(0.06, 0.055, 0.065, "N m")},
    share=0.9,
    p_value=1e-9,
    error_after=0.011,
    held_out_gain=Interval(0.2, 0.15, 0.25),
    stability=1.0,
    indistinguishable_from=(Named("viscous_damping", "joint/hinge"),),
    passes=True,
    why="passes every gate",
)
OFFSET = dataclasses.replace(
    FRICTION,
    effect="torque_offset",
    error_after=NAN,
    held_out_gain=Interval(NAN, NAN, NAN),
    indistinguishable_from=(),
    passes=False,
    why="others explain more",
)
MISSING = Diagnosis(
    model="pendulum.xml",
    data=("recording_0.csv",),
    holdout=("recording_1.csv",),
    versions={},
    seconds=1.0,
    verdict="missing_effect",
    error=Errors(
        "error",
        "1",
        0.2,
        0.011,
        0.01,
        0.02,
        {"qpos.hinge": {"before": 0.1, "after": 0.01, "noise_floor": 0.009, "unit": "rad"}},
    ),
    where=(Place("hinge", 0.8, "at any speed", "80 % of it is at hinge"),),
    candidates=(FRICTION, OFFSET),
    selected=(FRICTION,),
    ladder=(Rung(None, 0.21, 0.2), Rung(FRICTION, 0.012, 0.011)),
    next_experiment=Experiment(
        (Named("coulomb_friction", "joint/hinge"), Named("viscous_damping", "joint/hinge")),
        "Swing at two amplitudes.",
    ),
)
ADEQUATE = dataclasses.replace(
    MISSING,
    verdict="adequate",
    candidates=(OFFSET,),
    selected=(),
    ladder=MISSING.ladder[:1],
    where=(),
    next_experiment=None,
)


LONGEST = dataclasses.replace(
    MISSING.error, before=0.9, after=0.09, unexplained_share=0.1, horizon=2.0
)
NOT_ALL = dataclasses.replace(MISSING, verdict="unexplained", longest=LONGEST)


def write(tmp_path, diagnosis) -> str:
    """The page without scripts."""
    path = tmp_path / "pendulum.xml"
    path.write_text(models.PENDULUM)
    made = make_recordings(
        path, tmp_path / "data", 0, num_recordings=2, seconds=1.0, kind="coulomb_friction"
    )
    model = load_model(path)
    host = model.compile(engine="mujoco").host.model
    fit, holdout = ([Recording.read(p, host) for p in paths] for paths in (made.fit, made.holdout))
    run = RunDirectory.create(tmp_path / "run", {}, "garat diagnose pendulum.xml", [])
    page = write_diagnosis(
        run, diagnosis, model.name, diagnosis_sections(diagnosis, model, fit, holdout)
    ).read_text(encoding="utf-8")
    return re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL)


def test_what_was_found_too_is_not_named_as_an_equal():
    equal = dataclasses.replace(FRICTION, effect="viscous_damping", indistinguishable_from=())
    both = dataclasses.replace(MISSING, selected=apart([FRICTION, equal]))
    found = "coulomb_friction at joint/hinge and viscous_damping at joint/hinge"
    assert both.sentence.startswith(f"Missing: {found};")


def test_a_gap_that_shows_over_long_segments_alone_is_said_with_their_length():
    assert NOT_ALL.sentence == (
        "Found coulomb_friction at joint/hinge (or viscous_damping at joint/hinge: these "
        "recordings cannot tell); held-out error over 2 s 0.9 → 0.09, noise floor 0.01; but 10 % "
        "of the error over 2 s stays unexplained."
    )
    assert diagnosis_lead(NOT_ALL).endswith(": 10 % of the error over 2 s stays unexplained.")
    assert [fact.value for fact in diagnosis_facts(NOT_ALL)] == ["90 %", "9 %", "1 %", "10 %"]
    missing = dataclasses.replace(MISSING, longest=LONGEST)
    assert missing.decisive is missing.error
    assert NOT_ALL.to_json()["longest"]["horizon"] == 2.0


def test_a_gap_that_only_a_finer_timestep_shows_is_said_with_it():
    finer = dataclasses.replace(LONGEST, timestep=0.000125, horizon=0.2)
    not_all = dataclasses.replace(NOT_ALL, longest=None, finer=finer)
    assert not_all.decisive is finer
    assert not_all.sentence.endswith(
        "10 % of the error over 0.2 s at a timestep of 0.00013 s stays unexplained."
    )
    missing = dataclasses.replace(MISSING, finer=finer)
    assert missing.decisive is missing.error


def test_a_gap_that_only_what_a_delay_leaves_shows_is_said_with_it():
    late = dataclasses.replace(FRICTION, effect="actuator_delay", target="all")
    on_time = dataclasses.replace(MISSING.error, before=0.015, unexplained_share=0.4)
    both = dataclasses.replace(
        MISSING, verdict="unexplained", selected=(late, FRICTION), on_time=on_time
    )
    assert both.decisive is both.error
    rest = "40 % of the error that the delay alone leaves stays unexplained."
    assert both.sentence.endswith(f"0.2 → 0.011, noise floor 0.01; but {rest}")
    assert diagnosis_lead(both).endswith(f": {rest}")
    fact = diagnosis_facts(both)[-1]
    assert (fact.value, fact.label) == (
        "40 %",
        "of the error that the delay alone leaves stays unexplained",
    )
    error = dataclasses.replace(MISSING.error, above_floor=("qvel.hinge",))
    near = dataclasses.replace(error, before=error.after, unexplained_share=0.4)
    alone = dataclasses.replace(both, selected=(late,), error=error, on_time=near)
    assert alone.sentence.endswith("; but that of qvel.hinge stays well above its noise floor.")
    assert diagnosis_facts(alone)[-1].label == "signal stays above the noise"
    twice = dataclasses.replace(both, selected=(late, late))
    assert twice.sentence.endswith(
        "40 % of the error that the delays alone leave stays unexplained."
    )
    coarse = dataclasses.replace(error, integrator=0.9)
    hidden = dataclasses.replace(
        both, error=coarse, on_time=dataclasses.replace(near, integrator=0.9)
    )
    assert hidden.gap is hidden.error
    far = dataclasses.replace(near, before=0.02, after=0.02, unexplained_share=0.9)
    much = dataclasses.replace(alone, error=dataclasses.replace(error, after=0.02), on_time=far)
    assert much.sentence.endswith(
        "90 % of the error that the delay alone leaves stays unexplained."
    )


def test_long_segments_that_show_no_gap_do_not_decide():
    right = dataclasses.replace(LONGEST, unexplained_share=0.01)
    not_all = dataclasses.replace(NOT_ALL, longest=right)
    assert not_all.decisive is not_all.error
    assert not_all.over == ""
    assert " (over 2 s 0.9 → 0.09), noise floor 0.01;" in not_all.sentence
    assert " of the signals' spread (over 2 s 90 % → 9 %); noise" in diagnosis_lead(not_all)


def test_a_gap_in_single_signals_is_not_said_to_be_0_percent_of_the_error():
    error = dataclasses.replace(
        MISSING.error, after=0.011, unexplained_share=0.0, above_floor=("qvel.hinge",)
    )
    diagnosis = dataclasses.replace(ADEQUATE, verdict="unexplained", error=error)
    assert diagnosis.sentence == (
        "Nothing in the catalogue explains the error: that of qvel.hinge stays well above its "
        "noise floor."
    )
    assert diagnosis_lead(diagnosis).endswith(
        "that of qvel.hinge stays well above its noise floor."
    )
    assert diagnosis_facts(diagnosis)[-1].value == "1"


def test_a_signal_that_stays_loud_beside_what_was_found_is_named():
    of_angle = {"before": 0.1, "after": 0.019, "noise_floor": 0.001, "unit": "rad"}
    error = dataclasses.replace(
        MISSING.error, per_signal={"qpos.hinge": of_angle}, above_floor=("qpos.hinge",)
    )
    diagnosis = dataclasses.replace(MISSING, error=error)
    left = ", but that of qpos.hinge stays at 19 times its own noise floor."
    assert diagnosis.sentence.endswith(left)
    assert diagnosis_lead(diagnosis).endswith(left)
    fact = diagnosis_facts(diagnosis)[-1]
    assert (fact.value, fact.label) == ("1", "signal stays above the noise")
    both = {"qpos.hinge": of_angle, "qvel.hinge": of_angle | {"after": 0.003}}
    error = dataclasses.replace(error, per_signal=both, above_floor=tuple(both))
    assert dataclasses.replace(MISSING, error=error).sentence.endswith(
        ", but those of qpos.hinge (at 19 times) and qvel.hinge (at 3 times) stay above their own "
        "noise floors."
    )


def test_rivals_of_which_none_leads_are_named():
    rival = dataclasses.replace(OFFSET, why=NO_CERTAIN_LEAD)
    other = dataclasses.replace(rival, effect="motor_gain", target="actuator/motor")
    several = dataclasses.replace(NOT_ALL, selected=(), candidates=(rival, other, FRICTION))
    assert several.sentence == (
        "None of torque_offset at joint/hinge, motor_gain at actuator/motor leads for certain, and "
        "none is added: 2 % of the error stays unexplained."
    )
    assert "none of torque offset at joint/hinge, motor gain at actuator/motor explains" in (
        diagnosis_lead(several)
    )
    single = dataclasses.replace(several, candidates=(rival, FRICTION))
    assert single.sentence.startswith("Nothing in the catalogue explains the error")


def test_a_model_that_is_adequate_in_what_was_fitted_only_is_judged_over_long_segments():
    error = dataclasses.replace(MISSING.error, before=0.011, after=0.011, unexplained_share=0.0)
    longest = dataclasses.replace(LONGEST, after=0.9, above_floor=("qpos.hinge",))
    diagnosis = dataclasses.replace(ADEQUATE, verdict="unexplained", error=error, longest=longest)
    assert diagnosis.decisive is longest
    assert diagnosis.sentence.endswith(": 10 % of the error over 2 s stays unexplained.")


def test_page_of_a_missing_effect_has_every_part(tmp_path):
    page = write(tmp_path, MISSING)
    for heading in (
        "How far the model is off",
        "Measured against simulated",
        "Where it fails",
        "The missing torque at hinge",
        "Which effects could explain it",
        "The error falls",
        "What was added",
        "What to record next",
        "How to get these results again",
    ):
        assert f"<h2>{heading}</h2>" in page
    named = "coulomb friction at joint/hinge (or viscous damping at joint/hinge: these recordings"
    assert f"The model lacks {named} cannot tell)." in page
    assert "torque 0.06 (0.055 to 0.065) N m" in page
    assert "these recordings cannot tell it from viscous damping at joint/hinge" in page
    folded = page.partition("<summary>1 effect ruled out before a fit</summary>")[2]
    assert "others explain more" in folded.partition("</details>")[0]
    assert "Swing at two amplitudes." in page
    assert "recording_1.csv, in which the model as it is does worst" in page
    assert "garat diagnose pendulum.xml" in page
    assert "nan" not in page.lower().replace("name", "")


@pytest.mark.parametrize("regime", [BY_CONTACTS, "at any speed"])
def test_what_noise_does_to_contacts_is_said_where_they_are_told(tmp_path, regime):
    place = Place("hinge", 0.8, regime, "80 % of it is at hinge")
    page = write(tmp_path, dataclasses.replace(MISSING, where=(place,)))
    assert ("noise of measured positions changes by much" in page) is (regime == BY_CONTACTS)


def test_one_hopeless_effect_does_not_flatten_the_others():
    hopeless = dataclasses.replace(
        FRICTION, effect="cogging_torque", passes=False, held_out_gain=Interval(-9.0, -30.0, -1.0)
    )
    figure = figures.ranking([FRICTION, hopeless])
    low, high = figure.layout.xaxis.range
    assert 100 * 0.25 < high < 100 * 0.3 and -100 * 0.3 < low < 0
    points = figure.data[0]
    assert list(points.marker.symbol) == ["triangle-left", "circle"]
    assert points.x[0] == pytest.approx(-25.0)
    assert points.customdata[0] == pytest.approx([-900.0, -3000.0, -100.0])
    harmful = dataclasses.replace(FRICTION, held_out_gain=Interval(-0.02, -0.06, 0.0004))
    worse = dataclasses.replace(OFFSET, held_out_gain=Interval(-0.01, -0.03, -0.002))
    figure = figures.ranking([harmful, worse])
    assert figure.layout.xaxis.range[0] < -2.0
    assert set(figure.data[0].marker.symbol) == {"circle"}


def test_page_of_an_adequate_model_promises_no_repair(tmp_path):
    page = write(tmp_path, ADEQUATE)
    assert "The model is adequate" in page
    assert "<h2>What was added</h2>" not in page
    assert "<h2>The error falls</h2>" not in page
    assert "repaired" not in page


def test_page_of_an_unexplained_gap_says_what_is_left_and_offers_to_learn_it(tmp_path):
    place = Place(
        "hinge", 0.4, "at low speed", "40 % of the missing torque is at hinge, at low speed"
    )
    gap = dataclasses.replace(MISSING, verdict="unexplained", left=(place,))
    left = write(tmp_path, gap).partition("<h2>What is left</h2>")[2]
    assert place.evidence in left
    assert "garat ground MODEL DATA... --method gat" in left
    assert f"  left: {place.evidence}" in str(gap)
    assert gap.to_json()["left"][0]["evidence"] == place.evidence
    without = dataclasses.replace(gap, left=())
    assert "left: the torque that is still missing follows no simple pattern" in str(without)
    assert "left:" not in str(MISSING)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (
            {},
            "falls from 20 % to 1.1 % of the signals' spread; "
            "noise and the integrator alone make 1 %.",
        ),
        (
            {"verdict": "unexplained"},
            "these recordings cannot tell), but that is not all",
        ),
        (
            {"verdict": "unexplained", "selected": ()},
            "Something is missing that no effect in the catalogue explains: 2 % of the error",
        ),
    ],
)
def test_lead_says_the_verdict(changes, said):
    assert said in diagnosis_lead(dataclasses.replace(MISSING, **changes))


def test_more_warnings_than_a_lead_has_are_listed():
    warnings = tuple(f"run{i}.csv: 1 gap" for i in range(5))
    lead = diagnosis_lead(dataclasses.replace(MISSING, warnings=warnings))
    named = "; ".join(warnings[:3])
    assert lead.endswith(f" Warnings: {named}; and 2 more, below.")
    (section,) = warnings_section(warnings, 3)
    assert section.text.splitlines() == [f"- {warning}" for warning in warnings]
    assert warnings_section(warnings[:3], 3) == []


def what_is_left(model, recordings, selected):
    grid = choose_grid(recordings, 0.002)
    simulator = Simulator(repaired(model, selected), (), grid)
    segments = cut(recordings, grid, 2.0)
    everywhere = np.ones(len(segments.start), bool)
    problem = Problem(simulator, segments, everywhere, grid.sample)
    settled = settle(problem, simulator.base, segments.start)
    return leftover(problem, settled, recordings, model.compile(engine="mujoco").host.model)


def test_what_a_repair_explains_is_not_left(tmp_path):
    path = tmp_path / "pendulum.xml"
    path.write_text(models.PENDULUM)
    made = make_recordings(path, tmp_path / "data", 0, 2, seconds=4.0, kind="coulomb_friction")
    model = load_model(path)
    recordings = [Recording.read(file, model) for file in (*made.fit, *made.holdout)]
    size = Estimate(made.parameters["torque"], 0.0, 1.0, "N m")
    found = dataclasses.replace(FRICTION, parameters={"torque": size})
    views = [look(model, recordings, (1,), chosen) for chosen in ((), (found,))]
    for played in zip(views[1].before, views[1].after, strict=True):
        spreads = [p.segments.spread for p in played]
        np.testing.assert_array_equal(*spreads)  # or errors before and after do not compare
    places = [what_is_left(model, recordings, chosen) for chosen in ((), (found,))]
    shares = [{p.regime: p.share for p in some} for some in places]
    friction = "against or with the motion"
    assert shares[0][friction] > 0.5
    assert shares[1].get(friction, 0.0) < 0.3 * shares[0][friction]


def test_repair_adds_the_effects_with_their_estimates(tmp_path):
    path = tmp_path / "pendulum.xml"
    path.write_text(models.PENDULUM)
    (effect,) = repaired(load_model(path), (FRICTION,)).effects
    assert (effect.kind, effect.target, effect.torque) == ("coulomb_friction", "joint/hinge", 0.06)
