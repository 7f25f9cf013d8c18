"""The catalogue of physical effects."""

from garat_jax.effects.actuator import ActuatorDelay, MotorGain
from garat_jax.effects.base import Effect, ModelView, Parameter, parameter, unit_at
from garat_jax.effects.body import AirDrag, ComOffset, PayloadMass
from garat_jax.effects.contact import ContactCompliance, ContactFriction
from garat_jax.effects.joint import CoulombFriction, RotorInertia, TorqueOffset, ViscousDamping
from garat_jax.effects.sensor import EncoderOffset, EncoderScale, SensorDelay
from garat_jax.effects.world import GravityScale, GravityTilt

CATALOGUE: dict[str, type[Effect]] = {
    "viscous_damping": ViscousDamping,
    "coulomb_friction": CoulombFriction,
    "torque_offset": TorqueOffset,
    "rotor_inertia": RotorInertia,
    "motor_gain": MotorGain,
    "actuator_delay": ActuatorDelay,
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

__all__ = [
    "CATALOGUE",
    "ActuatorDelay",
    "AirDrag",
    "ComOffset",
    "ContactCompliance",
    "ContactFriction",
    "CoulombFriction",
    "Effect",
    "EncoderOffset",
    "EncoderScale",
    "GravityScale",
    "GravityTilt",
    "ModelView",
    "MotorGain",
    "Parameter",
    "PayloadMass",
    "RotorInertia",
    "SensorDelay",
    "TorqueOffset",
    "ViscousDamping",
    "parameter",
    "unit_at",
]
