"""The catalogue with a user's own effects: classes in a Python file or behind an entry point."""

import importlib.metadata
import importlib.util
import inspect
import os
import sys
import traceback
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import ModuleType

from garat_jax.effects import CATALOGUE
from garat_jax.effects.base import Effect
from garat_jax.effects.elements import OBJECT_TYPES
from garat_jax.errors import UserError, choose

ENTRY_POINTS = "garat_jax.effects"
"""Group of entry points; each names a subclass of `Effect`."""
PLACES = (*OBJECT_TYPES, "world", "all")
FLAGS = {"apply": "acts", "tune": "tunes", "sense": "senses", "note": "notes"}
"""What a class declares that has the method."""
Catalogue = Mapping[str, type[Effect]]
"""Kinds of effect by name."""


def load_catalogue(files: Sequence[str | Path] = ()) -> dict[str, type[Effect]]:
    """Return the built-in kinds, those behind entry points, and those in Python files.

    The files are run: give only those that you trust.

    Raises:
        UserError: A file fails, holds no effect, or an effect lacks what every effect declares.
    """
    catalogue = dict(CATALOGUE)
    for entry in importlib.metadata.entry_points(group=ENTRY_POINTS):
        origin = f"entry point {entry.name} ({entry.value})"
        try:
            found = entry.load()
        except Exception as error:
            raise UserError(f"{origin}: {type(error).__name__}: {error}") from error
        _add(catalogue, [found], origin)
    for file in files:
        path = Path(file)
        classes = _effects_in(run_python(path, "--effects"))
        if not classes:
            raise UserError(f"{path}: holds no effect; expected a class Mine(Effect) with a kind")
        _add(catalogue, classes, str(path))
    return catalogue


def choose_kind(kind: str, catalogue: Catalogue) -> type[Effect]:
    """Return the effect of a catalogue that has a name.

    Raises:
        UserError: There is none.
    """
    try:
        return choose("effect", kind, catalogue)
    except UserError as error:
        raise UserError(f"{error} (--effects FILE.py adds others)") from None


def run_python(path: Path, option: str) -> ModuleType:
    """Run a user's Python file, and return what it defines.

    Args:
        path: The file.
        option: The option that named it.

    Raises:
        UserError: It is not there or fails; one line says where.
    """
    if not path.is_file():
        raise UserError(f"{option}: there is no file {path}")
    if path.suffix != ".py":
        raise UserError(f"{option} {path}: expected a Python file (.py)")
    name = f"garat_user_{option.strip('-')}_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise UserError(f"{option} {path}: Python cannot load it")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up there
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        del sys.modules[name]
        raise UserError(f"{path}{line_in(path, error)}: {type(error).__name__}: {error}") from error
    return module


def line_in(path: str | Path, error: BaseException) -> str:
    """Return the last line of a file that an error came through, as ` line N`, or nothing."""
    if isinstance(error, SyntaxError):
        return f" line {error.lineno}" if error.lineno else ""  # a file with a NUL has none
    whole = os.path.abspath(path)  # as importlib names it
    frames = [f for f in traceback.extract_tb(error.__traceback__) if f.filename == whole]
    return f" line {frames[-1].lineno}" if frames else ""


def _effects_in(module: ModuleType) -> list[type[Effect]]:
    members = [member for _, member in inspect.getmembers(module, inspect.isclass)]
    own = [member for member in members if member.__module__ == module.__name__]
    return [member for member in own if issubclass(member, Effect)]


def _add(catalogue: dict[str, type[Effect]], classes: Iterable[type[Effect]], origin: str) -> None:
    for cls in classes:
        _check(cls, origin)
        if cls.kind in catalogue:
            raise UserError(
                f"{origin}: there is an effect {cls.kind!r} already; give it another name"
            )
        catalogue[cls.kind] = cls


def _check(cls: type[Effect], origin: str) -> None:
    """Refuse a class that does not say what every effect says."""
    if not inspect.isclass(cls) or not issubclass(cls, Effect):
        raise UserError(f"{origin}: {cls!r} is no subclass of garat_jax.effects.Effect")
    declared = vars(cls)
    if "__dataclass_fields__" not in declared:
        raise UserError(f"{origin}: {cls.__name__} needs the decorator flax.struct.dataclass")
    for name in ("kind", "law", "identified_by"):
        if not isinstance(declared.get(name), str) or not declared[name]:
            raise UserError(f'{origin}: {cls.__name__} lacks {name}; write {name} = "..."')
    elements = declared.get("elements")
    if not isinstance(elements, tuple) or not elements or not set(elements) <= set(PLACES):
        raise UserError(
            f"{origin}: {cls.__name__}.elements is {elements!r}; expected a tuple of "
            f"{', '.join(PLACES)}"
        )
    for method, flag in FLAGS.items():
        if getattr(cls, method) is not getattr(Effect, method) and not getattr(cls, flag):
            raise UserError(
                f"{origin}: {cls.__name__} has {method}, which is not called; write {flag} = True"
            )
    if not cls.parameters():
        raise UserError(f"{origin}: {cls.__name__} has no parameter; declare one by parameter(...)")
    for p in cls.parameters():
        if not p.low < p.high:
            raise UserError(
                f"{origin}: {p.name} of {cls.__name__} goes from {p.low:g} to {p.high:g}; expected "
                "low below high"
            )
        if not p.low <= p.nominal <= p.high:
            raise UserError(
                f"{origin}: {p.name} of {cls.__name__} means no effect at {p.nominal:g}, outside "
                f"its bounds {p.low:g} to {p.high:g}"
            )
