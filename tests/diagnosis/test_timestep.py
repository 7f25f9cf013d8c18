"""Estimates where the timestep's error cannot be extrapolated."""

import dataclasses

import numpy as np
import pytest

from garat_jax.diagnosis.fit import fit
from garat_jax.diagnosis.metric import trusted
from garat_jax.diagnosis.starts import settle
from garat_jax.diagnosis.timestep import count_timestep
from tests.diagnosis.test_starts import FRICTION, puck

__all__ = ["puck"]


class Finer:
    """A simulator of half the timestep in which friction rubs more."""

    def __init__(self, simulator, more: float):
        self._simulator, self._more = simulator, more
        self.effects, self.slots, self.base = simulator.effects, simulator.slots, simulator.base
        self.host = simulator.host

    def predict(self, theta, start, segments):
        return self._simulator.predict(theta + self._more, start, segments)


def test_across_contacts_an_interval_reaches_as_far_as_fits_at_both_timesteps(puck):
    puck = dataclasses.replace(puck, finer=Finer(puck.simulator, 0.01))
    settled = settle(puck, np.array([0.4]), puck.segments.start)
    puck = trusted(puck, settled)
    found = fit(puck, np.array([0.4]), settled.start, (0,))
    counted = count_timestep(puck, found)
    assert counted.theta[0] == pytest.approx(FRICTION, abs=0.005)
    assert FRICTION - 0.03 < counted.low[0] < FRICTION - 0.01
    assert FRICTION - 0.005 < counted.high[0] < FRICTION + 0.005
