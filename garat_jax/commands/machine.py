"""The command about the machine: doctor."""

import dataclasses
from typing import Literal

from garat_jax.terminal import print_table, say

Device = Literal["auto", "cpu", "gpu", "tpu"]


@dataclasses.dataclass(frozen=True)
class Doctor:
    """Say what this machine offers, measure both engines for 5 s once compiled, and advise."""

    device: Device = "auto"
    """What computes."""

    def run(self) -> None:
        """Examine the machine and print what was found."""
        from garat_jax.doctor import examine

        found = examine(self.device)
        for name, value in found.facts:
            say(f"{name}: {value}")
        rows = [(r.engine, str(r.batch), f"{r.steps_per_second:,.0f}") for r in found.rates]
        print_table(("engine", "simulations at once", "physics steps a second"), rows)
        for line in found.advice:
            say(line)
