"""Ctrl-C at a moment of the program's choosing."""

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator


@contextlib.contextmanager
def deferred_interrupt() -> Iterator[Callable[[], bool]]:
    """Hold Ctrl-C back until the block ends; the block can ask whether it came.

    Python raises KeyboardInterrupt wherever the main thread happens to be. Within a compiled
    program that is the engine's callback, and XLA turns it into an internal error. A second
    Ctrl-C is not held back.

    Raises:
        KeyboardInterrupt: At the end of the block, if Ctrl-C came.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False  # only the main thread receives signals
        return
    came: list[int] = []

    def note(number: int, frame: object) -> None:
        if came:
            raise KeyboardInterrupt
        came.append(number)

    previous = signal.signal(signal.SIGINT, note)
    try:
        yield lambda: bool(came)
    finally:
        signal.signal(signal.SIGINT, previous)
    if came:
        raise KeyboardInterrupt
