"""C MuJoCo within compiled programs: a callback that steps a whole batch on threads."""

import collections
import ctypes
import functools
import hashlib
import logging
import math
import threading
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco.batch import Batch

from garat_jax import devices, host_call
from garat_jax.errors import UserError
from garat_jax.setconst import CONSTANT_INPUTS

KEPT_BATCHES = 16
"""Batches of simulations, of all models together, that are kept for the next call."""
INPUTS = int(mujoco.mjtState.mjSTATE_CTRL | mujoco.mjtState.mjSTATE_QFRC_APPLIED)

UNSTABLE = tuple(f"Nan, Inf or huge value in {name}" for name in ("QPOS", "QVEL", "QACC"))
"""How warnings begin of which callers see the consequence: a state that is not finite."""

_log = logging.getLogger(__name__)
_warnings: collections.deque[str] = collections.deque(maxlen=100)
_warned: set[str] = set()
# MuJoCo would print each warning and append it to MUJOCO_LOG.TXT in the current folder. This is
# called within C, on any thread; were it Python code, Ctrl-C would abort the process there.
if mujoco.get_mju_user_warning() is None:
    mujoco.set_mju_user_warning(_warnings.append)

_idle: list[tuple[tuple, "_Simulations"]] = []
"""Simulations that no call uses now, those used last at the end; scratch space without a state."""
_idle_lock = threading.Lock()


class HostModel:
    """A compiled MuJoCo model that compares by content, so that equal models share programs.

    Attributes:
        model: The model. Its automatic reset on bad states is off: a simulation that diverges
            stays diverged in both engines, and the caller sees it. One of a single tree is not
            searched for islands, of which it has one.
        digest: What its content is compared by.

    Raises:
        UserError: Its timestep is not above 0, or it lets bodies sleep.
    """

    def __init__(self, model: mujoco.MjModel):
        if not model.opt.timestep > 0:
            raise UserError(f"timestep is {model.opt.timestep:g} s; expected more than 0")
        if model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP:
            raise UserError(
                'the model lets bodies sleep (<flag sleep="enable"/>), which neither engine does '
                "here; take that out of it"
            )
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        if model.ntree <= 1:
            model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND
        _stop_profiling()
        self.model = model
        buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
        mujoco.mj_saveModel(model, None, buffer)
        self.digest = hashlib.sha256(buffer.tobytes()).hexdigest()

    def __hash__(self) -> int:
        return hash(self.digest)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, HostModel) and self.digest == other.digest

    @functools.cached_property
    def sizes(self) -> tuple[int, ...]:
        """Lengths of a row's parts: time, qpos, qvel, act, qacc_warmstart, then sensor data."""
        m = self.model
        return (1, m.nq, m.nv, m.na, m.nv, m.nsensordata)

    def advance(self, fields, state, commands, forces, num_substeps: int):
        """Step one simulation (a batch under `vmap`); see `dynamics.step` for the arguments.

        Args:
            fields: Native model fields that differ from the compiled model, by name.
            state: A `PhysicsState`.
            commands: [substeps, nu], or [1, nu] to hold one command.
            forces: Generalised forces, shaped alike [.., nv].
            num_substeps: Physics substeps.
        """
        function = functools.partial(self._advance_batch, num_substeps)
        name = f"advance {num_substeps}"
        result = self._call(name, function, (sum(self.sizes),), fields, state, commands, forces)
        time, *parts = jnp.split(result, np.cumsum(self.sizes)[:-1])
        return type(state)(time[0], *parts, memory=state.memory)

    def trace(self, fields, state, commands, forces, num_steps: int, num_substeps: int):
        """Step one simulation (a batch under `vmap`) through many commands in one call.

        Args:
            fields: As for `advance`.
            state: A `PhysicsState`.
            commands: [num_steps * num_substeps, nu], or [num_steps, nu] to hold each.
            forces: Generalised forces, shaped alike [.., nv].
            num_steps: Control steps.
            num_substeps: Physics substeps of each.

        Returns:
            qpos and qvel after each control step, [num_steps, nq + nv].
        """
        repeat = num_steps * num_substeps // commands.shape[0]
        shape = (num_steps, self.model.nq + self.model.nv)
        function = functools.partial(self._trace_batch, num_substeps, repeat)
        name = f"trace {num_substeps} {repeat}"
        return self._call(name, function, shape, fields, state, commands, forces)

    def _call(self, name: str, function, shape: tuple[int, ...], fields, state, commands, forces):
        """Call back with a batch of simulations, everything as 32-bit words."""
        if self.model.nhistory or self.model.nplugin:
            raise UserError(
                "engine mujoco does not carry plugins or native delays, and MJX ignores them; take "
                "them out of the model (for a delay give the effect actuator_delay or sensor_delay)"
            )
        if self.model.nplastic:
            raise UserError(
                "engine mujoco does not carry how far a spring has yielded, and MJX ignores that; "
                "take springyield out of the model"
            )
        row = jnp.concatenate(
            [state.time[None], state.qpos, state.qvel, state.act, state.qacc_warmstart]
        )
        control = jnp.concatenate([commands, forces], axis=1)
        # MuJoCo would take commands that are not finite for 0; MJX goes on to what is not finite.
        row = jnp.where(jnp.isfinite(control).all(), row, jnp.nan)
        inputs = {"row": row, "control": control, **fields}
        dtype = str(row.dtype)
        result = host_call.call(
            " ".join((self.digest, name, dtype, *inputs)),
            functools.partial(self._on_host, function, dtype, tuple(fields)),
            int(np.prod(shape)) * (row.dtype.itemsize // 4),
            [_to_words(value.astype(row.dtype)) for value in inputs.values()],
        )
        return _from_words(result, row.dtype).reshape(shape)

    def _on_host(self, function, dtype: str, names: tuple[str, ...], words) -> np.ndarray:
        """Write states and fields of a batch, call a function of it, and return its result.

        A program may call this for every physics substep of a few simulations, which take less
        time than a dozen lines of Python.
        """
        rows, controls, *values = [value.view(dtype) for value in words]
        leadings = {value.shape[:-1] for value in words}
        leading = leadings.pop() if len(leadings) == 1 else np.broadcast_shapes(*leadings)
        num = math.prod(leading)
        rows = _over(leading, rows).reshape(num, -1)
        controls = _over(leading, controls).reshape(num, -1, self.model.nu + self.model.nv)
        key = (self.digest, num, names)
        simulations = _borrowed(key) or _Simulations(self.model, num, names)
        simulations.write_fields(values, leading)
        simulations.state[:] = rows
        finite = np.isfinite(rows)
        result = function(simulations, controls, None if finite.all() else finite.all(axis=1))
        _give_back(key, simulations)
        _log_warnings()
        if result.dtype != rows.dtype:
            with np.errstate(over="ignore"):  # what exploded is infinite in 32 bits
                result = result.astype(rows.dtype)
        return result.reshape(*leading, -1).view(np.uint32)

    def _advance_batch(
        self, num_substeps: int, simulations: "_Simulations", controls: np.ndarray, finite
    ) -> np.ndarray:
        """Step a batch under controls [num, substeps or 1, nu + nv]; return its rows.

        Simulations that are not `finite` [num] bool, None if all are, stay as they are.
        """
        if controls.shape[1] == 1:
            simulations.inputs[:] = controls[:, 0]
            simulations.batch.step(finite, nstep=num_substeps)
        else:
            chosen = controls if finite is None else controls[finite]
            simulations.batch.rollout(num_substeps, chosen, INPUTS, record=(), ids=finite)
        return np.concatenate([simulations.state, simulations.sensors], axis=1)

    def _trace_batch(
        self,
        num_substeps: int,
        repeat: int,
        simulations: "_Simulations",
        controls: np.ndarray,
        finite,
    ) -> np.ndarray:
        """Step a batch under controls [num, .., nu + nv], each held for `repeat` substeps.

        MuJoCo stops a simulation that diverges and repeats its last state; here that is NaN.
        """
        batch, num, length = simulations.batch, len(controls), controls.shape[1] * repeat
        chosen = np.repeat(controls if finite is None else controls[finite], repeat, axis=1)
        begin = simulations.state[:, 0].copy()
        found = batch.rollout(length, chosen, INPUTS, record=("qpos", "qvel"), ids=finite)
        moved = np.concatenate([found["qpos"], found["qvel"]], axis=2)
        path = np.full((num, length // num_substeps, moved.shape[2]), np.nan)
        path[slice(None) if finite is None else finite] = moved[:, num_substeps - 1 :: num_substeps]
        done = (simulations.state[:, 0] - begin) / self.model.opt.timestep
        steps = num_substeps * np.arange(1, path.shape[1] + 1)
        path[~(done[:, None] > steps - 0.5)] = np.nan
        return path


class _Simulations:
    """A batch, and what of it is written and read in each call.

    MuJoCo's rows of state begin with the parts that `HostModel.sizes` lists, less the sensor data;
    of native delays, which would lie between, there is none. Controls follow, and forces.

    Attributes:
        batch: The simulations.
        state: Their state, [num, .].
        inputs: Controls and generalised forces, [num, nu + nv].
        sensors: Their sensor data, [num, nsensordata].
        fields: The model's fields that differ between them, by name.
    """

    def __init__(self, model: mujoco.MjModel, num: int, fields: tuple[str, ...]):
        self.batch = Batch(model, num, nthread=devices.num_cores())
        size = 1 + model.nq + model.nv + model.na + model.nv
        self.state = self.batch.state[:, :size]
        self.inputs = self.batch.state[:, size : size + model.nu + model.nv]
        self.sensors = self.batch.bind("sensordata").reshape(num, -1)
        self.fields = {name: self.batch.expand(name) for name in fields}

    def write_fields(self, values: Sequence[np.ndarray], leading: tuple[int, ...]) -> None:
        """Write the fields [.., n] and recompute what derives from those that changed."""
        stale = False
        for (name, held), value in zip(self.fields.items(), values, strict=True):
            value = _over(leading, value).reshape(held.shape)
            if (held != value).any():
                held[...] = value
                stale = stale or name in CONSTANT_INPUTS
        if stale:
            self.batch.set_const()


def _borrowed(key: tuple) -> _Simulations | None:
    """Take simulations for a model, a batch size and a set of changed fields, if any are idle."""
    with _idle_lock:
        for index in range(len(_idle) - 1, -1, -1):
            if _idle[index][0] == key:
                return _idle.pop(index)[1]
    return None


def _give_back(key: tuple, simulations: _Simulations) -> None:
    """Keep simulations for the next call."""
    with _idle_lock:
        _idle.append((key, simulations))
        del _idle[:-KEPT_BATCHES]


def _over(leading: tuple[int, ...], value: np.ndarray) -> np.ndarray:
    """Broadcast the leading axes of a value [.., n], which takes NumPy long where it has them."""
    shape = leading + value.shape[-1:]
    return value if value.shape == shape else np.broadcast_to(value, shape)


def profiling_clock() -> ctypes.c_void_p | None:
    """Return MuJoCo's pointer to the clock that it reads many times a step for `MjData.timer`.

    It is a variable of MuJoCo's library: to set it sets the clock, None takes it away. None where
    the variable cannot be reached.
    """
    try:
        bindings = mujoco._functions.__file__  # linked against the library: they find its symbols
        return ctypes.c_void_p.in_dll(ctypes.CDLL(bindings), "mjcb_time")
    except (AttributeError, OSError, ValueError):  # ValueError: there is no such symbol
        return None


@functools.cache
def _stop_profiling() -> None:
    """Take MuJoCo's clock away, unless it is the user's: to read it is up to a quarter of a step.

    `mujoco.set_mjcb_time(None)` would set the clock of MuJoCo's Python package instead. Nothing may
    step a model meanwhile, for MuJoCo looks at the pointer twice.
    """
    if mujoco.get_mjcb_time() is None and (clock := profiling_clock()):
        clock.value = None


def _log_warnings() -> None:
    """Log what MuJoCo warned of: that it is unstable for debugging, anything else once, aloud."""
    for _ in range(len(_warnings)):
        try:
            message = _warnings.popleft()
        except IndexError:  # another call logged it
            return
        what = message.partition(" Time =")[0]
        if what.startswith(UNSTABLE):
            _log.debug(message)
        elif what not in _warned:
            _warned.add(what)
            _log.warning("MuJoCo: %s", message)


def _to_words(values: jax.Array) -> jax.Array:
    """Flatten floats into 32-bit words: a callback's thread may not have 64-bit types on."""
    return jax.lax.bitcast_convert_type(values.ravel(), jnp.uint32).ravel()


def _from_words(words: jax.Array, dtype) -> jax.Array:
    if jnp.dtype(dtype).itemsize == 8:
        words = words.reshape(-1, 2)
    return jax.lax.bitcast_convert_type(words, dtype)
