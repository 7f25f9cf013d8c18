"""An effect of one's own: a driver that folds back when it gets warm."""

from typing import ClassVar

import jax
import jax.numpy as jnp
from flax import struct

from garat_jax.effects import Effect, parameter


@struct.dataclass
class ThermalFade(Effect):
    """Commands weaken by `fade` for each unit of warmth; warmth follows u² within 20 s."""

    kind: ClassVar[str] = "thermal_fade"
    elements: ClassVar[tuple[str, ...]] = ("all",)
    law: ClassVar[str] = "u ← u / (1 + fade·w), dw/dt = (u² − w) / 20 s"
    identified_by: ClassVar[str] = "large commands for a minute, after rest"
    acts: ClassVar[bool] = True
    remembers: ClassVar[bool] = True

    fade: jax.Array = parameter(0.0, unit="1", low=0.0, high=5.0, scale=0.05, source="our bench")

    def init(self, host):
        """Begin cold."""
        return jnp.zeros(host.nu)

    def apply(self, model, state, ctrl, memory):
        """Weaken the commands and warm up."""
        memory = memory + (ctrl**2 - memory) * model.host.opt.timestep / 20
        return ctrl / (1 + self.fade * memory), None, memory.astype(ctrl.dtype)
