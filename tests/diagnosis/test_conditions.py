"""What all conditions share is found once, and what one adds is that condition's own."""

import dataclasses

import mujoco
import numpy as np
import pytest

from garat_jax.cli import main
from garat_jax.diagnosis.conditions import diagnose_conditions
from garat_jax.diagnosis.measurements import Recording
from garat_jax.diagnosis.model_card import Model
from garat_jax.effects import CATALOGUE
from tests import models

FEW = {kind: CATALOGUE[kind] for kind in ("viscous_damping", "torque_offset", "payload_mass")}
MODEL = Model("pendulum", __file__, __file__, models.spec(models.PENDULUM))
TIME = np.arange(750) * 0.004


def record(pull: float, seed: int) -> Recording:
    """Step C MuJoCo with more damping than the model has, and with a cable that pulls [N m]."""
    rng = np.random.default_rng(seed)
    spec = models.spec(models.PENDULUM)
    spec.joint("hinge").damping[0] += 0.02
    spec.option.timestep /= 16
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[0] = 0.8
    ctrl = rng.uniform(-1, 1, 8)[(TIME / 0.4).astype(int)] + 0.5 * np.sin(9 * TIME)
    states = []
    for command in ctrl:
        states.append([data.qpos[0], data.qvel[0]])
        data.ctrl[0], data.qfrc_applied[0] = command, pull
        mujoco.mj_step(model, data, round(0.004 / model.opt.timestep))
    states = np.asarray(states) + 1e-3 * rng.normal(size=(len(TIME), 2)) * [1.0, 10.0]
    return Recording(
        name=f"pull {pull}, {seed}",
        time=TIME,
        qpos=states[:, :1],
        qvel=states[:, 1:],
        ctrl=ctrl[:, None],
        torque={},
        velocity_measured=True,
        spans=((0, len(TIME)),),
        warnings=(),
    )


def test_damping_is_shared_and_the_pull_is_the_conditions_own():
    model = dataclasses.replace(MODEL, catalogue=FEW)
    base = [record(0.0, seed) for seed in range(3)]
    found = diagnose_conditions(model, base, {"with cable": [record(0.1, s) for s in (3, 4, 5)]})
    (damping,) = found.selected
    assert damping.effect == "viscous_damping"
    assert damping.parameters["coefficient"].estimate == pytest.approx(0.02, rel=0.05)
    (pull,) = found.conditions["with cable"].selected
    assert pull.effect == "torque_offset"
    assert pull.parameters["torque"].estimate == pytest.approx(0.1, rel=0.05)
    content = found.to_json()["conditions"]["with cable"]
    assert content["selected"][0]["effect"] == "torque_offset"
    assert content["conditions"] == {}
    assert "Under the condition with cable, with the above: Missing: torque_offset" in str(found)


def test_a_condition_without_a_file_is_refused(tmp_path, capsys):
    model, data = tmp_path / "p.xml", tmp_path / "d.csv"
    model.write_text(models.PENDULUM)
    data.write_text("")
    for word, said in (("loaded", "NAME=FILE"), ("loaded=none.csv", "there is no file none.csv")):
        assert main(["diagnose", str(model), str(data), "--condition", word]) == 2
        assert said in capsys.readouterr().err
