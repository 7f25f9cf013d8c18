"""What every physical effect is: parameters with units and bounds, and a law."""

import abc
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple, TypeVar

import jax
import mujoco
import numpy as np
from flax import struct

from garat_jax.effects.elements import DOFS_OF_JOINT, OBJECT_TYPES, element_id, element_names
from garat_jax.errors import UserError

Named = TypeVar("Named")


class Parameter(NamedTuple):
    """One number of an effect: what it is measured in and what it may be.

    Attributes:
        name: The field's name.
        nominal: The value that means "no effect".
        unit: SI unit at a hinge joint.
        low: Smallest physically sensible value.
        high: Largest physically sensible value.
        scale: A size at which the effect is small but visible; fits start from it.
        source: Where the bounds come from.
    """

    name: str
    nominal: float
    unit: str
    low: float
    high: float
    scale: float
    source: str


class Suggestion(NamedTuple):
    """Sizes at which an effect should be tried.

    Attributes:
        starts: Values of its parameters, by name.
        num_tried: How many sizes that are not alike were looked at to find them.
    """

    starts: tuple[Mapping[str, float], ...]
    num_tried: int


def parameter(
    nominal: float, *, unit: str, low: float, high: float, scale: float, source: str
) -> Any:
    """Declare a parameter as a dataclass field; see `Parameter` for the arguments."""
    declared = Parameter("", nominal, unit, low, high, scale, source)
    return dataclasses.field(default=nominal, metadata={"parameter": declared})


class ModelView:
    """Read a model's native fields as the effects applied so far leave them.

    Attributes:
        host: The compiled MuJoCo model: sizes, names, addresses.
        changed: Fields that effects replaced, by MuJoCo's name (`opt.` for options).
        engine: What steps the model, `mjx` or `mujoco`.
    """

    def __init__(
        self,
        host: mujoco.MjModel,
        read: Callable[[str], jax.Array],
        changed: Mapping[str, jax.Array] | None = None,
        engine: str = "mujoco",
    ):
        self.host, self.engine = host, engine
        self.changed = dict(changed or {})
        self._read = read

    def __getitem__(self, name: str) -> jax.Array:
        return self.changed[name] if name in self.changed else self._read(name)

    def replace(self, changed: Mapping[str, jax.Array]) -> "ModelView":
        """Return a view in which the given fields have new values."""
        return ModelView(self.host, self._read, {**self.changed, **changed}, self.engine)

    def dofs(self, joint: str) -> np.ndarray:
        """Return the dof indices of a joint by its name."""
        index = element_id(self.host, "joint", joint)
        start = self.host.jnt_dofadr[index]
        return np.arange(start, start + DOFS_OF_JOINT[self.host.jnt_type[index]])


@struct.dataclass
class Effect(abc.ABC):
    """A physical effect at one place of a model.

    A subclass is a `flax.struct.dataclass` whose parameters are pytree leaves, so an effect can be
    fitted, batched and differentiated. It says what it does in up to five ways:
    `prepare` changes structure before the model is compiled, `fields` replaces native model
    fields (both engines), `tune` does so anew in every physics substep, `apply` changes commands
    and adds forces in every physics substep, `sense` changes what is reported of the state.

    Attributes:
        target: Where it acts: `joint/NAME`, `actuator/NAME`, `body/NAME`, `geom/NAME`, `world`,
            or `all`.
    """

    kind: ClassVar[str]
    elements: ClassVar[tuple[str, ...]]
    law: ClassVar[str]
    identified_by: ClassVar[str]
    needs: ClassVar[str] = "a hinge or slide joint"
    """What a place must be, for the message that refuses another."""
    acts: ClassVar[bool] = False
    """Whether `apply` does anything; effects that are native fields alone leave it out."""
    reads_state: ClassVar[bool] = False
    """Whether `apply` reads the physics state, which costs an engine call per substep."""
    senses: ClassVar[bool] = False
    """Whether `sense` does anything: the effect is one of sensors, not of the motion."""
    tunes: ClassVar[bool] = False
    """Whether `tune` does anything; it needs `reads_state`."""
    notes: ClassVar[bool] = False
    """Whether `note` does anything: what is reported depends on states of some time ago."""
    remembers: ClassVar[bool] = False
    """Whether `apply`'s memory reaches back further than 0.5 s: then it is followed along all the
    recorded commands before a segment. It may not read the state."""
    refines: ClassVar[tuple[str, ...]] = ()
    """Kinds that are this law with parameters left out; they come first where they do as well."""
    tables: ClassVar[tuple[str, ...]] = ()
    """Fields that are known curves, pairs of numbers: cards carry them, fits leave them alone."""
    independent: ClassVar[bool] = False
    """Whether every parameter acts alone; otherwise the first one switches the others on."""

    target: str = struct.field(pytree_node=False)

    def __init_subclass__(cls) -> None:
        """Make the kind a static field, so that two kinds at one target differ as pytrees.

        jaxlib 0.10 compares the structures of dataclasses without their types: whenever the hashes
        of two laws fell into one bucket, jit ran the program of the one with the numbers of the
        other.
        """
        super().__init_subclass__()
        if cls.tunes and not cls.reads_state:
            raise TypeError(f"{cls.__name__} tunes the model, so it must declare reads_state")
        if cls.remembers and cls.reads_state:
            raise TypeError(f"{cls.__name__} remembers commands, so it may not read the state")
        if "kind" in cls.__dict__:
            cls.__annotations__["kind"] = str
            cls.kind = struct.field(pytree_node=False, default=cls.kind, kw_only=True)

    @property
    def name(self) -> str:
        """The target without its kind: `elbow` of `joint/elbow`."""
        return self.target.partition("/")[2]

    @classmethod
    def parameters(cls) -> tuple[Parameter, ...]:
        """Return the declared parameters in order."""
        return tuple(
            field.metadata["parameter"]._replace(name=field.name)
            for field in dataclasses.fields(cls)  # pyright: ignore[reportArgumentType]
            if "parameter" in field.metadata
        )

    @classmethod
    def targets(cls, host: mujoco.MjModel) -> list[str]:
        """List every place of a model where this effect can act."""
        places = []
        for element in cls.elements:
            if element in OBJECT_TYPES:
                names = element_names(host, element)
                places += [f"{element}/{name}" for name in names if cls.fits(host, element, name)]
            else:
                places.append(element)
        return places

    @classmethod
    def fits(cls, host: mujoco.MjModel, element: str, name: str) -> bool:
        """Say whether the effect can act on a named element (hinges and slides, real bodies)."""
        if not name or name == "world":
            return False
        if element == "joint":
            return DOFS_OF_JOINT[host.joint(name).type[0]] == 1
        return True

    def excludes(self, other: "Effect") -> bool:
        """Say whether a model may have this effect or another, of another kind or place, not both.

        See `are_exclusive`.
        """
        del other
        return False

    def check(self, host: mujoco.MjModel) -> None:
        """Check the target against a model.

        Raises:
            UserError: The target is of the wrong kind, unknown, or cannot carry this effect.
        """
        element, _, name = self.target.partition("/")
        if element not in self.elements:
            wanted = " or ".join(f"{e}/NAME" if e in OBJECT_TYPES else e for e in self.elements)
            raise UserError(f"{self.kind} acts on {wanted}, not on {self.target!r}")
        if element in OBJECT_TYPES:
            element_id(host, element, name)
            if not self.fits(host, element, name):
                raise UserError(f"{self.kind} cannot act on {self.target!r}: it needs {self.needs}")

    @classmethod
    def at(cls, host: mujoco.MjModel, target: str) -> Mapping[str, float]:
        """Return the parameters that mean "no effect" at a place of a model.

        The nominal values, unless a parameter stands in place of a number of the model.
        """
        del host, target
        return {p.name: p.nominal for p in cls.parameters()}

    @classmethod
    def starts(cls, host: mujoco.MjModel, target: str) -> tuple[Mapping[str, float], ...]:
        """Return the sizes at which the effect is tried before it is fitted.

        One size of the first parameter does for laws that grow smoothly from "no effect". A law
        with a threshold shows only beyond it and is tried at several.

        Args:
            host: The compiled model: ranges of commands and forces.
            target: Where the effect would act.
        """
        first = cls.parameters()[0]
        return ({first.name: cls.at(host, target)[first.name] + first.scale},)

    @classmethod
    def opposite(cls, start: Mapping[str, float]) -> Mapping[str, float] | None:
        """Return the same parameters, to do the negative of `start`, a small one of several."""
        del start
        return None

    @classmethod
    def beside(cls, start: Mapping[str, float], given: Mapping[str, float]) -> Mapping[str, float]:
        """Return one of `starts`, adapted to parameters that a user gives."""
        return {**start, **given}

    @classmethod
    def suggested(
        cls, position: np.ndarray, torque: np.ndarray, rests: np.ndarray
    ) -> Suggestion | None:
        """Return sizes that the torque missing at its joint suggests, None if there are none.

        For laws whose place or shape `starts` cannot list.

        Args:
            position: Where the joint was measured, [M].
            torque: What the model lacks there, less what damping and dry friction explain, [M].
            rests: The same less what other laws may explain, in some ways, [K, M]; NaN where
                contacts make it what it is.
        """
        del position, torque, rests
        return None

    @classmethod
    def suggested_by_commands(cls, command: np.ndarray, torque: np.ndarray) -> Suggestion | None:
        """Return sizes that what its actuator was asked for suggests, None if there are none.

        For laws with a threshold, which `starts` can only place within what the model allows.

        Args:
            command: Of its actuator, along the recordings, [M].
            torque: What the model's actuator gives at its joint for it, N m, [M].
        """
        del command, torque
        return None

    @classmethod
    def refined_from(cls, simpler: "Effect") -> Mapping[str, float]:
        """Return the parameters that are fitted first, and with which it is like a simpler law.

        Screening may not see what a refinement adds: one with a threshold acts beyond it only. A
        law without such parameters is left to screening.

        Args:
            simpler: An effect of a kind in `refines`, with values.
        """
        del simpler
        return {}

    def export(self, spec: mujoco.MjSpec) -> str:
        """Write the effect into a spec as plain MJCF, as far as MJCF can say it.

        Args:
            spec: The model, without this effect's `prepare`.

        Returns:
            What MJCF cannot say of it, or MJX does not step, in one line; else empty.
        """
        del spec
        return f"MJCF has no words for {self.kind} at {self.target}"

    def unlock(self, spec: mujoco.MjSpec) -> None:  # noqa: B027
        """Turn off what MuJoCo's compiler assumes of the model and the effect may break.

        Unlike what `prepare` adds, this changes how the model moves, slightly, so models that are
        compared must have it alike.
        """

    def prepare(self, spec: mujoco.MjSpec) -> None:  # noqa: B027
        """Change the model's structure, before it is compiled, so that the law can act."""

    def fields(self, model: ModelView) -> dict[str, jax.Array]:
        """Return the native model fields that this effect replaces."""
        del model
        return {}

    def init(self, host: mujoco.MjModel) -> Any:
        """Return the memory that `apply` carries from one substep to the next."""
        del host
        return ()

    def apply(
        self, model: ModelView, state: Any, ctrl: jax.Array, memory: Any
    ) -> tuple[jax.Array, jax.Array | None, Any]:
        """Act in one physics substep.

        Args:
            model: The model as all effects leave it.
            state: The `PhysicsState`; None unless `reads_state`.
            ctrl: Command, [nu].
            memory: What `init` or the last substep returned.

        Returns:
            The command [nu], a generalised force or None [nv], and the new memory.
        """
        del model, state
        return ctrl, None, memory

    def tune(self, model: ModelView, state: Any, ctrl: jax.Array) -> dict[str, jax.Array]:
        """Return the native model fields that this effect replaces for one physics substep.

        MuJoCo's derived constants, as the inertia that constraints feel, do not follow them.

        Args:
            model: The model as all effects leave it, and those before this one in this substep.
            state: The `PhysicsState`; its memory is this effect's.
            ctrl: Command as the effects before this one leave it, [nu].
        """
        del model, state, ctrl
        return {}

    def note(self, host: mujoco.MjModel, state: Any, seconds: float, memory: Any) -> Any:
        """Return the memory after a control step, for `sense`; at the start `seconds` is 0.

        Args:
            host: The compiled model.
            state: The `PhysicsState` as the sensors before this effect report it.
            seconds: Time since the last call.
            memory: What `init` or the last call returned.
        """
        del host, state, seconds
        return memory

    def sense(self, host: mujoco.MjModel, state: Any, memory: Any) -> Any:
        """Return the `PhysicsState` with qpos and qvel as sensors with this effect report them."""
        del host, memory
        return state

    def as_replayed(self) -> "Effect":
        """Return an effect that does the same where recorded commands are replayed, for less."""
        return self

    def along_path(self) -> "Effect":
        """Return an effect without `tune` that does the same to first order along a given path."""
        return self


def are_exclusive(one: Effect, other: Effect) -> bool:
    """Say whether a model may have one of two effects only: of a kind there is one at a place."""
    if (one.kind, one.target) == (other.kind, other.target):
        return True
    return one.excludes(other) or other.excludes(one)


def check_together(effects: Sequence[Effect]) -> None:
    """Check that a model may have all of some effects.

    Raises:
        UserError: Two of them are exclusive.
    """
    for number, effect in enumerate(effects):
        for other in effects[:number]:
            if not are_exclusive(effect, other):
                continue
            if effect.kind == other.kind and effect.target == other.target:
                raise UserError(f"{effect.kind} is at {effect.target} twice; write it once")
            raise UserError(
                f"{other.kind} at {other.target} and {effect.kind} at {effect.target} exclude each "
                "other; write one of them"
            )
