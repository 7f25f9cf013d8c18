"""Ctrl-C, or a request to terminate, at a moment that the program can stand.

SIGTERM, which batch systems and containers send before they kill, counts as Ctrl-C.

Python raises KeyboardInterrupt wherever the main thread happens to be. While XLA runs a program,
that may be in a Python function which C entered (host_call.py): what is raised at its first line
never reaches the caller, which goes on with a result that was not written, and raised at its last
line it leaves C's memory in disorder. There Ctrl-C is held until the function can say so itself.
What is raised in the garbage collector's callbacks, of which JAX has one, Python drops.
"""

import contextlib
import gc
import signal
import threading
from collections.abc import Callable, Iterator
from types import CodeType, FrameType
from typing import Any, TypeVar

Function = TypeVar("Function", bound=Callable)

SIGNALS = (signal.SIGINT, signal.SIGTERM)
"""What ends a program that may still put its files in order."""

_entered_from_c: set[CodeType] = set()
_held = threading.Event()


def entered_from_c(function: Function) -> Function:
    """Declare a function that C enters; it shall call `raise_held` where it can raise."""
    _entered_from_c.add(function.__code__)
    return function


def raise_held() -> None:
    """Raise KeyboardInterrupt if Ctrl-C came and did not end the block."""
    if _held.is_set():
        raise KeyboardInterrupt


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Let Ctrl-C end the block, but never within a function that C entered.

    Raises:
        KeyboardInterrupt: Ctrl-C came; also where XLA made a RuntimeError of it.
    """
    with _handled_by(_interrupt):
        yield


@contextlib.contextmanager
def deferred_interrupt() -> Iterator[Callable[[], bool]]:
    """Hold Ctrl-C back until the block ends; the block can ask whether it came.

    A second Ctrl-C is held back no longer than `interruptible` does.

    Raises:
        KeyboardInterrupt: At the end of the block, if Ctrl-C came.
    """
    came: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        if came:
            _interrupt(number, frame)
        came.append(number)

    with _handled_by(note):
        yield lambda: bool(came)
    if came:
        raise KeyboardInterrupt


def _interrupt(number: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt, but within a function that C entered.

    It is held for `raise_held` in any case: what is raised may be lost elsewhere, too.
    """
    del number
    _held.set()
    collecting = {getattr(callback, "__code__", None) for callback in gc.callbacks}
    while frame is not None:
        if frame.f_code in _entered_from_c or frame.f_code in collecting:
            return
        frame = frame.f_back
    raise KeyboardInterrupt


def _is_ours_to_take(number: int, handler: Any) -> bool:
    """Say whether a signal is neither ignored nor, as SIGTERM by job schedulers, used already."""
    if handler in (signal.SIG_IGN, None):
        return False
    is_ours = getattr(handler, "__module__", None) == __name__  # an outer block's
    return number == signal.SIGINT or handler == signal.SIG_DFL or is_ours


@contextlib.contextmanager
def _handled_by(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """Handle signals; none that is ignored, as in a script's background, and none in a thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    previous = {number: signal.getsignal(number) for number in SIGNALS}
    previous = {number: old for number, old in previous.items() if _is_ours_to_take(number, old)}
    for number in previous:
        signal.signal(number, handler)
    try:
        yield
        raise_held()
    except RuntimeError as error:  # XLA's, of what `raise_held` raised
        if not _held.is_set():
            raise
        raise KeyboardInterrupt from error
    finally:
        for number, old in previous.items():
            signal.signal(number, old)
        _held.clear()
