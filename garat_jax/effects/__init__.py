"""The catalogue of physical effects."""

from collections.abc import Iterable

from garat_jax.effects.actuator import BackEmf, MotorCurve, MotorGain, TorqueSaturation
from garat_jax.effects.base import (
    Effect,
    ModelView,
    Parameter,
    Suggestion,
    are_exclusive,
    check_together,
    parameter,
)
from garat_jax.effects.body import AirDrag, ComOffset, PayloadMass
from garat_jax.effects.command import ActuatorDelay, ActuatorLag, MotorDeadband
from garat_jax.effects.contact import ContactCompliance, ContactFriction
from garat_jax.effects.friction import (
    AsymmetricFriction,
    CoulombFriction,
    LoadFriction,
    QuadraticDrag,
    StribeckFriction,
    ViscousDamping,
)
from garat_jax.effects.joint import CoggingTorque, JointStiffness, RotorInertia, TorqueOffset
from garat_jax.effects.sensor import EncoderOffset, EncoderScale, SensorDelay
from garat_jax.effects.transmission import Backlash, JointFlexibility
from garat_jax.effects.units import parameter_at, unit_at
from garat_jax.effects.world import GravityScale, GravityTilt

CATALOGUE: dict[str, type[Effect]] = {
    "motor_deadband": MotorDeadband,
    "actuator_lag": ActuatorLag,
    "actuator_delay": ActuatorDelay,
    "motor_curve": MotorCurve,
    "motor_gain": MotorGain,
    "back_emf": BackEmf,
    "torque_saturation": TorqueSaturation,
    "viscous_damping": ViscousDamping,
    "coulomb_friction": CoulombFriction,
    "asymmetric_friction": AsymmetricFriction,
    "stribeck_friction": StribeckFriction,
    "load_friction": LoadFriction,
    "quadratic_drag": QuadraticDrag,
    "joint_stiffness": JointStiffness,
    "torque_offset": TorqueOffset,
    "cogging_torque": CoggingTorque,
    "rotor_inertia": RotorInertia,
    "backlash": Backlash,
    "joint_flexibility": JointFlexibility,
    "payload_mass": PayloadMass,
    "com_offset": ComOffset,
    "air_drag": AirDrag,
    "gravity_scale": GravityScale,
    "gravity_tilt": GravityTilt,
    "contact_friction": ContactFriction,
    "contact_compliance": ContactCompliance,
    "encoder_scale": EncoderScale,
    "encoder_offset": EncoderOffset,
    "sensor_delay": SensorDelay,
}
"""Every kind by its name, in the order in which a command passes: laws see what came before."""
LAST_BEFORE_OWN = "torque_saturation"
"""The last kind that changes commands; a user's own follow it, before what looks at torques."""


def in_order(effects: Iterable[Effect]) -> tuple[Effect, ...]:
    """Return effects as they act one after the other: in the catalogue's order.

    A card may list them as they were found. Those of one kind, and a user's own, stay as listed.
    """
    place = {kind: float(number) for number, kind in enumerate(CATALOGUE)}
    own = place[LAST_BEFORE_OWN] + 0.5
    return tuple(sorted(effects, key=lambda effect: place.get(effect.kind, own)))


__all__ = [
    "CATALOGUE",
    "ActuatorDelay",
    "ActuatorLag",
    "AirDrag",
    "AsymmetricFriction",
    "BackEmf",
    "Backlash",
    "CoggingTorque",
    "ComOffset",
    "ContactCompliance",
    "ContactFriction",
    "CoulombFriction",
    "Effect",
    "EncoderOffset",
    "EncoderScale",
    "GravityScale",
    "GravityTilt",
    "JointFlexibility",
    "JointStiffness",
    "LoadFriction",
    "ModelView",
    "MotorCurve",
    "MotorDeadband",
    "MotorGain",
    "Parameter",
    "PayloadMass",
    "QuadraticDrag",
    "RotorInertia",
    "SensorDelay",
    "StribeckFriction",
    "Suggestion",
    "TorqueOffset",
    "TorqueSaturation",
    "ViscousDamping",
    "are_exclusive",
    "check_together",
    "in_order",
    "parameter",
    "parameter_at",
    "unit_at",
]
