"""Models to diagnose: an MJCF file, or a card that adds overrides and effects to one.

A card (TOML, format "garat-model/1") names an MJCF file in its own folder, `[[override]]` tables
with `element name field value`, and `[[effect]]` tables with `kind target parameters`.
"""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from garat_jax.diagnosis.own_effects import try_choices, try_own
from garat_jax.dynamics import Dynamics, Override, compile
from garat_jax.effects import CATALOGUE, Effect, check_together
from garat_jax.effects.bounds import check_bounds
from garat_jax.effects.catalogue import Catalogue, choose_kind, load_catalogue
from garat_jax.effects.elements import element_names
from garat_jax.env import Task, TaskEnv, Transform, World
from garat_jax.errors import UserError, unknown_name
from garat_jax.files import read_toml, write_whole
from garat_jax.overrides import load_spec

FORMAT = "garat-model/1"
CARD_KEYS = ("format", "mjcf", "override", "effect")
OVERRIDE_KEYS = ("element", "name", "field", "value")
SAME_INTERVAL = 0.1
"""Part of a control step by which another may differ for an action transformer to act in it."""
EFFECT_KEYS = ("kind", "target", "parameters")


@dataclasses.dataclass(frozen=True)
class Model:
    """A model with overrides and effects.

    Attributes:
        name: The file's name without its ending.
        path: The file that was read: MJCF or card.
        mjcf: The MJCF file.
        spec: MuJoCo's editable model.
        overrides: Changes of the model before it is compiled.
        effects: Physical effects added to it.
        catalogue: The kinds of effect that a diagnosis may find missing in it.
        transform: A learned action transformer, (qpos and qvel as the sensors report them
            [nq + nv], command [nu]) -> command sent instead. Predictions and `world` have it,
            `compile` does not.
        interval: Seconds of the control steps that it was learned on, for which predictions hold
            what it sends; None without it.
    """

    name: str
    path: Path
    mjcf: Path
    spec: mujoco.MjSpec = dataclasses.field(repr=False)
    overrides: tuple[Override, ...] = ()
    effects: tuple[Effect, ...] = ()
    catalogue: Catalogue = dataclasses.field(default_factory=lambda: CATALOGUE, repr=False)
    transform: Transform | None = None
    interval: float | None = None

    def compile(self, engine: str = "auto", extra_effects: Sequence[Effect] = ()) -> Dynamics:
        """Compile the model, with more effects than its own; see `dynamics.compile`."""
        effects = (*self.effects, *extra_effects)
        try_own(self.spec, self.overrides, effects)
        return compile(self.spec, self.overrides, effects, engine)

    def with_effects(self, effects: Sequence[Effect]) -> "Model":
        """Return the model with more effects, each in the place of one of its kind and target."""
        return dataclasses.replace(self, effects=(*self.without(effects).effects, *effects))

    def without(self, effects: Sequence[Effect]) -> "Model":
        """Return the model less what it has of the kinds and at the targets of some effects."""
        gone = {(effect.kind, effect.target) for effect in effects}
        kept = (effect for effect in self.effects if (effect.kind, effect.target) not in gone)
        return dataclasses.replace(self, effects=tuple(kept))

    def world(self, task: Task, engine: str = "auto") -> World:
        """Return a task in this model, to train in: with its effects, and its action transformer.

        A transformer acts once a control step of the task, which has to last as long as those that
        it was learned on, `SAME_INTERVAL` apart at most.

        Args:
            task: What to do; its own model may differ in all but joints and actuators.
            engine: As for `dynamics.compile`.

        Raises:
            UserError: The task's own model has other joints or actuators, its control steps another
                length than the transformer's or than its reward counts on, or as `compile`.
        """
        params = self.compile(engine)
        own = compile(load_spec(task.mjcf), engine="mujoco").host.model
        check_same_machine(self.path, params.host.model, task.mjcf, own)
        lasts = task.num_substeps * params.host.model.opt.timestep
        learned = self.interval if self.transform else None
        if learned and abs(lasts - learned) > SAME_INTERVAL * learned:
            raise UserError(
                f"{self.path}: its action transformer was learned on control steps of "
                f"{learned:.4g} s, the task's last {lasts:.4g} s; give garat ground "
                f"--interval {lasts:.4g}, or the task other num_substeps"
            )
        return World(TaskEnv(task, params, self.transform), params)


def check_same_machine(
    path: Path, model: mujoco.MjModel, other_path: Path, other: mujoco.MjModel
) -> None:
    """Refuse a model whose joints or actuators have other names than another's.

    Raises:
        UserError: They have.
    """
    for element in ("joint", "actuator"):
        there, wanted = element_names(model, element), element_names(other, element)
        if wanted != there:
            raise UserError(
                f"{path}: its {element}s are {', '.join(there) or 'none'}, those of "
                f"{other_path} {', '.join(wanted) or 'none'}; expected models of the same machine"
            )


def check_model(model: Model) -> None:
    """Refuse anything but a model, as its path is.

    Raises:
        UserError: It is something else.
    """
    if not isinstance(model, Model):
        raise UserError(f"expected a model, not {model!r}; load_model(path) reads one")


def load_model(path: str | Path, catalogue: Catalogue | None = None) -> Model:
    """Read an MJCF file (.xml) or a model card (.toml).

    Args:
        path: The file.
        catalogue: The kinds of effect that there are: by default the built-in ones and those behind
            entry points; `load_catalogue` adds a user's own.

    Raises:
        UserError: The file cannot be read, the card names something that does not exist, or the
            catalogue is none.
    """
    path = Path(path)
    catalogue = load_catalogue() if catalogue is None else catalogue
    if not isinstance(catalogue, Mapping):
        raise UserError(
            f"catalogue is {catalogue!r}; expected effects by kind: load_catalogue([FILE]), or "
            "{kind: CATALOGUE[kind]} for a few"
        )
    suffix = path.suffix.lower()
    if suffix not in (".xml", ".toml"):
        raise UserError(f"{path}: expected an MJCF file (.xml) or a model card (.toml)")
    card = read_toml(path, FORMAT, CARD_KEYS) if suffix == ".toml" else {}
    mjcf = _mjcf_of(path, card) if suffix == ".toml" else path
    spec = load_spec(mjcf)
    try:
        overrides = tuple(_override(table) for table in _tables(card, "override"))
        _check_once(overrides)
        effects = tuple(_effect(table, catalogue) for table in _tables(card, "effect"))
        host = compile(spec, overrides, engine="mujoco").host.model
        for effect in effects:
            effect.check(host)
            check_bounds(effect, host)
        try_choices(effects, host)
        check_together(effects)
    except UserError as error:
        raise UserError(f"{path}: {error}") from error
    return Model(path.stem, path, mjcf, spec, overrides, effects, catalogue)


def save_card(path: str | Path, model: Model, extra_effects: Sequence[Effect] = ()) -> Path:
    """Write a model, with more effects, as a card.

    Args:
        path: The card; the model's MJCF has to lie in its folder or below.
        model: The model.
        extra_effects: Effects to add after the model's own.

    Returns:
        The path of the card.

    Raises:
        UserError: The card would lie outside the folder of the model's MJCF, or is no .toml file.
    """
    check_model(model)
    path = Path(path)
    mjcf = mjcf_in_card(path, model)
    lines = [f"format = {_toml(FORMAT)}", f"mjcf = {_toml(mjcf)}"]
    for override in model.overrides:
        lines += ["", "[[override]]"]
        lines += [f"{key} = {_toml(getattr(override, key))}" for key in OVERRIDE_KEYS]
    for effect in (*model.effects, *extra_effects):
        names = [p.name for p in effect.parameters()]
        names += [name for name in effect.tables if getattr(effect, name)]
        values = (f"{name} = {_toml(getattr(effect, name))}" for name in names)
        lines += ["", "[[effect]]", f"kind = {_toml(effect.kind)}"]
        lines += [f"target = {_toml(effect.target)}", f"parameters = {{ {', '.join(values)} }}"]
    return write_whole(path, "\n".join(lines) + "\n")


def mjcf_in_card(path: Path, model: Model) -> str:
    """Return how a card at `path` would name the model's MJCF.

    Raises:
        UserError: The card would lie outside the folder of the model's MJCF, or is no .toml file.
    """
    if path.suffix.lower() != ".toml":
        raise UserError(f"{path}: a model card's name ends in .toml")
    folder, mjcf = path.parent.resolve(), model.mjcf.resolve()
    if not mjcf.is_relative_to(folder):
        raise UserError(
            f"{path}: a card may not leave its folder, and {model.mjcf} is not in it; "
            f"write the card to {model.mjcf.parent} or copy the model first"
        )
    return mjcf.relative_to(folder).as_posix()


def _mjcf_of(path: Path, card: Mapping[str, Any]) -> Path:
    name = card.get("mjcf")
    if not isinstance(name, str) or not name:
        raise UserError(
            f'{path}: mjcf is missing; expected mjcf = "FILE.xml", relative to the card'
        )
    if Path(name).suffix.lower() != ".xml":
        raise UserError(f"{path}: mjcf = {name!r}; expected an MJCF file (.xml)")
    mjcf = path.parent / name
    if Path(name).is_absolute() or not mjcf.resolve().is_relative_to(path.parent.resolve()):
        raise UserError(
            f"{path}: mjcf = {name!r} leaves the card's folder; put the model beside it"
        )
    return mjcf


def _tables(card: Mapping[str, Any], key: str) -> list[dict[str, Any]]:
    tables = card.get(key, [])
    if not isinstance(tables, list) or not all(isinstance(table, dict) for table in tables):
        raise UserError(f"{key} is no list of tables; write each as [[{key}]]")
    return tables


def _check_keys(table: Mapping[str, Any], what: str, keys: tuple[str, ...]) -> None:
    for key in table:
        if key not in keys:
            raise unknown_name(f"key of an {what}", key, keys)
    for key in keys:
        if key not in table:
            raise UserError(f"[[{what}]] lacks {key}; expected {', '.join(keys)}")


def _override(table: dict[str, Any]) -> Override:
    # The options of a model have no name.
    table = {"name": "", **table} if table.get("element") == "option" else table
    _check_keys(table, "override", OVERRIDE_KEYS)
    for key in ("element", "name", "field"):
        if not isinstance(table[key], str):
            raise UserError(f"[[override]] {key} = {table[key]!r}; expected a name")
    return Override(**table)


def _check_once(overrides: Sequence[Override]) -> None:
    places = [override.place for override in overrides]
    for number, place in enumerate(places):
        if place in places[:number]:
            raise UserError(f"{place} is overridden twice; write it once")


def _effect(table: dict[str, Any], catalogue: Catalogue) -> Effect:
    _check_keys(table, "effect", EFFECT_KEYS)
    kind, target, parameters = (table[key] for key in EFFECT_KEYS)
    if not isinstance(kind, str) or not isinstance(target, str) or not isinstance(parameters, dict):
        raise UserError("[[effect]] needs names for kind and target and a table of parameters")
    return make_effect(choose_kind(kind, catalogue), target, parameters)


def make_effect(cls: type[Effect], target: str, parameters: Mapping[str, Any]) -> Effect:
    """Make an effect from the numbers, and the pairs of its tables, that a user gave.

    Raises:
        UserError: A parameter is unknown or no finite number, or a table is no list of pairs.
    """
    known = [*(parameter.name for parameter in cls.parameters()), *cls.tables]
    values = {}
    for name, value in parameters.items():
        if name not in known:
            raise unknown_name(f"parameter of {cls.kind}", name, known)
        if name in cls.tables:
            values[name] = _pairs(f"{cls.kind} {name}", value)
        elif _is_finite(value):
            values[name] = float(value)
        else:
            raise UserError(f"{cls.kind} {name} = {value!r}; expected a finite number")
    return cls(target=target, **values)


def _is_finite(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and np.isfinite(value)


def _pairs(what: str, value: Any) -> tuple[tuple[float, float], ...]:
    rows = value if isinstance(value, list) else [value]
    for row in rows:
        if not isinstance(row, list) or len(row) != 2 or not all(map(_is_finite, row)):
            raise UserError(
                f"{what} has {row!r}; expected pairs of finite numbers, such as [[0, 0], [2, 1.5]]"
            )
    return tuple((float(first), float(second)) for first, second in rows)


def _toml(value: Any) -> str:
    """Write a string, truth value, number or list of these as TOML."""
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return str(value)
    array = np.asarray(value, float)
    return "[" + ", ".join(map(_toml, array)) + "]" if array.ndim else repr(float(array))
