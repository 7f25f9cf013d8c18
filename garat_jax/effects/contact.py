"""Effects at a geom that touches others: how it slides, and how softly it yields.

MuJoCo joins two geoms' numbers for their contact (the larger friction, a mean of the softness, or
those of the geom with priority), so the number of one geom alone may say nothing: beside a floor
of friction 1, a foot of 0.5 slides like one of 1. These effects therefore act on the contacts.
`prepare` names every pair that the geom can form, the compiler joins the numbers as ever, and the
effect scales the pairs' numbers: the parameter is that of the geom's roughest (or softest)
contact, and its other contacts keep their proportion to it.
"""

from collections.abc import Mapping
from typing import ClassVar

import jax
import mujoco
import numpy as np
from flax import struct

from garat_jax.effects.base import Effect, ModelView, parameter
from garat_jax.effects.elements import element_id, free_name

FLAT = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD)
"""Geoms that cannot touch each other."""
NAMELESS = "nameless geom "
"""Names of geoms that had none; effects are not offered there, because a model card lacks them."""


@struct.dataclass
class ContactEffect(Effect):
    """What the effects on one geom's contacts have in common."""

    elements: ClassVar[tuple[str, ...]] = ("geom",)
    needs: ClassVar[str] = "a named geom that can touch another"
    independent: ClassVar[bool] = True
    contact_field: ClassVar[str]
    """MuJoCo's field, of geoms (`geom_`) and of named pairs (`pair_`)."""
    pair_columns: ClassVar[tuple[int, ...]]
    """For each column of a pair's field that is scaled, the parameter it belongs to."""

    @classmethod
    def join(cls, host: mujoco.MjModel, a: int, b: int) -> np.ndarray:
        """Return the numbers of a contact of two geoms of equal priority, [parameters]."""
        raise NotImplementedError

    @classmethod
    def fits(cls, host: mujoco.MjModel, element: str, name: str) -> bool:
        """Say whether the geom can touch another in a way that the parameters describe."""
        if not name or name.startswith(NAMELESS):
            return False
        return len(cls._joined(host, element_id(host, "geom", name))) > 0

    @classmethod
    def at(cls, host: mujoco.MjModel, target: str) -> Mapping[str, float]:
        """Return the numbers of the geom's roughest (or softest) contact."""
        geom = element_id(host, "geom", target.partition("/")[2])
        most = cls._joined(host, geom).max(axis=0)
        return dict(zip((p.name for p in cls.parameters()), map(float, most), strict=True))

    @classmethod
    def starts(cls, host: mujoco.MjModel, target: str) -> tuple[Mapping[str, float], ...]:
        """Start at several sizes of each number, because sticking and slipping differ."""
        base = cls.at(host, target)
        return tuple(
            {p.name: float(np.clip(factor * base[p.name], p.low, p.high))}
            for p in cls.parameters()
            for factor in (0.5, 0.7, 1.4, 2.0)
        )

    @classmethod
    def _joined(cls, host: mujoco.MjModel, geom: int) -> np.ndarray:
        """Return the numbers of all possible contacts as MuJoCo joins them, [n, parameters]."""
        num, rows = len(cls.parameters()), []
        for other in partners(host, geom):
            deciding = _deciding(host, geom, other)
            own = getattr(host, f"geom_{cls.contact_field}")[deciding[0], :num]
            rows.append(own if len(deciding) == 1 else cls.join(host, geom, other))
        rows += [*getattr(host, f"pair_{cls.contact_field}")[_pairs(host, geom), :num]]
        joined = np.reshape(rows, (-1, num))
        return joined[np.all(joined > 0, axis=1)]

    def prepare(self, spec: mujoco.MjSpec) -> None:
        """Name every pair that the geom can form, with the numbers that the compiler gives it."""
        host, geoms = _compile_named(spec)
        index = element_id(host, "geom", self.name)
        for other in partners(host, index):
            name = host.geom(other).name
            geoms[name].name = name
            pair = spec.add_pair(geomname1=self.name, geomname2=name)
            deciding = _deciding(host, index, other)
            pair.condim = int(host.geom_condim[deciding].max())
            pair.adhesion = float(host.geom_adhesion[deciding].sum())
            pair.margin = host.geom_margin[index] + host.geom_margin[other]
            pair.gap = host.geom_gap[index] + host.geom_gap[other]
            for joined, length in (("friction", 5), ("solref", 2), ("solimp", 5)):
                setattr(pair, joined, [np.nan] * length)

    def fields(self, model: ModelView) -> dict[str, jax.Array]:
        """Scale the numbers of the geom's pairs."""
        return self._scaled(model.host, model[f"pair_{self.contact_field}"])

    def _scaled(self, host: mujoco.MjModel, numbers: jax.Array) -> dict[str, jax.Array]:
        num, name = len(self.parameters()), f"pair_{self.contact_field}"
        rows = _pairs(host, element_id(host, "geom", self.name))
        compiled = getattr(host, name)[rows]
        usable = np.all(compiled[:, :num] > 0, axis=1)
        for column, which in enumerate(self.pair_columns):
            most = compiled[usable, which].max()
            value = getattr(self, self.parameters()[which].name)
            numbers = numbers.at[rows[usable], column].multiply(value / most)
        return {name: numbers}

    def export(self, spec: mujoco.MjSpec) -> str:
        """Write the pairs with their numbers."""
        self.prepare(spec)
        copy = spec.copy()
        host = copy.compile()
        name = f"pair_{self.contact_field}"
        numbers = self._scaled(host, jax.numpy.asarray(getattr(host, name)))[name]
        for pair, compiled in zip(spec.pairs, copy.pairs, strict=True):
            for joined in ("friction", "solref", "solimp"):
                setattr(pair, joined, getattr(host, f"pair_{joined}")[compiled.id])
            setattr(pair, self.contact_field, np.asarray(numbers[compiled.id], float))
        return ""


@struct.dataclass
class ContactFriction(ContactEffect):
    """The sliding friction of a geom's contacts.

    Shows as slip where the model sticks, or the reverse; only contacts at the limit of friction
    tell it. Typical: 0.05 on ice, 0.3 to 0.6 for plastic on wood, 0.8 to 1.2 for rubber feet.
    """

    kind: ClassVar[str] = "contact_friction"
    law: ClassVar[str] = "|f_t| ≤ μ·f_n at the geom's contacts"
    identified_by: ClassVar[str] = "slipping: pushes beyond friction, inclined planes"
    contact_field: ClassVar[str] = "friction"
    pair_columns: ClassVar[tuple[int, ...]] = (0, 0)

    sliding: jax.Array = parameter(
        1.0,
        unit="1",
        low=0.01,
        high=3.0,
        scale=0.05,
        source="From oiled steel to soft rubber; MuJoCo's default is 1",
    )

    @classmethod
    def join(cls, host: mujoco.MjModel, a: int, b: int) -> np.ndarray:
        """Return the larger friction, [1]."""
        return np.maximum(host.geom_friction[a, :1], host.geom_friction[b, :1])


@struct.dataclass
class ContactCompliance(ContactEffect):
    """How softly a geom's contacts yield: MuJoCo's solref, a spring-damper per contact.

    Shows as another depth, length and rebound of impacts. A time constant below two timesteps
    acts like two (MuJoCo's refsafe). Typical: 0.02 s (MuJoCo's default), 0.005 s for hard floors,
    0.05 s for foam; a damping ratio below 1 rebounds. Contacts with a stiffness given directly
    (negative solref) stay as they are.
    """

    kind: ClassVar[str] = "contact_compliance"
    law: ClassVar[str] = "contact spring-damper of time constant τ, damping ratio ζ (solref)"
    identified_by: ClassVar[str] = "impacts and drops sampled faster than the time constant"
    contact_field: ClassVar[str] = "solref"
    pair_columns: ClassVar[tuple[int, ...]] = (0, 1)

    time_constant: jax.Array = parameter(
        0.02,
        unit="s",
        low=1e-3,
        high=0.5,
        scale=2e-3,
        source="From a timestep to visibly sinking; MuJoCo's default is 0.02",
    )
    damping_ratio: jax.Array = parameter(
        1.0,
        unit="1",
        low=0.05,
        high=5.0,
        scale=0.05,
        source="From a rubber ball to treacle; MuJoCo's default is 1",
    )

    @classmethod
    def join(cls, host: mujoco.MjModel, a: int, b: int) -> np.ndarray:
        """Return the mean by solmix, or the smaller where stiffness is given directly, [2]."""
        first, second = host.geom_solref[a], host.geom_solref[b]
        if min(first[0], second[0]) <= 0:
            return np.minimum(first, second)
        weight, other = (max(float(host.geom_solmix[geom]), mujoco.mjMINVAL) for geom in (a, b))
        return (weight * first + other * second) / (weight + other)


def can_any_touch(host: mujoco.MjModel) -> bool:
    """Say whether any two geoms can touch."""
    if _are_off(host):
        return False
    return host.npair > 0 or any(partners(host, geom) for geom in range(host.ngeom))


def partners(host: mujoco.MjModel, geom: int) -> list[int]:
    """Return the geoms that a geom can touch by MuJoCo's rules, without those named in pairs."""
    if _are_off(host):
        return []
    named = _pairs(host, geom)
    listed = {*host.pair_geom1[named].tolist(), *host.pair_geom2[named].tolist()}
    return [
        other
        for other in range(host.ngeom)
        if other not in listed and _can_touch(host, geom, other)
    ]


def _compile_named(spec: mujoco.MjSpec) -> tuple[mujoco.MjModel, dict[str, mujoco.MjsGeom]]:
    """Compile a copy whose geoms all have names, and return each geom of the spec by its name.

    The compiler may put geoms in another order (fusestatic) and leave some out (discardvisual).
    """
    copy, geoms = spec.copy(), {}
    for index, (geom, named) in enumerate(zip(spec.geoms, copy.geoms, strict=True)):
        named.name = geom.name or free_name(f"{NAMELESS}{index}", copy.geom)
        geoms[named.name] = geom
    return copy.compile(), geoms


def _are_off(host: mujoco.MjModel) -> bool:
    return bool(host.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT)


def _pairs(host: mujoco.MjModel, geom: int) -> np.ndarray:
    """Return the indices of the named pairs with a geom."""
    return np.flatnonzero((host.pair_geom1 == geom) | (host.pair_geom2 == geom))


def _can_touch(host: mujoco.MjModel, a: int, b: int) -> bool:
    types, affinities = host.geom_contype, host.geom_conaffinity
    if not (types[a] & affinities[b] or types[b] & affinities[a]):
        return False
    if host.geom_type[a] in FLAT and host.geom_type[b] in FLAT:
        return False
    bodies = sorted((int(host.geom_bodyid[a]), int(host.geom_bodyid[b])))
    if (bodies[0] << 16) + bodies[1] in host.exclude_signature:
        return False
    weld, other = (int(host.body_weldid[body]) for body in bodies)
    if weld == other:
        return False
    if host.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT or not (weld and other):
        return True
    parent, other_parent = (
        int(host.body_weldid[host.body_parentid[body]]) for body in (weld, other)
    )
    return weld != other_parent and other != parent


def _deciding(host: mujoco.MjModel, a: int, b: int) -> list[int]:
    """Return which of two geoms decide about their contact: the one with priority, or both."""
    most = max(host.geom_priority[[a, b]])
    return [geom for geom in (a, b) if host.geom_priority[geom] == most]
