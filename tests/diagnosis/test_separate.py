"""What separates effects that look alike, and that nothing does where that is so."""

import dataclasses

import mujoco
import pytest

from garat_jax.diagnosis.findings import Named
from garat_jax.diagnosis.separate import EXPERIMENTS, next_experiment
from garat_jax.effects import CATALOGUE
from tests import models
from tests.diagnosis.test_diagnosis_report import FRICTION

SECOND = """<body pos="0 1 0.2"><freejoint/><geom name="second" size="0.1"/></body></worldbody>"""


def ask(first: Named, *others: Named, text: str = models.SLIDER) -> str:
    candidate = dataclasses.replace(
        FRICTION, effect=first.effect, target=first.target, indistinguishable_from=others
    )
    found = next_experiment([candidate], mujoco.MjModel.from_xml_string(text))
    assert found and found.separates == (first, *others)
    return found.how


@pytest.mark.parametrize(
    ("one", "other", "said"),
    [
        ("motor_gain", "payload_mass", "known mass attached"),
        ("viscous_damping", "quadratic_drag", "the same motion at two amplitudes"),
        ("actuator_delay", "rotor_inertia", "a train of steps"),
    ],
)
def test_known_pairs_have_their_experiment(one, other, said):
    pair = Named(one, "here"), Named(other, "there")
    assert said in ask(*pair)
    assert ask(*pair) == ask(*reversed(pair))


@pytest.mark.parametrize("kinds", EXPERIMENTS, ids=lambda kinds: " and ".join(sorted(kinds)))
def test_every_experiment_tells_two_kinds_of_the_catalogue_apart(kinds):
    one, other = kinds
    assert {one, other} <= {*CATALOGUE}
    assert ask(Named(one, "here"), Named(other, "there")) == EXPERIMENTS[kinds]


@pytest.mark.parametrize("more", [False, True])
def test_one_contact_cannot_be_told_from_its_other_side(more):
    text = models.SLIDER.replace("</worldbody>", SECOND) if more else models.SLIDER
    pair = Named("contact_friction", "geom/ball"), Named("contact_friction", "geom/floor")
    how = ask(*pair, text=text)
    assert ("touch nothing but each other" in how) is not more


def test_of_other_pairs_nothing_untrue_is_promised():
    pair = Named("torque_offset", "joint/hinge"), Named("cogging_torque", "joint/hinge")
    how = ask(*pair, text=models.PENDULUM)
    assert "no experiment is known" in how
    assert "--separate torque_offset@joint/hinge cogging_torque@joint/hinge" in how
    assert "garat plan" not in ask(*pair, text=models.TUMBLER)  # no commands


def test_what_no_experiment_tells_apart_is_said_once():
    kinds = ("cogging_torque", "viscous_damping", "back_emf", "joint_stiffness", "encoder_offset")
    others = [Named(kind, "joint/hinge") for kind in (*kinds, "rotor_inertia")]
    how = ask(Named("torque_offset", "joint/hinge"), *others, text=models.PENDULUM)
    assert how.startswith("swing widely under gravity")
    assert how.count("no experiment is known") == 1
    assert "from cogging_torque at joint/hinge or viscous_damping" in how
    assert "joint_stiffness at joint/hinge or 1 more; garat plan" in how


def test_of_what_was_not_fitted_nothing_is_to_be_told_apart():
    late = Named("sensor_delay", "all")
    unfitted = dataclasses.replace(
        FRICTION, effect="actuator_delay", target="actuator/motor", error_after=float("nan"),
        indistinguishable_from=(late,),
    )  # fmt: skip
    host = mujoco.MjModel.from_xml_string(models.PENDULUM)
    assert next_experiment([unfitted], host) is None
