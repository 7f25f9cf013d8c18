"""Turns a command line into a command, and what goes wrong into one line. No JAX."""

import contextlib
import dataclasses
import io
import itertools
import re
import shlex
from collections.abc import Mapping, Sequence
from typing import Any, get_args, get_origin, get_type_hints

import tyro

from garat_jax.errors import UserError, unknown_name

PROGRAM = "garat"
HELP = ("--help", "-h")
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
    if not arguments or arguments[0] not in HELP:
        _check_spelling(arguments, commands)
    if not set(HELP) & set(arguments):
        arguments = [arguments[0], *_gathered(arguments[1:], commands[arguments[0]])]
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
    options = _options(commands[name])
    for argument in rest:
        is_option = argument.startswith("--") and argument not in HELP
        if is_option and _option_in(argument) not in options:
            option = argument.partition("=")[0]
            raise unknown_name(f"option of {PROGRAM} {name}", option, [*options, "--help"])


def _options(command: type) -> dict[str, Any]:
    """Return the type of each option of a command by its name; positionals are none."""
    hints = get_type_hints(command)
    marks = get_type_hints(command, include_extras=True)
    return {
        _option_named(name): hint
        for name, hint in hints.items()
        if tyro.conf.Positional not in getattr(marks[name], "__metadata__", ())
    }


def _option_named(field: str) -> str:
    return f"--{field.replace('_', '-')}"


def _option_in(argument: str) -> str:
    """Return the option that a word of the command line names, without its value."""
    return argument.partition("=")[0].replace("_", "-")


def _gathered(words: Sequence[str], command: type) -> list[str]:
    """Return the words with the positionals first, and each option once with all its values.

    An option that takes several values takes all words up to the next option.

    Raises:
        UserError: An option that takes one value is given twice, one has fewer values than it
            takes, one that takes a number is given something else, or a positional is missing.
    """
    options = _options(command)
    positionals, given = list[str](), dict[str, list[str]]()
    left = list(words)
    while left:
        word = left.pop(0)
        if not word.startswith("--"):
            positionals.append(word)
            continue
        name, (_, equals, value) = _option_in(word), word.partition("=")
        count = _num_values(options[name])
        if count is not None and count and name in given:
            raise UserError(f"{name} is given twice; expected it once")
        following = list(itertools.takewhile(lambda word: not word.startswith("--"), left))
        values = ([value] if equals else following)[:count]
        if not equals:
            del left[: len(values)]
        is_value = all(v and not v.startswith("--") for v in values)
        enough = not equals if count == 0 else len(values) >= (count or 1)
        if not enough or not is_value:
            raise UserError(f"{name}: expected {_wanted(count)} after it")
        for each in values:
            _check_number(name, each, options[name])
        given.setdefault(name, []).extend(values)
    fields = [f for f in dataclasses.fields(command) if _option_named(f.name) not in options]
    needed = [f.name.upper() for f in fields if f.default is dataclasses.MISSING]
    if missing := needed[len(positionals) :]:
        have_taken = any(len(values) > 1 for values in given.values())
        hint = "; an option that takes several values takes all words up to the next option: put "
        hint = f"{hint}{missing[0]} before it" if have_taken else ""
        raise UserError(f"missing: {', '.join(missing)}{hint}")
    return [*positionals, *itertools.chain(*([name, *values] for name, values in given.items()))]


def _num_values(hint: Any) -> int | None:
    """Return how many words an option takes; None for all that follow."""
    if hint is bool:
        return 0
    if get_origin(hint) is tuple:
        return None if ... in get_args(hint) else len(get_args(hint))
    return 1


def _wanted(count: int | None) -> str:
    return {None: "one value or more", 0: "no value", 1: "a value"}.get(count, f"{count} values")


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
