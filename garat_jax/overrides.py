"""Changes of a model before it is compiled: what makes a source or a target of it."""

import dataclasses
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from garat_jax.effects.elements import OBJECT_TYPES
from garat_jax.errors import UserError, choose, unknown_name

NUMBERS = (int, float, np.number, list, tuple, np.ndarray)
OPTION_WORDS = {
    "integrator": mujoco.mjtIntegrator,
    "solver": mujoco.mjtSolver,
    "cone": mujoco.mjtCone,
    "jacobian": mujoco.mjtJacobian,
}
"""Options that MJCF gives as a word and MuJoCo as a number."""

LED = ("friction", "damping", "stiffness", "gear", "gainprm", "dynprm", "size")
"""Fields of several numbers of which the first says most: one number alone is that."""
SPRUNG = ("damping", "stiffness")
"""Fields of a joint that its `springdamper`, if it has one, decides."""


@dataclasses.dataclass(frozen=True)
class Override:
    """One change of a model before it is compiled; of two of the same field the later counts.

    Attributes:
        element: `body`, `joint`, `geom`, `actuator` or `option`.
        name: The element's name; empty for `option`.
        field: The field of MuJoCo's spec. A body's `mass` scales its inertia with it, whether it
            is given explicitly or comes from the body's geoms.
        value: The new value; of an option that is a word in MJCF, as `integrator`, the word or
            MuJoCo's number. Of a field of several numbers all of them; the first alone will do for
            `friction`, `damping`, `stiffness`, `gear`, `gainprm`, `dynprm` and `size`.
    """

    element: str
    name: str
    field: str
    value: Any

    @property
    def place(self) -> str:
        """What is changed, as a user reads it: `body/pole mass`."""
        return f"{'/'.join(filter(None, (self.element, self.name)))} {self.field}"

    def apply(self, spec: mujoco.MjSpec) -> None:
        """Write the change into a spec.

        Raises:
            UserError: There is no such element or field, or it does not take the value.
        """
        target = self._find(spec)
        known = [name for name in dir(target) if _is_field(target, name)]
        if self.field not in known:
            raise unknown_name(f"{self.element} field", self.field, known)
        current, value = getattr(target, self.field), self.value
        if self.element == "option" and self.field in OPTION_WORDS and isinstance(value, str):
            members = OPTION_WORDS[self.field].__members__.items()
            words = {name.partition("_")[2].lower(): int(member) for name, member in members}
            value = choose(f"option {self.field}", value.lower(), words)
        try:
            if not _is_finite(value):
                raise ValueError("not finite")
            if type(current) in (int, float, np.ndarray) and _has_truth(value):
                raise ValueError("no number")
            if self.element == "joint" and self.field in SPRUNG and np.any(target.springdamper):
                raise UserError(
                    f"joint/{self.name} {self.field} follows from its springdamper; override that"
                )
            if self.element == "body" and self.field == "mass":
                _scale_mass(spec, target, float(value))
            elif np.ndim(current) == 1 and np.ndim(value) == 0:
                if self.field not in LED:
                    raise ValueError("too few numbers")
                current[0] = value
            else:
                setattr(target, self.field, value)
        except UserError:
            raise
        except (TypeError, ValueError) as error:
            raise UserError(
                f"{self.place} = {self.value!r}; expected {self._wanted(current)}"
            ) from error

    def _wanted(self, current: Any) -> str:
        """Say what may stand in the place of a field's value."""
        if isinstance(current, np.ndarray):
            few = "a finite number or " if self.field in LED else ""
            return f"{few}{len(current)} finite numbers"
        if isinstance(current, str):
            return "a name"
        return "a finite number" if isinstance(current, float) else "a whole number"

    def _find(self, spec: mujoco.MjSpec):
        if self.element == "option":
            return spec.option
        if self.element not in OBJECT_TYPES:
            raise unknown_name("element", self.element, [*OBJECT_TYPES, "option"])
        target = getattr(spec, self.element)(self.name)
        if target is None:
            listing = {"body": "bodies"}.get(self.element, f"{self.element}s")
            raise unknown_name(self.element, self.name, [e.name for e in getattr(spec, listing)])
        return target


def _is_field(target: Any, name: str) -> bool:
    """Say whether a spec's attribute is something that MJCF says of an element."""
    if name.startswith("_") or name in ("id", "signature"):
        return False
    value = getattr(target, name)
    of_mujoco = type(value).__name__.startswith("mjt")
    return of_mujoco or isinstance(value, int | float | str | np.ndarray)


def _has_truth(value: Any) -> bool:
    """Say whether a value is, or holds, true or false."""
    if isinstance(value, list | tuple):
        return any(map(_has_truth, value))
    return isinstance(value, bool) or np.asarray(value).dtype.kind == "b"


def _is_finite(value: Any) -> bool:
    """Say whether a value is finite, as far as it is numbers."""
    return not isinstance(value, NUMBERS) or bool(np.all(np.isfinite(value)))


def _scale_mass(spec: mujoco.MjSpec, body, mass: float) -> None:
    """Scale a body's inertial and its geoms: the compiler decides which of them counts."""
    if mass <= 0:
        raise UserError(f"body/{body.name} mass must be positive, not {mass:g} kg")
    before = _mass(spec, body.name)
    if not before:
        raise UserError(
            f"body/{body.name} has no mass to scale; name a body that moves, with an inertial or "
            "with geoms that have mass"
        )
    ratio = mass / before
    body.mass = body.mass * ratio
    body.inertia = body.inertia * ratio
    body.fullinertia = body.fullinertia * ratio
    for geom in body.geoms:
        if geom.mass > 0:
            geom.mass = geom.mass * ratio
        else:
            geom.density = geom.density * ratio
    after = _mass(spec, body.name)
    if abs(after - mass) > 1e-6 * mass:
        raise UserError(
            f"body/{body.name} mass is {after:g} kg whatever is asked for: "
            "settotalmass or boundmass of the model's compiler overrules it"
        )


def _mass(spec: mujoco.MjSpec, body: str) -> float:
    """Return a body's compiled mass, kg: its own, also where fusestatic joins it with others."""
    apart = spec.copy()
    apart.compiler.fusestatic = False
    return float(compiled(apart).body(body).mass[0])


def compiled(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile a copy of a spec, which stays as it is.

    Raises:
        UserError: MuJoCo refuses the model.
    """
    try:
        return spec.copy().compile()
    except ValueError as error:
        raise UserError(f"MuJoCo cannot compile the model: {_line(error)}") from error


def load_spec(mjcf: str | Path) -> mujoco.MjSpec:
    """Read an MJCF file.

    Raises:
        UserError: The file is missing or MuJoCo cannot read it.
    """
    path = Path(mjcf)
    if not path.is_file():
        raise UserError(f"{path}: no such model file")
    try:
        path.open("rb").close()  # MuJoCo takes what it may not read for an empty file
        return mujoco.MjSpec.from_file(str(path))
    except OSError as error:
        raise UserError(f"{path}: {error.strerror}") from error
    except ValueError as error:
        raise UserError(f"{path}: {_line(error)}") from error


def _line(error: ValueError) -> str:
    """Return what MuJoCo says of a model, in one line."""
    return " ".join(str(error).split())
