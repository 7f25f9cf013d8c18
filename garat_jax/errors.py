"""Errors for which the user's input, not the program, is to blame."""

import difflib
from collections.abc import Iterable, Mapping
from typing import Any, TypeVar

Entry = TypeVar("Entry")


class UserError(ValueError):
    """Say in one line what the user's input lacks and how to mend it."""


class EarlierRunStays(KeyboardInterrupt):
    """Ctrl-C came before a run that replaces another had results; its text says where that is."""


class DivergedError(RuntimeError):
    """Say in one line at which step and seed a computation stopped being finite."""


def check_at_least(config: Any, **least: float) -> None:
    """Refuse settings that have a number below the least that it may be.

    Args:
        config: The settings.
        **least: The least of some of them.

    Raises:
        UserError: A number is smaller.
    """
    for name, number in least.items():
        if not getattr(config, name) >= number:  # NaN is none
            raise UserError(f"{name} is {getattr(config, name)}; expected {number} or more")


def nearest(name: str, known: Iterable[str], count: int = 3) -> list[str]:
    """Return the known names closest to a misspelt one, closest first.

    Args:
        name: What the user wrote.
        known: The names that exist.
        count: The largest number of names to return.

    Returns:
        At most `count` names; empty when none is similar.
    """
    originals = {candidate.casefold(): candidate for candidate in known}
    close = difflib.get_close_matches(name.casefold(), originals, n=count, cutoff=0.6)
    return [originals[match] for match in close]


def unknown_name(what: str, name: str, known: Iterable[str]) -> UserError:
    """Describe an unknown name in one line, with the nearest names or else all of them.

    Args:
        what: The kind of thing that is named, such as "environment".
        name: What the user wrote.
        known: The names that exist.
    """
    names = sorted(known)
    close = nearest(name, names)
    if close:
        return UserError(f"unknown {what} {name!r}; did you mean {' or '.join(close)}?")
    if names:
        return UserError(f"unknown {what} {name!r}; known: {', '.join(names)}")
    return UserError(f"unknown {what} {name!r}; there is none to choose from")


def choose(what: str, name: str, registry: Mapping[str, Entry]) -> Entry:
    """Return the entry that a name has in a registry.

    Args:
        what: The kind of thing that is named, such as "environment".
        name: What the user wrote.
        registry: The entries by their names.

    Raises:
        UserError: There is no such name; the message has the nearest ones.
    """
    if name not in registry:
        raise unknown_name(what, name, registry)
    return registry[name]
