"""The run that a folder holds while another one takes its place, and what becomes of it. No JAX.

It is put aside, and goes when the other one has ended. Where that fails or is interrupted with
nothing to show, it comes back; else both are kept until it is gone on with or started again.
"""

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from garat_jax.errors import EarlierRunStays, UserError
from garat_jax.runs import (
    CONFIG,
    CONTENTS,
    check_replaceable,
    has_ended,
    holds_results,
    is_occupied,
    not_of_run,
)


@contextlib.contextmanager
def earlier_run_kept(root: Path) -> Iterator[None]:
    """Keep the run that a folder holds until another one has ended in its place.

    Args:
        root: The folder that a run with `force` will replace.

    Raises:
        EarlierRunStays: Ctrl-C came before there were results.
        KeyboardInterrupt: It came later; says where the earlier run is.
        UserError: The folder holds something else than a run, or the current folder is within it.
    """
    root = Path(os.path.abspath(root))  # `.` has no name
    if not is_occupied(root):
        yield
        return
    check_replaceable(root)
    aside = _aside(root)
    root.rename(aside)
    try:
        yield
    except BaseException as stop:
        is_kept = holds_results(root)
        if not is_kept:
            shutil.rmtree(root, ignore_errors=True)
            aside.rename(root)
        if not isinstance(stop, KeyboardInterrupt):
            raise
        if not is_kept:
            raise EarlierRunStays(f"the earlier run stays in {root}") from None
        news = f"the earlier run is kept in {aside} until one has ended in its place"
        raise KeyboardInterrupt(news) from None
    forget_earlier(root)


def put_back_earlier(root: Path, resume: bool) -> bool:
    """Put the run back that one which was interrupted or killed was to replace.

    If that one, or another in its place, has ended all the same, the earlier run goes.

    Args:
        root: The folder of the run.
        resume: Whether to go on with what that one has, if it has results: then both stay.

    Returns:
        Whether a run was put back.

    Raises:
        UserError: Something of the user's lies there now.
    """
    root = Path(os.path.abspath(root))
    aside = _aside(root)
    if not aside.is_dir():
        return False
    others = not_of_run(root)
    if not (root / CONTENTS).exists():
        others = [path.name for path in root.glob("[!.]*") if path.name != CONFIG]
    if others or root.is_symlink() or Path.cwd().resolve().is_relative_to(root.resolve()):
        raise UserError(
            f"{aside} holds the run that was to be replaced by one that did not end, in {root}, "
            "where there is something else now, so both are left alone; move one of them away"
        )
    if has_ended(root):
        forget_earlier(root)
        return False
    if resume and holds_results(root):
        return False
    shutil.rmtree(root, ignore_errors=True)
    aside.rename(root)
    return True


def forget_earlier(root: Path) -> None:
    """Remove the run that one which has ended was to replace."""
    aside = _aside(Path(os.path.abspath(root)))
    if aside.is_dir():
        gone = aside.with_suffix(".gone")
        shutil.rmtree(gone, ignore_errors=True)
        aside.rename(gone)  # at once, so that it is whole or not there
        shutil.rmtree(gone, ignore_errors=True)


def _aside(root: Path) -> Path:
    """Return where a run is until another one has ended in its place."""
    return root.parent / f".{root.name}.replaced"
