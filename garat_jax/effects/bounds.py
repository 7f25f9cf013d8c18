"""What an effect's parameters may be."""

import jax
import mujoco
import numpy as np

from garat_jax.effects.base import Effect
from garat_jax.effects.units import parameter_at
from garat_jax.errors import UserError

ROUNDING = 1e-6
"""Part of a bound by which a value may lie beyond it: it may be a float32."""


def check_bounds(effect: Effect, host: mujoco.MjModel) -> None:
    """Check the parameters of an effect whose place fits a model.

    What means "no effect" there is let pass, and so is what is not known yet, within `jax.vmap`.

    Args:
        effect: The effect; its parameters may be arrays of any shape.
        host: The compiled model.

    Raises:
        UserError: A value is outside its bounds, or not a number.
    """
    none = effect.at(host, effect.target)
    for p in (parameter_at(p, host, effect.target) for p in effect.parameters()):
        given = getattr(effect, p.name)
        if isinstance(given, jax.core.Tracer):
            continue
        values = np.asarray(given, float)
        low, high = p.low - ROUNDING * abs(p.low), p.high + ROUNDING * abs(p.high)
        good = ((low <= values) & (values <= high)) | np.isclose(values, none[p.name], ROUNDING)
        if not np.all(good):
            raise UserError(
                f"{effect.kind} {p.name} = {values[~good].flat[0]:g} is outside its bounds, "
                f"{p.low:g} to {p.high:g}{f' {p.unit}' if p.unit else ''} ({p.source})"
            )
