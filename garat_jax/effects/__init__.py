"""The catalogue of physical effects."""

from garat_jax.effects.actuator import ActuatorDelay, MotorGain
from garat_jax.effects.base import Effect, ModelView, Parameter, parameter, unit_at
from garat_jax.effects.body import PayloadMass
from garat_jax.effects.joint import CoulombFriction, RotorInertia, TorqueOffset, ViscousDamping
from garat_jax.effects.world import GravityScale

CATALOGUE: dict[str, type[Effect]] = {
    "viscous_damping": ViscousDamping,
    "coulomb_friction": CoulombFriction,
    "torque_offset": TorqueOffset,
    "rotor_inertia": RotorInertia,
    "motor_gain": MotorGain,
    "actuator_delay": ActuatorDelay,
    "payload_mass": PayloadMass,
    "gravity_scale": GravityScale,
}

__all__ = [
    "CATALOGUE",
    "ActuatorDelay",
    "CoulombFriction",
    "Effect",
    "GravityScale",
    "ModelView",
    "MotorGain",
    "Parameter",
    "PayloadMass",
    "RotorInertia",
    "TorqueOffset",
    "ViscousDamping",
    "parameter",
    "unit_at",
]
