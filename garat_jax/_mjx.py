"""MJX, imported without the lines that it prints where NVIDIA's Warp is not installed."""

import contextlib
import io

with contextlib.redirect_stdout(io.StringIO()):
    from mujoco import mjx

__all__ = ["mjx"]
