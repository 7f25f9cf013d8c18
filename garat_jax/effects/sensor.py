"""Effects of sensors: what they report is not what is; the motion stays as it is.

Positions and velocities that policies and measurements see are `dynamics.sensed`. Servos inside
the model (position actuators) and MuJoCo's own `sensordata` keep the truth.
"""

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct

from garat_jax.effects.at_joint import AT_JOINT, BIASES, GAINS
from garat_jax.effects.base import Effect, parameter
from garat_jax.effects.command import ActuatorDelay
from garat_jax.effects.elements import as_written, element_id, quaternions


@struct.dataclass
class EncoderScale(Effect):
    """An encoder reports angle and speed in another unit: q_sensed = scale * q.

    Shows as amplitudes and speeds that are off by the same factor while the frequency of a swing
    is right. Identified by motion at a known amplitude, such as from stop to stop, or by gravity.
    Typical: a wrong gear ratio or pulse count gives a plain fraction; a slipping belt or a worn
    potentiometer 0.98 to 1.02 (manufacturers' linearity of 1 to 2 %).
    """

    kind: ClassVar[str] = "encoder_scale"
    elements: ClassVar[tuple[str, ...]] = ("joint",)
    law: ClassVar[str] = "q_sensed = s·q, q̇_sensed = s·q̇"
    identified_by: ClassVar[str] = "large swings under gravity; motion from stop to stop"
    senses: ClassVar[bool] = True

    scale: jax.Array = parameter(
        1.0,
        unit="1",
        low=0.1,
        high=10.0,
        scale=0.02,
        source="A gear ratio or pulse count that is wrong by up to ten",
    )

    def sense(self, host: mujoco.MjModel, state: Any, memory: Any) -> Any:
        """Scale the joint's position and velocity."""
        del memory
        joint = host.joint(self.name)
        return state._replace(
            qpos=state.qpos.at[joint.qposadr[0]].multiply(self.scale),
            qvel=state.qvel.at[joint.dofadr[0]].multiply(self.scale),
        )


@struct.dataclass
class EncoderOffset(Effect):
    """An encoder's zero is elsewhere: q_sensed = q + offset.

    Shows as rest poses that are shifted although the speeds fit. In one pose it cannot be told
    from a constant torque; large swings under gravity tell them apart, because gravity depends
    on the true angle. Typical: 0.01 to 0.1 rad after a homing against a stop by hand.
    """

    kind: ClassVar[str] = "encoder_offset"
    elements: ClassVar[tuple[str, ...]] = ("joint",)
    law: ClassVar[str] = "q_sensed = q + δ"
    identified_by: ClassVar[str] = "rest poses and large swings under gravity"
    senses: ClassVar[bool] = True

    offset: jax.Array = parameter(
        0.0,
        unit="rad",
        low=-3.2,
        high=3.2,
        scale=0.01,
        source="Half a turn either way covers every zero of a rotary encoder",
    )

    def sense(self, host: mujoco.MjModel, state: Any, memory: Any) -> Any:
        """Shift the joint's position."""
        del memory
        address = host.joint(self.name).qposadr[0]
        return state._replace(qpos=state.qpos.at[address].add(self.offset))

    def export(self, spec: mujoco.MjSpec) -> str:
        """Count the joint's position from the encoder's zero, by its `ref`.

        Limits, springs and key frames move along, so that they stay where they are on the machine,
        and so does the angle that a servo takes.
        """
        host = spec.copy().compile()
        index, joint = element_id(host, "joint", self.name), spec.joint(self.name)
        at_joint = np.isin(host.actuator_trntype, AT_JOINT)
        driving = np.flatnonzero(at_joint & (host.actuator_trnid[:, 0] == index))
        at_tendons = host.wrap_type == mujoco.mjtWrap.mjWRAP_JOINT
        if np.any(at_tendons & (host.wrap_objid == index)):
            return f"{super().export(spec)}: a tendon measures it"
        gains, biases = host.actuator_gaintype[driving], host.actuator_biastype[driving]
        if not (np.isin(gains, GAINS).all() and np.isin(biases, BIASES).all()):
            return f"{super().export(spec)}: an actuator neither fixed nor affine measures it"
        offset = as_written(spec, joint, float(self.offset))
        joint.ref, joint.springref = joint.ref + offset, joint.springref + offset
        if host.jnt_limited[index]:
            joint.range = joint.range + offset
        for i in driving:
            actuator, length = spec.actuators[i], host.actuator_gear[i, 0] * float(self.offset)
            if actuator.inheritrange:
                actuator.ctrlrange = host.actuator_ctrlrange[i]
                actuator.actrange = host.actuator_actrange[i]
                actuator.inheritrange = 0.0
            if actuator.gaintype == mujoco.mjtGain.mjGAIN_AFFINE:
                actuator.gainprm[0] -= actuator.gainprm[1] * length
            if actuator.biastype == mujoco.mjtBias.mjBIAS_AFFINE:
                actuator.biasprm[0] -= actuator.biasprm[1] * length
        for key in spec.keys:
            if len(key.qpos):
                key.qpos[host.jnt_qposadr[index]] += float(self.offset)
        return ""


@struct.dataclass
class SensorDelay(Effect):
    """All sensors report the state of some time ago: filters, buses, a slow control loop.

    States are noted after every control step and interpolated linearly between, so the law is
    continuous in the delay; before the first state the mechanism stood as in it. Shows in a
    policy's loop as overshoot and limit cycles. A recording of commands and sensors shows only
    the sum of this and the commands' delay: the start of time is nobody's business. A second,
    faster sensor or a push by hand tells them apart. Typical: 1 to 40 ms (Tan et al. 2018).
    """

    kind: ClassVar[str] = "sensor_delay"
    elements: ClassVar[tuple[str, ...]] = ("all",)
    law: ClassVar[str] = "q_sensed(t) = q(t − d), q̇_sensed(t) = q̇(t − d)"
    identified_by: ClassVar[str] = "step trains in the command, and a second sensor"
    senses: ClassVar[bool] = True
    notes: ClassVar[bool] = True

    delay: jax.Array = parameter(
        0.0,
        unit="s",
        low=0.0,
        high=0.1,
        scale=5e-3,
        source="Tan et al. 2018 (arXiv 1804.10332): latencies of 0 to 40 ms, with room to spare",
    )

    @classmethod
    def targets(cls, host: mujoco.MjModel) -> list[str]:
        """List `all` where there are commands: without them nothing tells what time it is."""
        return ["all"] if host.nu else []

    def init(self, host: mujoco.MjModel):
        """Return ages [s] of past states, newest first, these [rows, nq + nv], whether any came."""
        rows = int(np.ceil(self.parameters()[0].high / host.opt.timestep)) + 2
        ages = jnp.arange(rows) * host.opt.timestep
        return ages, jnp.zeros((rows, host.nq + host.nv)), jnp.zeros((), bool)

    def note(self, host: mujoco.MjModel, state: Any, seconds: float, memory: Any) -> Any:
        """Push the state; the first one fills the past."""
        del host
        ages, past, started = memory
        newest = jnp.concatenate([state.qpos, state.qvel]).astype(past.dtype)
        past = jnp.where(started, jnp.roll(past, 1, axis=0).at[0].set(newest), newest)
        ages = jnp.where(started, (jnp.roll(ages, 1) + seconds).at[0].set(0.0), ages)
        return ages, past, jnp.ones((), bool)

    def sense(self, host: mujoco.MjModel, state: Any, memory: Any) -> Any:
        """Read the state of `delay` seconds ago."""
        ages, past, _ = memory
        late = jax.vmap(lambda values: jnp.interp(self.delay, ages, values), 1)(past)
        qpos, qvel = late[: host.nq], late[host.nq :]
        for start in quaternions(host):
            part = slice(start, start + 4)
            qpos = qpos.at[part].divide(jnp.linalg.norm(qpos[part]))
        return state._replace(
            qpos=qpos.astype(state.qpos.dtype), qvel=qvel.astype(state.qvel.dtype)
        )

    def as_replayed(self) -> Effect:
        """Return late commands: seen from sensors that are late, the commands are."""
        return ActuatorDelay(target="all", delay=self.delay)
