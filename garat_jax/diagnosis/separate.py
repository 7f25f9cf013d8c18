"""Which experiment tells effects apart that a recording cannot."""

from collections.abc import Sequence

from garat_jax.diagnosis.results import Candidate, Experiment

EXPERIMENTS: dict[frozenset[str], str] = {
    frozenset({"motor_gain", "payload_mass"}): (
        "record once more with a known mass attached: a gain scales the response to it, "
        "an unknown payload does not"
    ),
    frozenset({"motor_gain", "rotor_inertia"}): (
        "hold the joint still against gravity in several poses: "
        "a gain changes the torque needed there, inertia does not"
    ),
    frozenset({"motor_gain", "gravity_scale"}): (
        "let it swing freely from several heights without commands: a gain does not show there"
    ),
    frozenset({"gravity_scale", "payload_mass"}): (
        "record fast reversals: a payload adds inertia, gravity does not"
    ),
    frozenset({"viscous_damping", "coulomb_friction"}): (
        "repeat the same motion at two amplitudes and at very low speed: "
        "dry friction stays, viscous friction vanishes"
    ),
    frozenset({"actuator_delay", "rotor_inertia"}): (
        "command a train of steps: a delay shifts the response, inertia slows it"
    ),
    frozenset({"torque_offset", "gravity_scale"}): (
        "rest in poses on both sides of the vertical: an offset keeps its sign, gravity changes it"
    ),
    frozenset({"torque_offset", "encoder_offset"}): (
        "swing widely under gravity: gravity depends on the true angle, a constant torque does not"
    ),
    frozenset({"actuator_delay", "sensor_delay"}): (
        "push it by hand, or add a second, faster sensor: commands and sensors are late together"
    ),
    frozenset({"viscous_damping", "quadratic_drag"}): (
        "repeat the same motion at two amplitudes: viscous friction doubles, drag quadruples"
    ),
    frozenset({"viscous_damping", "back_emf"}): (
        "let it swing with the motor disconnected: back-EMF vanishes, damping stays"
    ),
    frozenset({"joint_stiffness", "gravity_scale"}): (
        "turn the mechanism on its side: a spring stays, gravity changes"
    ),
}
"""By pairs of kinds."""
DEFAULT = (
    "record with twice the amplitude and with faster and slower commands, "
    "so that torque, speed and acceleration do not rise and fall together"
)


def next_experiment(candidates: Sequence[Candidate]) -> Experiment | None:
    """Return the experiment that separates the first candidate with unlike explanations."""
    for candidate in candidates:
        if candidate.indistinguishable_from:
            others = candidate.indistinguishable_from
            ways = dict.fromkeys(
                EXPERIMENTS.get(frozenset({candidate.effect, other.effect}), DEFAULT)
                for other in others
            )
            return Experiment((candidate.named, *others), "; ".join(ways))
    return None
