"""The benchmark's secrets do what they say, against closed forms and MuJoCo's own quantities."""

import dataclasses
import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from benchmarks.hidden.bodies import CATALOGUED, SECRETS
from benchmarks.hidden.generate import (
    VISIBLE,
    Case,
    Surveys,
    Truth,
    add_noise,
    draw,
    generate,
    list_cases,
    shuffled,
)
from benchmarks.hidden.measure import experiment, measure
from benchmarks.hidden.robots import ROBOTS
from benchmarks.hidden.score import NOT_YET, aggregate, judge, score
from benchmarks.hidden.secrets import OUTSIDE, SIZES
from garat_jax.diagnosis import Recording, diagnose, load_model
from garat_jax.diagnosis.compare import read_recordings
from garat_jax.diagnosis.findings import Candidate, Estimate, Interval, Named
from garat_jax.effects import CATALOGUE

REPOSITORY = Path(__file__).parent.parent
SCENES = Surveys()
TIME = np.arange(60) / 200.0


def made(kind: str, robot: str, target: str, **parameters):
    return SECRETS[kind](target, parameters), SCENES[robot]


def truth_model(secret, scene) -> mujoco.MjModel:
    spec = mujoco.MjSpec.from_file(str(scene.robot.mjcf))
    secret.change(spec, scene)
    model = spec.compile()
    secret.tune(model)
    return model


def added_force(secret, scene, qvel, model=None) -> np.ndarray:
    """What a secret pushes with at a velocity, at the start pose."""
    model = model or truth_model(secret, scene)
    data = mujoco.MjData(model)
    scene.robot.set_start(model, data)
    data.qvel[:] = qvel
    mujoco.mj_forward(model, data)
    secret.act(model, scene)(data)
    return data.qfrc_applied


def test_the_list_has_every_kind_at_three_sizes_pairs_clean_ones_and_outsiders():
    cases = list_cases(0)
    assert len(CATALOGUED) == 29
    assert len({case.name for case in cases}) == len(cases) == 29 * 3 + 60
    singles = {(c.kinds[0], c.size) for c in cases if c.category == "single"}
    assert singles == {(kind, size) for kind in CATALOGUED for size in SIZES}
    counts = [sum(c.category == name for c in cases) for name in ("pair", "clean", "outside")]
    assert counts == [20, 20, 20]
    assert {c.kinds[0] for c in cases if c.category == "outside"} == set(OUTSIDE)
    assert list_cases(0) == cases != list_cases(1)


@pytest.mark.parametrize("seed", range(5))
def test_every_beginning_of_the_random_order_has_each_category_in_its_share(seed):
    cases = list_cases(seed)
    order = shuffled(cases, seed)
    assert sorted(order) == sorted(cases) and order != cases
    assert order == shuffled(cases, seed)
    for sample in (20, 50, 100):
        for name in ("single", "pair", "clean", "outside"):
            share = sum(case.category == name for case in cases) / len(cases)
            count = sum(case.category == name for case in order[:sample])
            assert abs(count - sample * share) < 2


@pytest.mark.parametrize("kind", SECRETS)
def test_every_secret_can_be_drawn_and_changes_what_is_measured(kind):
    robot = {"contact_friction": "puck", "contact_compliance": "hopper"}.get(kind, "arm2")
    scene, cls = SCENES[robot], SECRETS[kind]
    target = cls.targets(scene)[0]
    rng = np.random.default_rng(0)
    secret = cls(target, cls.draw(scene, target.partition("/")[2], 2.0, rng))
    time, ctrl = experiment(scene, 0, 200.0, 2.5, (0, 0))
    clean, hidden = (measure(scene, some, time, ctrl, 0.0) for some in ((), (secret,)))
    assert hidden.shape == clean.shape == (len(time), 2 * scene.model.nv)
    assert np.isfinite(hidden).all()
    noise = np.repeat(scene.robot.noise, scene.model.nv)
    assert np.max(np.abs(hidden - clean) / noise) > 3.0


def test_forces_follow_their_laws():
    speed = np.asarray([0.7, -1.5])
    drag, scene = made("quadratic_drag", "arm2", "joint/elbow", coefficient=0.2)
    assert added_force(drag, scene, speed) == pytest.approx([0.0, 0.2 * 1.5**2])
    back_emf, _ = made("back_emf", "arm2", "actuator/elbow", coefficient=0.2)
    assert added_force(back_emf, scene, speed) == pytest.approx([0.0, 0.3])
    cogging, _ = made("cogging_torque", "arm2", "joint/elbow", amplitude=0.1, periods=6, phase=0.5)
    assert added_force(cogging, scene, speed) == pytest.approx([0.0, 0.1 * np.sin(0.5)])


def test_dry_friction_has_the_size_of_its_law():
    numbers = {"coulomb": 0.1, "static": 0.3, "velocity": 0.5}
    stribeck, scene = made("stribeck_friction", "arm2", "joint/elbow", **numbers)
    for speed, size in ((0.0, 0.3), (0.5, 0.1 + 0.2 * np.exp(-1)), (50.0, 0.1)):
        model = truth_model(stribeck, scene)
        added_force(stribeck, scene, [0.0, speed], model)
        assert model.dof_frictionloss[1] == pytest.approx(size)


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0)])
def test_dry_frictions_of_a_joint_add_up(order):
    level = {"coulomb": 0.02, "static": 0.02, "velocity": 0.5}
    stribeck, scene = made("stribeck_friction", "arm2", "joint/elbow", **level)
    coulomb, _ = made("coulomb_friction", "arm2", "joint/elbow", torque=0.03)
    sides = {"coulomb_positive": 0.05, "coulomb_negative": 0.05}
    sides |= {"viscous_positive": 0.0, "viscous_negative": 0.0}
    asymmetric, _ = made("asymmetric_friction", "arm2", "joint/elbow", **sides)
    whole, _ = made("coulomb_friction", "arm2", "joint/elbow", torque=0.1)
    time, ctrl = experiment(scene, 0, 200.0, 0.5, (0,))
    together = [(stribeck, coulomb, asymmetric)[i] for i in order]
    clean, added, one = (measure(scene, s, time, ctrl, 0.0) for s in ((), together, (whole,)))
    assert added == pytest.approx(one, abs=1e-6)
    assert np.abs(added - clean).max() > 1e-2


@pytest.mark.parametrize(
    "robot, joint", [("hopper", "knee"), ("hopper", "height"), ("pendulum", "hinge")]
)
def test_a_spring_pulls_to_its_reference_in_radians_or_metres(robot, joint):
    numbers = {"stiffness": 2.0, "reference": -0.3}
    spring, scene = made("joint_stiffness", robot, f"joint/{joint}", **numbers)
    model = truth_model(spring, scene)
    data = mujoco.MjData(model)
    data.qpos[int(model.joint(joint).qposadr[0])] = 0.5
    mujoco.mj_forward(model, data)
    assert data.qfrc_spring[int(model.joint(joint).dofadr[0])] == pytest.approx(-2.0 * 0.8)


def test_gravity_turns_by_roll_and_then_pitch():
    tilt, scene = made("gravity_tilt", "arm2", "world", roll=0.3, pitch=-0.2)
    g = 9.81
    expected = [g * np.cos(0.3) * np.sin(0.2), g * np.sin(0.3), -g * np.cos(0.3) * np.cos(0.2)]
    assert truth_model(tilt, scene).opt.gravity == pytest.approx(expected)


def test_a_payload_and_a_moved_centre_of_mass_have_the_closed_forms_inertia():
    load, scene = made("payload_mass", "pendulum", "body/pole", mass=0.2, x=0.0, y=0.0, z=-0.4)
    before, after = scene.model, truth_model(load, scene)
    gained = after.dof_M0 - before.dof_M0
    assert gained == pytest.approx([0.2 * 0.4**2], rel=1e-4)
    moved, _ = made("com_offset", "pendulum", "body/pole", x=0.0, y=0.0, z=-0.05)
    gained = truth_model(moved, scene).dof_M0 - before.dof_M0
    assert gained == pytest.approx([0.6 * (0.3**2 - 0.25**2)], rel=1e-4)


def test_commands_are_late_slow_or_lost_as_said():
    scene = SCENES["arm2"]
    ctrl = np.zeros((400, 2))
    ctrl[100:] = 1.0
    step = scene.model.opt.timestep
    late = SECRETS["actuator_delay"]("actuator/elbow", {"delay": 20 * step})
    changed = late.command(scene.model, ctrl)
    assert (np.argmax(changed[:, 0] > 0), np.argmax(changed[:, 1] > 0)) == (100, 120)
    between = SECRETS["actuator_delay"]("actuator/elbow", {"delay": 20.25 * step})
    assert between.command(scene.model, ctrl)[119:122, 1] == pytest.approx([0.0, 0.75, 1.0])
    slow = SECRETS["actuator_lag"]("all", {"time_constant": 50 * step})
    changed = slow.command(scene.model, ctrl)
    assert changed[149] == pytest.approx([1 - np.exp(-49.5 / 50)] * 2, abs=1e-4)
    dead = SECRETS["motor_deadband"]("actuator/elbow", {"width": 0.3})
    assert dead.command(scene.model, ctrl)[-1] == pytest.approx([1.0, 0.7])
    curve = SECRETS["motor_curve"]("actuator/elbow", {"saturation": 2.0, "linear": 1.0})
    assert curve.bend(np.asarray([0.5, -1.0, 2.0, 99.0])) == pytest.approx(
        [0.5, -1.0, 2.0 - np.exp(-1), 2.0]
    )


def test_late_sensors_see_the_past_and_encoders_are_off_where_said():
    scene = SCENES["arm2"]
    ctrl = np.ones((len(TIME), 2))
    clean = measure(scene, (), TIME, ctrl, 0.0)
    late = measure(scene, (SECRETS["sensor_delay"]("all", {"delay": 0.01}),), TIME, ctrl, 0.0)
    assert late[2:] == pytest.approx(clean[:-2], abs=1e-12)
    offset = SECRETS["encoder_offset"]("joint/elbow", {"offset": 0.1})
    off = measure(scene, (offset,), TIME, ctrl, 0.0)
    assert off - clean == pytest.approx(np.tile([0, 0.1, 0, 0], (len(TIME), 1)), abs=1e-12)
    scale = SECRETS["encoder_scale"]("joint/elbow", {"scale": 1.2})
    scaled = measure(scene, (scale,), TIME, ctrl, 0.0)
    assert scaled == pytest.approx(clean * [1, 1.2, 1, 1.2])


def test_a_gear_without_play_is_the_plain_joint_and_one_with_play_turns_freely_within_it():
    scene = SCENES["pendulum"]
    ctrl = np.full((len(TIME), 1), 0.5)
    clean = measure(scene, (), TIME, ctrl, 0.0)
    stiff = SECRETS["joint_flexibility"]("joint/hinge", {"stiffness": 3e4, "damping": 5.0})
    assert measure(scene, (stiff,), TIME, ctrl, 0.0) == pytest.approx(clean, abs=2e-3)
    play = SECRETS["backlash"]("joint/hinge", {"gap": 0.2})
    hidden = measure(scene, (play,), TIME, ctrl, 0.0)
    inertia = scene.model.dof_armature[0]
    alone = np.sqrt(2 * 0.1 * inertia / 0.5)  # the rotor crosses half the gap before the link moves
    assert np.all(hidden[: int(0.9 * alone * 200)] == 0)
    assert hidden[-1, 0] > 0.5 * clean[-1, 0]


@pytest.mark.parametrize(
    ("kind", "robot", "target", "parameters"),
    [
        ("actuator_delay", "pendulum", "actuator/motor", {"delay": 0.0123}),
        ("actuator_lag", "pendulum", "actuator/motor", {"time_constant": 0.0151}),
        ("sensor_delay", "pendulum", "all", {"delay": 0.0123}),
        ("backlash", "arm6", "joint/yaw", {"gap": 0.012}),
    ],
)
def test_a_finer_timestep_would_measure_the_same(kind, robot, target, parameters, monkeypatch):
    """Within the sensors' noise; a light link behind a play once shook, and delays were rounded."""
    secret, scene = made(kind, robot, target, **parameters)
    time, ctrl = experiment(scene, 0, 250.0, 1.0, (0, 1))
    found = measure(scene, (secret,), time, ctrl, 0.0)
    monkeypatch.setattr("benchmarks.hidden.measure.finer_timestep", lambda *given: 1 / 128_000)
    finer = measure(scene, (secret,), time, ctrl, 0.0)
    error = np.sqrt(np.mean((found - finer) ** 2, axis=0))
    assert np.all(error < np.repeat(scene.robot.noise, scene.model.nv))
    if robot == "pendulum":
        assert np.all(error < 1e-4 * found.std(axis=0))


@pytest.mark.parametrize("noise", ["white", "coloured", "quantised"])
def test_noise_has_its_size(noise):
    case = Case("clean-00", "clean", (), "medium", (0, 1))
    truth = Truth(case, "arm2", (), 200.0, 4.0, noise, 0.0, ())
    rng = np.random.default_rng(0)
    states = rng.uniform(-1, 1, (20_000, 4))
    error = add_noise(states, truth, rng) - states
    assert error.std(axis=0) == pytest.approx(np.repeat(ROBOTS["arm2"].noise, 2), rel=0.05)


def test_a_set_is_drawn_from_its_seed_and_reads_as_recordings(tmp_path):
    case = next(c for c in list_cases(0) if c.name == "torque_offset-medium")
    truth = draw(case, SCENES, ["pendulum"])
    assert truth == draw(case, SCENES, ["pendulum"])
    short = dataclasses.replace(truth, seconds=1.0)
    paths = generate(short, SCENES["pendulum"], tmp_path)
    recordings = [Recording.read(path, SCENES["pendulum"].model) for path in paths]
    assert [len(r.time) for r in recordings] == [round(truth.rate)] * 4
    assert not any(warning for r in recordings for warning in r.warnings)
    written = json.loads((tmp_path / "truth.json").read_text())
    assert written["secrets"][0]["parameters"] == dict(truth.secrets[0].parameters)


def test_a_secret_that_is_larger_than_the_catalogue_allows_is_drawn_elsewhere():
    case = next(c for c in list_cases(5) if c.name == "air_drag-medium")
    truth = draw(case, SCENES)
    (drag,) = CATALOGUE["air_drag"].parameters()
    assert truth.visibility[0] >= VISIBLE
    assert truth.secrets[0]["coefficient"] <= drag.high


@pytest.mark.slow
def test_two_effects_that_hide_each_other_on_held_out_data_are_both_found(tmp_path):
    """A late motor is most of the gap in what is fitted, gravity in what is held out."""
    truth = draw(Case("late", "single", ("gravity_scale",), "small", (8, 1)), SCENES, ["pendulum"])
    paths = generate(truth, SCENES["pendulum"], tmp_path)
    model = load_model(tmp_path / "pendulum.xml")
    recordings = read_recordings(model, paths)
    found = diagnose(model, recordings[:3], recordings[3:])
    gravity, late = sorted(found.selected, key=lambda c: c.effect != "gravity_scale")
    assert "actuator_delay" in {late.effect, *(n.effect for n in late.indistinguishable_from)}
    (secret,) = truth.secrets
    assert gravity.parameters["scale"].estimate == pytest.approx(secret["scale"], rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "name"),
    [(0, "pair-02-air_drag+load_friction"), (15, "pair-01-encoder_scale+motor_deadband")],
)
def test_two_effects_of_which_neither_leads_by_itself_are_found_together(seed, name, tmp_path):
    truth = draw(next(case for case in list_cases(seed) if case.name == name), SCENES)
    *paths, last = generate(truth, SCENES[truth.robot], tmp_path)
    model = load_model(tmp_path / f"{truth.robot}.xml")
    found = diagnose(model, read_recordings(model, paths), read_recordings(model, [last]))
    assert f"together with {truth.secrets[0].kind}" in found.selected[0].why
    for effect, secret in zip(found.selected, reversed(truth.secrets), strict=True):
        ((parameter, true),) = secret.parameters.items()
        assert (effect.effect, effect.target) == (secret.kind, secret.target)
        assert effect.parameters[parameter].estimate == pytest.approx(true, rel=0.05)


def candidate(effect: str, target: str, alike=(), **parameters) -> Candidate:
    nothing = Interval(0.0, 0.0, 0.0)
    values = {n: Estimate(*numbers, unit="1") for n, numbers in parameters.items()}
    named = tuple(Named(*pair) for pair in alike)
    return Candidate(effect, target, values, 1.0, 0.0, 0.0, nothing, 1.0, named, True, "")


def scored(truth, *selected, verdict="missing_effect"):
    found = SimpleNamespace(
        verdict=verdict,
        selected=selected,
        candidates=selected,
        gap=SimpleNamespace(unexplained_share=0.0),
        seconds=1.0,
    )
    return score(found, truth, SCENES["arm2"].model)


def test_a_category_is_kept_in_a_file_of_its_own():
    command = [sys.executable, "benchmarks/hidden_effects.py", "--seed", "14", "--extend"]
    command += ["--category", "pair", "--sample", "1"]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "--extend would drop 19 recorded sets" in done.stderr


def test_what_no_set_is_asked_has_no_share():
    row = {"case": "pair-00", "status": "done", "category": "pair", "seconds": 1.0, "found": True}
    lines = {line["measure"]: line for line in aggregate([row])}
    assert (lines["clean, nothing claimed"]["value"], lines["pairs, both found"]["count"]) == (
        None,
        1,
    )
    assert "interval" not in lines["clean, nothing claimed"]


def test_several_estimates_of_a_set_do_not_narrow_the_interval():
    estimate = {"parameter": "motor_gain.scale", "true": 1.0, "low": 0.8, "high": 1.2}
    rows = [
        {"case": f"case {i}", "status": "done", "category": "single", "seconds": 1.0,
         "estimates": [{**estimate, "estimate": 1.01 + 0.1 * (i % 5 == 0), "held_close": True}]}
        for i in range(20)
    ]  # fmt: skip
    more = [{**row, "estimates": row["estimates"] * 3} for row in rows]
    one, three = (
        next(line for line in aggregate(some) if line["measure"] == "all estimates within 5 %")
        for some in (rows, more)
    )
    assert (one["count"], three["count"]) == (20, 60)
    assert one["interval"] == three["interval"] == pytest.approx([0.584, 0.919], abs=1e-3)


@pytest.mark.parametrize(("parameter", "covered"), [("phase", True), ("periods", False)])
def test_a_phase_a_turn_off_is_the_same_phase(parameter, covered):
    found = {"true": 3.0, "estimate": -3.28, "low": -3.3, "high": -3.26}
    judged = judge({"parameter": f"cogging_torque.{parameter}", **found})
    assert judged["covered"] == judged["close"] == covered


def test_scores_count_kind_place_and_intervals():
    case = Case("coulomb_friction-small", "single", ("coulomb_friction",), "small", (0, 1))
    secret = SECRETS["coulomb_friction"]("joint/elbow", {"torque": 0.1})
    truth = Truth(case, "arm2", (secret,), 200.0, 4.0, "white", 0.0, (9.0,))
    right = scored(truth, candidate("coulomb_friction", "joint/elbow", torque=(0.104, 0.09, 0.11)))
    judged = judge(right["estimates"][0])
    assert right["ok"] and judged["covered"]
    assert judged["relative_error"] == pytest.approx(0.04)
    alike = [("coulomb_friction", "joint/elbow")]
    honest = scored(truth, candidate("viscous_damping", "joint/shoulder", alike))
    assert honest["ok"] and not honest["alone"] and not honest["estimates"]
    elsewhere = scored(truth, candidate("coulomb_friction", "joint/shoulder"))
    assert elsewhere["kind_first"] and not elsewhere["place_right"]
    other = scored(truth, candidate("motor_gain", "actuator/elbow"))
    assert not other["kind_first"] and other["place_right"]
    delayed = dataclasses.replace(truth, delay=0.02)
    assert scored(delayed, candidate("actuator_delay", "all"), right_one())["ok"]
    assert not scored(truth, candidate("actuator_delay", "all"), right_one())["ok"]
    same = candidate("sensor_delay", "all", [("actuator_delay", "all")])
    assert scored(delayed, same, right_one())["ok"]
    assert not scored(delayed, candidate("sensor_delay", "all"), right_one())["ok"]
    clean = dataclasses.replace(truth, case=case._replace(category="clean"), secrets=())
    assert not scored(clean, right_one())["ok"] and scored(clean)["ok"]


def right_one() -> Candidate:
    return candidate("coulomb_friction", "joint/elbow")


def test_a_kind_that_the_catalogue_lacks_is_no_success():
    base = {"category": "single", "status": "done", "seconds": 1.0}
    rows = [
        base | {"case": "a", "kind_first": True, "place_right": True},
        base | {"case": "b", "status": "error: it failed"},
        {"case": "c", "category": "single", "status": NOT_YET},
    ]
    table = {line["measure"]: line for line in aggregate(rows)}
    first = table["right kind first"]
    assert (first["value"], first["count"], first["met"]) == (0.5, 2, False)
    assert first["short"] == ["b"]
    assert table[NOT_YET]["cases"] == ["c"]
