"""What worker processes of the benchmarks have in common."""

import multiprocessing
import os
import threading


def end_with_parent() -> None:
    """Let this worker end when the process that started it ends, however that ended.

    A worker that stays behind takes processor time from what is measured next.
    """
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_wait_and_exit, args=(parent,), daemon=True).start()


def _wait_and_exit(parent) -> None:
    parent.join()
    os._exit(1)
