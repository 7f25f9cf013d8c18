"""Turns a command line into a command, and what goes wrong into one line. No JAX."""

import contextlib
import io
import itertools
import re
import shlex
from collections.abc import Mapping, Sequence
from typing import Any, get_args, get_type_hints

import tyro

from garat_jax.errors import UserError, unknown_name

PROGRAM = "garat"
_BOX_DRAWING = re.compile(r"[\u2500-\u257f]+")


def arg(metavar: str) -> Any:
    """Name an argument's value in the help, which leaves out a default that says nothing."""

    def hint(default: str) -> str:
        return "" if default in ("", "None") else f"(default: {default})"

    return tyro.conf.arg(metavar=metavar, help_behavior_hint=hint)


def parse(arguments: Sequence[str], commands: Mapping[str, type], description: str) -> Any:
    """Make the command that the arguments name.

    Args:
        arguments: The command line without the program's name.
        commands: The dataclass of each command; its docstrings are the help.
        description: What the program does, for its help.

    Returns:
        An instance of one of the dataclasses, or None if only the help was asked for.

    Raises:
        UserError: The arguments are wrong; for a misspelt command or option, with the nearest.
    """
    if not {"--help", "-h"} & set(arguments):
        _check_spelling(arguments, commands)
        arguments = [arguments[0], *_gathered(arguments[1:], _options(commands[arguments[0]]))]
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.extras.subcommand_cli_from_dict(
                dict(commands),
                prog=PROGRAM,
                description=description,
                args=list(arguments),
                config=(tyro.conf.FlagCreatePairsOff,),
            )
    except SystemExit as stop:
        if not stop.code:
            return None
    raise UserError(_one_line(complaint.getvalue()))


def how_to_go_on(arguments: Sequence[str], commands: Mapping[str, type], begun: bool = True) -> str:
    """Return the command line that continues an interrupted one, or else starts it again.

    Args:
        arguments: The command line that was interrupted, without the program's name.
        commands: The dataclass of each command.
        begun: Whether it left something to go on with.
    """
    kept = [argument for argument in arguments if argument not in ("--force", "--resume")]
    command = commands.get(kept[0]) if kept else None
    options = _options(command) if command else {}
    is_joint = "--distributed" in kept  # by several processes, of whose run none can go on alone
    if begun and "--resume" in options and not is_joint:
        return f"go on with: {shlex.join([PROGRAM, *kept, '--resume'])}"
    if "--force" in options:
        return f"start again with: {shlex.join([PROGRAM, *kept, '--force'])}"
    return f"start again with: {shlex.join([PROGRAM, *kept])}"


def _check_spelling(arguments: Sequence[str], commands: Mapping[str, type]) -> None:
    """Raise UserError if the command or an option is not one of those that exist."""
    if not arguments:
        raise UserError(f"no command given; expected one of {', '.join(commands)}")
    name, *rest = arguments
    if name.startswith("-"):
        raise unknown_name("option", name, ["--help", "--version"])
    if name not in commands:
        raise unknown_name("command", name, commands)
    known = [*_options(commands[name]), "--help"]
    for argument in rest:
        if argument.startswith("--") and _option_in(argument) not in known:
            option = argument.partition("=")[0]
            raise unknown_name(f"option of {PROGRAM} {name}", option, known)


def _options(command: type) -> dict[str, Any]:
    """Return the type of each option of a command by its name; positionals are none."""
    hints = get_type_hints(command)
    marks = get_type_hints(command, include_extras=True)
    return {
        f"--{name.replace('_', '-')}": hint
        for name, hint in hints.items()
        if tyro.conf.Positional not in getattr(marks[name], "__metadata__", ())
    }


def _option_in(argument: str) -> str:
    """Return the option that a word of the command line names, without its value."""
    return argument.partition("=")[0].replace("_", "-")


def _gathered(words: Sequence[str], options: Mapping[str, Any]) -> list[str]:
    """Return the words with what each list option was given, here and there, in one place.

    A list option takes the words after it up to the next option.

    Raises:
        UserError: An option that takes one value is given twice, a list option without any, or an
            option that takes a number is given something else.
    """
    lists = {name: list[str]() for name, hint in options.items() if _is_list(hint)}
    others = list[str]()
    left = list(words)
    while left:
        word = left.pop(0)
        name, equals, value = _option_in(word), "=" in word, word.partition("=")[2]
        if not word.startswith("--"):
            others.append(word)
        elif name in lists:
            values = [value] if equals else list(itertools.takewhile(_is_value, left))
            if not values:
                raise UserError(f"{name}: expected one value or more after it")
            left = left if equals else left[len(values) :]
            lists[name] += values
        elif options[name] is not bool and name in map(_option_in, others):
            raise UserError(f"{name} is given twice; expected it once")
        else:
            for given in [value] if equals else filter(_is_value, left[:1]):
                _check_number(name, given, options[name])
            others.append(word)
    return [*others, *itertools.chain(*([n, *values] for n, values in lists.items() if values))]


def _is_list(hint: Any) -> bool:
    return get_args(hint)[1:] == (...,)


def _is_value(word: str) -> bool:
    return not word.startswith("--")


def _check_number(name: str, value: str, hint: Any) -> None:
    """Refuse what is no number for an option that takes one."""
    kinds = [kind for kind in (get_args(hint) or (hint,)) if kind in (int, float)]
    for kind in kinds:
        try:
            kind(value)
        except ValueError:
            wanted = "a whole number" if kind is int else "a number"
            raise UserError(f"{name} {value!r}: expected {wanted}") from None


def _one_line(complaint: str) -> str:
    """Return the first paragraph in the box that tyro draws around an error, as one line."""
    body = complaint.strip().partition("\n")[2]
    paragraph = re.split(r"^│\s*─+\s*│$", body, maxsplit=1, flags=re.MULTILINE)[0]
    return " ".join(_BOX_DRAWING.sub(" ", paragraph).split())
