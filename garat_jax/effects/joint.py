"""Effects at a joint beside friction: inertia, constant torque, spring, cogging."""

import math
from collections.abc import Mapping
from typing import ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from scipy import optimize, signal

from garat_jax.effects.actuator import can_bias, is_limited, make_affine
from garat_jax.effects.at_joint import at_dof, drivers, small_torque
from garat_jax.effects.base import Effect, ModelView, Suggestion, parameter
from garat_jax.effects.elements import as_written, element_id
from garat_jax.effects.most import follow_most, median_distance

BINS_PER_PERIOD = 4
"""Bins of the angle in the shortest period of a ripple."""
MOST_BINS = 2**20
"""Bins of the angle at most; a joint that turns for long shows no shorter periods than these do."""
FINER = 4
"""Points of the spectrum for each that the range of the angle resolves."""
SMOOTH = 3
"""Degree of the polynomial of the angle that stands for other laws beside a ripple."""
CLEAR = 0.1
"""Torque that a line rises by over the position's spread, relative to the torques' median distance
from theirs, below which it is lost among them."""
SLOW = (0.5, 0.75, 1.0, 1.25, 1.5, 1.75, 2.0)
"""Periods in the range of the angle that are tried for a slow ripple: fewer are a line, more stand
out of the spectrum."""
FEWEST = 20
"""Samples from which a slow ripple is told."""
PEAKS = 2
"""Fast ripples that each torque suggests: noise of fast motion may stand out more than a small
one."""


@struct.dataclass
class RotorInertia(Effect):
    """Inertia of the rotor as felt behind the gear: it adds to the joint's inertia.

    Shows as a response that is slower in both directions, in proportion to acceleration.
    Typical: gear ratio squared times 1e-6 to 1e-4 kg m².
    """

    kind: ClassVar[str] = "rotor_inertia"
    elements: ClassVar[tuple[str, ...]] = ("joint",)
    law: ClassVar[str] = "M_jj ← M_jj + I (MuJoCo's armature)"
    identified_by: ClassVar[str] = "fast reversals; chirps"

    inertia: jax.Array = parameter(
        0.0,
        unit="kg m²",
        low=0.0,
        high=10.0,
        scale=1e-3,
        source="MuJoCo Menagerie: armature of published robots is 0 to a few kg m²",
    )

    def fields(self, model: ModelView) -> dict[str, jax.Array]:
        """Add to the joint's native armature."""
        dofs = model.dofs(self.name)
        return {"dof_armature": model["dof_armature"].at[dofs].add(self.inertia)}

    def export(self, spec: mujoco.MjSpec) -> str:
        """Add to the joint's armature."""
        spec.joint(self.name).armature += float(self.inertia)
        return ""


@struct.dataclass
class TorqueOffset(Effect):
    """A constant torque at a joint: a spring balancer, a cable, a motor driver's bias.

    Shows as an equilibrium that is shifted, the same for both directions of motion.
    """

    kind: ClassVar[str] = "torque_offset"
    elements: ClassVar[tuple[str, ...]] = ("joint",)
    law: ClassVar[str] = "τ = τ₀"
    identified_by: ClassVar[str] = "rest poses; the mean of slow motion in both directions"
    acts: ClassVar[bool] = True

    torque: jax.Array = parameter(
        0.0,
        unit="N m",
        low=-100.0,
        high=100.0,
        scale=1e-2,
        source="Within the rated torque of table-top and legged robots' joints",
    )

    def apply(self, model: ModelView, state, ctrl: jax.Array, memory):
        """Add the torque as a generalised force."""
        joint = element_id(model.host, "joint", self.name)
        return ctrl, at_dof(model.host, joint, self.torque, ctrl.dtype), memory

    def export(self, spec: mujoco.MjSpec) -> str:
        """Add to the bias of an unlimited actuator at an unlimited joint, if there is one."""
        joint, host = spec.joint(self.name), spec.copy().compile()
        is_clamped = is_limited(joint.actfrclimited, joint.actfrcrange)
        for index in drivers(host, element_id(host, "joint", self.name)):
            actuator = spec.actuators[index]
            if not is_clamped and can_bias(actuator):
                make_affine(actuator)
                actuator.biasprm[0] += float(self.torque) / actuator.gear[0]
                return ""
        return f"{self.target} has no unlimited actuator whose bias could be the constant torque"


@struct.dataclass
class JointStiffness(Effect):
    """A spring at the joint that the model lacks: a cable, a hose, a counterbalance, a flexure.

    Torque −k·(q − q_ref), where `reference` is the place on the joint's own scale (that of qpos)
    at which this spring pulls nowhere. With a spring that the model has they are one linear
    spring. Shows as a torque against position, and as an oscillation that is faster than the
    model's. Typical: 0.01 to 10 N m/rad for cables and hoses at an arm's joints.
    """

    kind: ClassVar[str] = "joint_stiffness"
    elements: ClassVar[tuple[str, ...]] = ("joint",)
    needs: ClassVar[str] = "a hinge or slide joint whose own spring, if any, is linear"
    law: ClassVar[str] = "τ = −k·(q − q_ref) (MuJoCo's stiffness and springref)"
    identified_by: ClassVar[str] = "slow motion over the joint's whole range; rest poses"

    stiffness: jax.Array = parameter(
        0.0,
        unit="N m/rad",
        low=0.0,
        high=1e4,
        scale=1e-2,
        source="MuJoCo Menagerie: joint springs of published robots are at most a few thousand",
    )
    reference: jax.Array = parameter(
        0.0, unit="rad", low=-10.0, high=10.0, scale=0.1, source="Within a few turns of the joint"
    )

    @classmethod
    def fits(cls, host: mujoco.MjModel, element: str, name: str) -> bool:
        """Say whether the joint is a hinge or slide whose own spring, if any, is linear."""
        if not super().fits(host, element, name):
            return False
        return not np.any(host.jnt_stiffnesspoly[element_id(host, "joint", name)])

    @classmethod
    def suggested(
        cls, position: np.ndarray, torque: np.ndarray, rests: np.ndarray
    ) -> Suggestion | None:
        """Return the spring that the missing torque follows most of the time.

        Far from its reference a spring is a constant torque first, which a small step at a
        reference of 0 does not show. A slope that is lost in the scatter suggests nothing, nor does
        one whose torque has no end within the bounds of the reference: that is a constant torque.
        """
        del rests
        level, (slope,) = follow_most(position[:, None], torque)
        stiffness, reference = cls.parameters()
        is_clear = -slope * np.std(position) > CLEAR * median_distance(torque)
        if not is_clear or -slope > stiffness.high:
            return None
        middle = -level / slope
        if not reference.low < middle < reference.high:
            return None
        return Suggestion(({"stiffness": float(-slope), "reference": float(middle)},), 1)

    def fields(self, model: ModelView) -> dict[str, jax.Array]:
        """Put both springs into one."""
        joint = element_id(model.host, "joint", self.name)
        place = model.host.jnt_qposadr[joint]
        stiffness, reference = model["jnt_stiffness"], model["qpos_spring"]
        total = stiffness[joint] + self.stiffness
        pull = stiffness[joint] * reference[place] + self.stiffness * self.reference
        changed = jnp.asarray(self.stiffness) != 0.0
        middle = jnp.where(changed, pull / jnp.where(changed, total, 1.0), reference[place])
        return {
            "jnt_stiffness": stiffness.at[joint].set(total),
            "qpos_spring": reference.at[place].set(middle),
        }

    def export(self, spec: mujoco.MjSpec) -> str:
        """Put both springs into one; tendons keep the lengths at which they rest."""
        joint = spec.joint(self.name)
        own, added = float(joint.stiffness[0]), float(self.stiffness)
        if added:
            lengths = spec.copy().compile().tendon_lengthspring
            for tendon, length in zip(spec.tendons, lengths, strict=True):
                tendon.springlength = length  # else the compiler measures it at the new springref
            pull = own * joint.springref + added * as_written(spec, joint, float(self.reference))
            joint.springref = pull / (own + added)
            joint.stiffness[0] = own + added
        return ""


@struct.dataclass
class CoggingTorque(Effect):
    """A torque that repeats with the angle: magnets against slots, gear teeth, a bent shaft.

    τ = A·sin(n·q + φ) with n periods in a turn of the joint; it takes no energy over a turn.
    Shows as ripple in slow motion that keeps its place when speed and direction change. Typical:
    1 to 5 % of a motor's rated torque, n = slots × poles' least common multiple × gear ratio; 1 or
    2 for eccentric gears (Holtz and Springob 1996).
    """

    kind: ClassVar[str] = "cogging_torque"
    elements: ClassVar[tuple[str, ...]] = ("joint",)
    needs: ClassVar[str] = "a hinge joint"
    law: ClassVar[str] = "τ = A·sin(n·q + φ)"
    identified_by: ClassVar[str] = "slow runs over several periods in both directions"
    acts: ClassVar[bool] = True
    reads_state: ClassVar[bool] = True

    amplitude: jax.Array = parameter(
        0.0,
        unit="N m",
        low=-50.0,
        high=50.0,
        scale=1e-2,
        source="A few per cent of the torque of table-top and legged robots' joints, with room",
    )
    periods: jax.Array = parameter(
        6.0,
        unit="1/turn",
        low=0.5,
        high=500.0,
        scale=0.05,
        source="From an eccentric gear to 42 poles and slots behind a small gear",
    )
    phase: jax.Array = parameter(
        0.0, unit="rad", low=-6.3, high=6.3, scale=0.1, source="A whole turn either way"
    )

    @classmethod
    def fits(cls, host: mujoco.MjModel, element: str, name: str) -> bool:
        """Say whether the joint is a hinge: a slide has no turns."""
        hinge = mujoco.mjtJoint.mjJNT_HINGE
        return super().fits(host, element, name) and host.joint(name).type[0] == hinge

    @classmethod
    def starts(cls, host: mujoco.MjModel, target: str) -> tuple[Mapping[str, float], ...]:
        """Try common numbers of periods, in phase and a quarter of a period late."""
        size = small_torque(host, target.partition("/")[2], cls.parameters()[0].scale)
        return tuple(
            {"amplitude": size, "periods": float(periods), "phase": phase}
            for periods in (1, 2, 4, 6, 12, 24)
            for phase in (0.0, np.pi / 2)
        )

    @classmethod
    def opposite(cls, start: Mapping[str, float]) -> Mapping[str, float] | None:
        """Return the ripple half a period late."""
        return {**start, "phase": start["phase"] - np.pi}

    @classmethod
    def suggested(
        cls, position: np.ndarray, torque: np.ndarray, rests: np.ndarray
    ) -> Suggestion | None:
        """Return the ripples that stand out of the missing torques' spectra over the angle.

        Each is taken away before the next is looked for, or that were its sidelobe (Högbom 1974).
        Of slower ripples than two periods in the range of the angle, which are hard to tell from
        other laws there, the one counts that explains most beside a line.
        """
        del torque
        span = float(np.ptp(position))
        amplitude, periods, _ = cls.parameters()
        low, high = max(periods.low, 2 * np.pi * SLOW[-1] / max(span, 1e-9)), periods.high
        if low >= high:
            return None
        starts = []
        for rest in rests:
            counts = np.isfinite(rest)
            angle, rest = position[counts], rest[counts]
            slowest = _slow_ripple(angle, rest)
            for _ in range(PEAKS):
                peak = _highest_peak(angle, rest, low, high)
                if peak is None:
                    break
                size, phase, _ = _wave(peak, angle, rest, SMOOTH)
                rest = rest - size * np.sin(peak * angle + phase)
                starts.append({"amplitude": size, "periods": peak, "phase": phase})
            starts += slowest
        starts = [
            {**start, "amplitude": min(start["amplitude"], amplitude.high)} for start in starts
        ]
        num_tried = math.ceil((high - low) * span / (2 * np.pi)) + len(SLOW)
        return Suggestion(tuple(starts), len(rests) * num_tried)

    def apply(self, model: ModelView, state, ctrl: jax.Array, memory):
        """Add the torque at the present angle."""
        joint = element_id(model.host, "joint", self.name)
        angle = state.qpos[model.host.jnt_qposadr[joint]]
        torque = self.amplitude * jnp.sin(self.periods * angle + self.phase)
        return ctrl, at_dof(model.host, joint, torque, ctrl.dtype), memory


def _highest_peak(position: np.ndarray, torque: np.ndarray, low: float, high: float):
    """Return which ripple in a band, in periods a turn, a torque has most of; None if none."""
    span = float(np.ptp(position))
    rest = torque - np.polynomial.Polynomial.fit(position, torque, SMOOTH)(position)
    width = max(2 * np.pi / (BINS_PER_PERIOD * high), span / MOST_BINS)
    sums = np.bincount(((position - position.min()) / width).astype(int), rest)
    size = FINER * len(sums)
    spectrum = np.abs(np.fft.rfft(sums, size))
    step = 2 * np.pi / (size * width)
    peaks = signal.find_peaks(spectrum)[0]
    peaks = peaks[(peaks * step >= low) & (peaks * step <= high)]
    if not len(peaks):
        return None
    highest = step * peaks[np.argmax(spectrum[peaks])]
    bounds = max(low, highest - step), min(high, highest + step)
    best = optimize.minimize_scalar(
        lambda periods: _wave(periods, position, torque, SMOOTH)[2], bounds=bounds, method="bounded"
    )
    return float(best.x)


def _slow_ripple(position: np.ndarray, torque: np.ndarray) -> list[dict[str, float]]:
    """Return the slow ripple that explains most of a torque beside a line, if there is any.

    A polynomial that follows more than a line would do much of what it does.
    """
    _, p, _ = CoggingTorque.parameters()
    turns = float(np.ptp(position)) / (2 * np.pi)
    grid = np.asarray(SLOW) / max(turns, 1e-9)
    grid = grid[(grid >= p.low) & (grid <= p.high)]
    if not len(grid) or len(position) < FEWEST:
        return []
    periods = min(grid, key=lambda n: _wave(n, position, torque, 1)[2])
    size, phase, _ = _wave(periods, position, torque, 1)
    return [{"amplitude": size, "periods": float(periods), "phase": phase}]


def _wave(
    periods: float, position: np.ndarray, torque: np.ndarray, degree: int
) -> tuple[float, float, float]:
    """Fit a ripple with some periods beside a polynomial of the position.

    Returns:
        Its amplitude, its phase and the sum of squares that both leave.
    """
    centred = 2.0 * (position - position.min()) / np.ptp(position) - 1.0
    smooth = np.polynomial.polynomial.polyvander(centred, degree)
    waves = np.stack([np.sin(periods * position), np.cos(periods * position)], axis=1)
    columns = np.concatenate([waves, smooth], axis=1)
    factor = np.linalg.lstsq(columns, torque, rcond=None)[0]
    size, phase = np.hypot(factor[0], factor[1]), np.arctan2(factor[1], factor[0])
    return float(size), float(phase), float(np.sum((torque - columns @ factor) ** 2))
