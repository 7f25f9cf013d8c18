"""What commands share: checks of files, and the run directory. No JAX."""

import contextlib
import dataclasses
import shlex
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from garat_jax.commandline import PROGRAM
from garat_jax.errors import UserError
from garat_jax.interrupt import interruptible
from garat_jax.terminal import complain

if TYPE_CHECKING:
    from garat_jax.runs import RunDirectory

LARGEST_SEED = 2**31 - 1
"""Seeds are 32-bit integers in JAX; larger ones would draw what smaller ones do."""


@contextlib.contextmanager
def make_run(
    command: Any, out: Path, seeds: Sequence[int] = (), resume: bool | None = None
) -> Iterator["RunDirectory"]:
    """Make the run directory of a command; the command's fields are the run's config.

    Wrong input that shows only within the block leaves no empty run behind, and an earlier run that
    --force would have replaced stays.

    Args:
        command: A command with a field `force`.
        out: The folder.
        seeds: The seeds of the run, one after the other from the one that --seed gives.
        resume: Go on with the run that the folder holds; None if the command cannot.

    Raises:
        UserError: A seed is out of range, or the folder may not be written.
    """
    from garat_jax.earlier_run import earlier_run_kept, forget_earlier, put_back_earlier
    from garat_jax.runs import RunDirectory

    largest = LARGEST_SEED + 1 - len(seeds)
    if seeds and not 0 <= seeds[0] <= largest:
        raise UserError(f"--seed {seeds[0]}: expected 0 to {largest}")
    config = {
        field.name: getattr(command, field.name)
        for field in dataclasses.fields(command)
        if field.name not in ("out", "force", "resume")
    }
    line = shlex.join([PROGRAM, *sys.argv[1:]])
    replaces = command.force and not resume
    if replaces:
        _check_outside(command, out)
    if (command.force or resume) and put_back_earlier(out, bool(resume)):
        complain(f"put the run back in {out} that one which did not end was to replace", 0)
    with earlier_run_kept(out) if replaces else contextlib.nullcontext():
        run = RunDirectory.create(out, config, line, seeds, force=command.force, resume=resume)
        if resume and not run.resumed:
            complain(f"{out} holds no run to go on with; starting one", 0)
        if run.resumed and (changed := run.changed_versions()):
            complain(f"warning: the run was begun with other versions: {', '.join(changed)}", 0)
        try:
            with interruptible():
                yield run
        except (UserError, RuntimeError):
            run.discard()
            raise
        run.note_files()
    if resume:
        forget_earlier(out)


def _check_outside(command: Any, out: Path) -> None:
    """Refuse input that lies in the folder that --force is about to replace."""
    given = {f.name: getattr(command, f.name) for f in dataclasses.fields(command)}
    given |= {"out": None, "recordings": tuple(getattr(command, "recordings", tuple)())}
    for values in given.values():
        for path in values if isinstance(values, tuple) else (values,):
            if isinstance(path, Path) and path.resolve().is_relative_to(out.resolve()):
                raise UserError(f"{path} is in {out}, which --force replaces; give another --out")


def check_files(paths: Sequence[Path], what: str) -> None:
    """Refuse an empty list of files and files that are not there."""
    if not paths:
        raise UserError(f"{what}: expected one file or more")
    for path in paths:
        if path.is_dir():
            raise UserError(f"{what}: {path} is a folder; name the files in it")
        if not path.is_file():
            raise UserError(f"{what}: there is no file {path}")


def check_once(paths: Sequence[Path]) -> None:
    """Refuse a recording that is given twice: it would count as evidence twice."""
    seen = set[Path]()
    for path in paths:
        if path.resolve() in seen:
            raise UserError(f"{path} is given twice; expected each recording once")
        seen.add(path.resolve())


def check_optional(path: Path | None, option: str) -> None:
    """Refuse a file that is named and not there."""
    if path is not None:
        check_files([path], option)


@contextlib.contextmanager
def writing(path: Path, suffix: str, force: bool) -> Iterator[None]:
    """Make sure that an output file can be written, before what takes long.

    Folders that are made for it are removed again if the block fails.

    Raises:
        UserError: It is of another kind, there already without --force, or cannot be written.
    """
    if path.suffix.lower() != suffix:
        raise UserError(f"--out {path}: expected a name that ends in {suffix}")
    if path.is_dir():
        raise UserError(f"--out {path} is a folder; expected a file")
    if path.exists() and not force:
        raise UserError(f"{path} exists already: give --force to replace it, or another --out")
    new = [folder for folder in path.parents if not folder.exists()]
    try:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=path.parent):
                pass
            if path.exists():
                path.open("r+b").close()
        except OSError as error:
            raise UserError(f"--out {path} cannot be written: {error}") from error
        yield
    except BaseException:
        for folder in new:
            with contextlib.suppress(OSError):
                folder.rmdir()
        raise
