"""Each law is found again, with its size, in data from an independent loop at a fine timestep."""

import jax
import numpy as np
import pytest

from garat_jax.effects import CATALOGUE
from tests.effects.truth import RIG, Truth, commands, record, recover

TARGETS = {"joint": "joint/hinge", "actuator": "actuator/motor", "all": "all"}


def dry(size: float, speed: float, sharpness: float = 1e-3) -> float:
    """Return dry friction, smoothed over a speed far below that of the motion."""
    return -size * np.tanh(speed / sharpness)


def asymmetric() -> Truth:
    """Differ by a factor of two; a timestep of 2 ms makes up for some 0.003 N m and 0.001 N m s."""
    return Truth(
        force=lambda q, v, u: -(0.04 if v > 0 else 0.02) * v,
        friction=lambda v: 0.15 if v > 0 else 0.08,
    )


def stribeck(q, v, u):
    return dry(0.06 + 0.12 * np.exp(-((v / 0.4) ** 2)), v)


def springy(spec):
    spec.joint("hinge").stiffness[0] = 0.8
    spec.joint("hinge").springref = np.rad2deg(0.5)


def limited(spec):
    spec.actuator("motor").forcelimited = True
    spec.actuator("motor").forcerange = [-0.35, 0.35]


def damped(spec):
    spec.joint("hinge").damping[0] += 0.05


def deadband(t, u):
    return np.sign(u(t)) * max(abs(u(t)) - 0.12, 0.0)


def curved(t, u):
    torque = 2.0 * u(t)
    over = max(abs(torque) - 0.3, 0.0)
    return np.sign(torque) * (min(abs(torque), 0.3) + 0.4 * (1 - np.exp(-over / 0.4))) / 2.0


class Lag:
    """The exact solution of a first-order lag under commands held for 4 ms, from the first on."""

    def __init__(self, time_constant: float):
        self.time_constant, self.output, self.time = time_constant, None, 0.0

    def __call__(self, t, u):
        if self.output is None:
            self.output = u(0.0)
        decay = np.exp(-(t - self.time) / self.time_constant)
        self.output = u(self.time) + (self.output - u(self.time)) * decay
        self.time = t
        return self.output


CASES = {
    "asymmetric_friction": (
        asymmetric,
        {
            "coulomb_positive": 0.15,
            "coulomb_negative": 0.08,
            "viscous_positive": 0.04,
            "viscous_negative": 0.02,
        },
    ),
    "stribeck_friction": (
        lambda: Truth(force=stribeck),
        {"coulomb": 0.06, "static": 0.18, "velocity": 0.4},
    ),
    "load_friction": (
        lambda: Truth(force=lambda q, v, u: dry(0.2 * abs(2 * u), v)), {"ratio": 0.2},
    ),
    "quadratic_drag": (
        lambda: Truth(force=lambda q, v, u: -0.03 * abs(v) * v), {"coefficient": 0.03},
    ),
    "joint_stiffness": (lambda: Truth(change=springy), {"stiffness": 0.8, "reference": 0.5}),
    "cogging_torque": (
        lambda: Truth(force=lambda q, v, u: 0.1 * np.sin(6 * q + 0.5)),
        {"amplitude": 0.1, "periods": 6.0, "phase": 0.5},
    ),
    "motor_deadband": (lambda: Truth(command=deadband), {"width": 0.12}),
    "torque_saturation": (lambda: Truth(change=limited), {"limit": 0.7}),
    "back_emf": (lambda: Truth(change=damped), {"coefficient": 0.05}),
    "motor_curve": (lambda: Truth(command=curved), {"saturation": 0.7, "linear": 0.3}),
    "actuator_lag": (lambda: Truth(command=Lag(0.03)), {"time_constant": 0.03}),
}  # fmt: skip


@pytest.fixture(autouse=True)
def _float64():
    with jax.enable_x64(True):
        yield


SLOW = (
    "asymmetric_friction",
    "stribeck_friction",
    "cogging_torque",
    "motor_curve",
    "load_friction",
)


@pytest.mark.parametrize(
    "kind", [pytest.param(k, marks=pytest.mark.slow if k in SLOW else ()) for k in CASES]
)
def test_the_size_is_found_again(kind):
    make_truth, true = CASES[kind]
    cls = CATALOGUE[kind]
    sizes = (1.0, 0.5) if kind in SLOW else (1.0,)
    runs = [(c, record(RIG, make_truth(), c)) for c in map(commands, sizes)]
    start = {name: 0.7 * size for name, size in true.items()}
    if kind == "cogging_torque":
        start["periods"] = 5.5
    found = recover(RIG, cls(target=TARGETS[cls.elements[0]], **start), start, runs)
    for name, size in true.items():
        assert found[name] == pytest.approx(size, rel=0.1), name
