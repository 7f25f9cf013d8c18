"""Which experiment tells effects apart that a recording cannot."""

import math
from collections.abc import Sequence

import mujoco

from garat_jax.diagnosis.findings import MOST_NAMED, Candidate, Experiment, Named
from garat_jax.effects.contact import partners
from garat_jax.effects.elements import element_id

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
NONE = (
    "no recording of this model tells {first} from the same at {other}: they touch nothing but "
    "each other, and their one contact has one {kind}; name either"
)
"""Of one kind at two geoms that make one contact."""
UNKNOWN = (
    "no experiment is known that tells {first} from {others}; garat plan MODEL --separate "
    "{first_place} {other_place} --out plan.csv looks for commands that do, and says how far "
    "they do"
)
"""Of others, where there are commands; the first of these stands for all."""
UNKNOWN_PASSIVE = (
    "no experiment is known that tells {first} from {others}; recordings from other initial states "
    "and at other amplitudes may"
)
"""Of others, where there are none."""


def next_experiment(candidates: Sequence[Candidate], host: mujoco.MjModel) -> Experiment | None:
    """Return the experiment that separates the first candidate with unlike explanations.

    Of candidates that were not fitted nothing is claimed that there would be to tell apart.

    Args:
        candidates: What was found.
        host: The compiled model: its actuators, and which geoms can touch.
    """
    for candidate in candidates:
        if candidate.indistinguishable_from and math.isfinite(candidate.error_after):
            first, others = candidate.named, candidate.indistinguishable_from
            known = {other: _way(first, other, host) for other in others}
            ways = [*dict.fromkeys(way for way in known.values() if way)]
            if unknown := [other for other, way in known.items() if not way]:
                ways.append(_advice(first, unknown, host))
            return Experiment((first, *others), "; ".join(ways))
    return None


def _way(first: Named, second: Named, host: mujoco.MjModel) -> str:
    """Return what separates two effects, or that nothing can, in words; empty if unknown."""
    if known := EXPERIMENTS.get(frozenset({first.effect, second.effect})):
        return known
    if first.effect == second.effect and _make_one_contact(host, first.target, second.target):
        kind = first.effect.replace("_", " ")
        return NONE.format(first=first, other=second.target, kind=kind)
    return ""


def _advice(first: Named, others: Sequence[Named], host: mujoco.MjModel) -> str:
    """Return what may separate an effect from others of which no experiment is known to."""
    more = len(others) - MOST_NAMED
    named = " or ".join(str(other) for other in others[:MOST_NAMED])
    named += f" or {more} more" if more > 0 else ""
    places = [f"{one.effect}@{one.target}" for one in (first, others[0])]
    words = UNKNOWN if host.nu else UNKNOWN_PASSIVE
    return words.format(first=first, others=named, first_place=places[0], other_place=places[1])


def _make_one_contact(host: mujoco.MjModel, first: str, second: str) -> bool:
    """Say whether two targets are geoms that can touch nothing but each other."""
    if not first.startswith("geom/") or not second.startswith("geom/"):
        return False
    a, b = (element_id(host, "geom", target.partition("/")[2]) for target in (first, second))
    named = list(zip(host.pair_geom1.tolist(), host.pair_geom2.tolist(), strict=True))
    touched = {geom: set(partners(host, geom)) for geom in (a, b)}
    for one, other in named:
        if one in touched:
            touched[one].add(other)
        if other in touched:
            touched[other].add(one)
    return touched == {a: {b}, b: {a}}
