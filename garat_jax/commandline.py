"""Turns a command line into a command, and what goes wrong into one line. No JAX."""

import contextlib
import dataclasses
import io
import re
import shlex
from collections.abc import Mapping, Sequence
from typing import Any

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
    _check_spelling(arguments, commands)
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
    options = _option_names(command) if command else []
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
    known = _option_names(commands[name])
    for argument in rest:
        option = argument.partition("=")[0]
        if option.startswith("--") and option.replace("_", "-") not in known:
            raise unknown_name(f"option of {PROGRAM} {name}", option, known)


def _option_names(command: type) -> list[str]:
    names = [field.name.replace("_", "-") for field in dataclasses.fields(command)]
    return [*(f"--{name}" for name in names), "--help"]


def _one_line(complaint: str) -> str:
    """Return the first paragraph in the box that tyro draws around an error, as one line."""
    body = complaint.strip().partition("\n")[2]
    paragraph = re.split(r"^│\s*─+\s*│$", body, maxsplit=1, flags=re.MULTILINE)[0]
    return " ".join(_BOX_DRAWING.sub(" ", paragraph).split())
