"""A compiled model as MJX steps it, or one line that says what of it MJX cannot step."""

from collections.abc import Iterator, Mapping

import jax
import mujoco
import numpy as np

from garat_jax._mjx import mjx
from garat_jax.effects.at_joint import off_by_group
from garat_jax.errors import UserError
from garat_jax.precision import full_precision
from garat_jax.setconst import CONSTANT_INPUTS, set_const

HINT = "use engine mujoco, which JAX_PLATFORMS=cpu chooses"
YIELD_HINT = "take it out of the model: engine mujoco does not carry it either"
DELAY_HINT = "take it out of the model, and give the effect actuator_delay or sensor_delay"


def put_model(model: mujoco.MjModel) -> mjx.Model:
    """Return a model for MJX.

    Raises:
        UserError: MJX cannot step the model, or would ignore a part of it.
    """
    for feature, element, has, hint in _ignored(model):
        names = [f"{element}/{_name(model, element, int(i))}" for i in np.flatnonzero(has)]
        if names:
            at = ", ".join(names)
            raise UserError(
                f"engine mjx cannot step this model: it ignores {feature} ({at}); {hint}"
            )
    if options := ", ".join(_ignored_options(model)):
        raise UserError(f"engine mjx cannot step this model: it ignores {options}; {HINT}")
    if model.nplugin:
        raise UserError("engine mjx cannot step this model: it ignores plugins; take them out")
    try:
        return mjx.put_model(model)
    except NotImplementedError as error:
        raise UserError(f"engine mjx cannot step this model: {error}; use mujoco") from error


@full_precision
def with_fields(
    model: mjx.Model, host: mujoco.MjModel, changed: Mapping[str, jax.Array]
) -> mjx.Model:
    """Return a model for MJX with these native fields, and the constants that follow from them.

    Args:
        model: The model as `put_model` gives it.
        host: The compiled MuJoCo model.
        changed: Fields by name; those of the options begin with `opt.`.
    """
    options = {n[4:]: v for n, v in changed.items() if n.startswith("opt.")}
    fields = {n: v for n, v in changed.items() if not n.startswith("opt.")}
    model = model.replace(**fields)
    if options:
        model = model.replace(opt=model.opt.replace(**options))
    if CONSTANT_INPUTS & fields.keys():
        model = set_const(model, host)
    return model


def _ignored(model: mujoco.MjModel) -> Iterator[tuple[str, str, np.ndarray, str]]:
    """Yield what MJX 3.17 leaves out without a word: feature, element, which have it, a hint."""
    bent = np.unique(model.dof_jntid[model.dof_dampingpoly.any(axis=1)])
    yield "polynomial damping", "joint", np.isin(np.arange(model.njnt), bent), HINT
    yield "polynomial stiffness", "joint", model.jnt_stiffnesspoly.any(axis=1), HINT
    yield "polynomial damping", "tendon", model.tendon_dampingpoly.any(axis=1), HINT
    yield "polynomial stiffness", "tendon", model.tendon_stiffnesspoly.any(axis=1), HINT
    damped = (model.actuator_damping != 0) | model.actuator_dampingpoly.any(axis=1)
    yield "an actuator's damping", "actuator", damped, HINT
    yield "an actuator's armature", "actuator", model.actuator_armature != 0, HINT
    yield "springyield", "joint", model.jnt_springyield > 0, YIELD_HINT
    yield "springyield", "tendon", model.tendon_springyield > 0, YIELD_HINT
    early = model.actuator_actearly.astype(bool) & (model.actuator_actnum > 0)
    yield "actearly", "actuator", early, HINT
    yield "that a group is off", "actuator", off_by_group(model), HINT
    yield "surfacevel", "geom", model.geom_surfacevel.any(axis=1), HINT
    yield "adhesion", "geom", model.geom_adhesion != 0, HINT
    has_fluid = model.opt.density > 0 or model.opt.viscosity > 0
    yield "fluidshape", "geom", has_fluid & (model.geom_fluid[:, 0] > 0), HINT
    yield "a native delay", "actuator", model.actuator_delay > 0, DELAY_HINT
    yield "a native delay or interval", "sensor", model.sensor_history[:, 0] > 0, DELAY_HINT


def _ignored_options(model: mujoco.MjModel) -> Iterator[str]:
    """Yield the same of options.

    MJX takes springs, dampers and gravity compensation away together where one of the two is off.
    """
    bits = mujoco.mjtDisableBit
    passive = bits.mjDSBL_SPRING | bits.mjDSBL_DAMPER
    if model.opt.disableflags & passive not in (0, passive):
        yield "that of springs and dampers one alone is disabled"
    if model.opt.noslip_iterations > 0:
        yield "noslip_iterations"
    if model.pair_adhesion.any():
        yield "the adhesion of pairs"


def _name(model: mujoco.MjModel, element: str, index: int) -> str:
    kind = mujoco.mju_str2Type(element)
    return mujoco.mj_id2name(model, kind, index) or str(index)
