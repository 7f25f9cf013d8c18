"""The one host loop: compile, step, evaluate, log, checkpoint, resume, and stop on NaN."""

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from rich.console import Console

from garat_jax import checkpoint, split
from garat_jax.devices import peak_mebibytes
from garat_jax.env import EnvState
from garat_jax.errors import DivergedError, UserError
from garat_jax.interrupt import deferred_interrupt
from garat_jax.rollout import Fault
from garat_jax.runs import SECONDS, RunDirectory
from garat_jax.types import Metrics

State = TypeVar("State")

CHECKPOINT_SECONDS = 60.0
REPORT_SECONDS = 5.0
LARGEST_FAULTY_SHARE = 0.01
"""Share of a batch's steps in which physics may leave the finite numbers before training stops."""
FAULTY = "faulty_share"
SHOWN = {
    "evaluation": "return",
    "reward": "reward a step",
    "episode_length": "steps an episode",
    "discriminator_accuracy": "discriminator's accuracy",
    "error_ratio": "error of one step, share of the source's",
}
"""Metrics that are printed, and what they are called there."""


def _console() -> Console:
    """Return a console on stderr that leaves lines as they are."""
    return Console(stderr=True, soft_wrap=True, highlight=False)


@dataclasses.dataclass
class Seconds:
    """Wall time so far, that of the processes that a resumed run had before included.

    Attributes:
        compile: Spent tracing and compiling.
        run: Spent stepping, logging and checkpointing.
    """

    compile: float = 0.0
    run: float = 0.0


@dataclasses.dataclass(frozen=True)
class Trainer:
    """What the stages of one run share.

    Attributes:
        run: Where metrics and checkpoints go.
        seeds: The seeds, in the order of the leading axis of every state.
        seconds: Wall time, added up over the stages.
        console: Where progress goes.
        mesh: The devices that programs run on; None for one.
    """

    run: RunDirectory
    seeds: Sequence[int]
    seconds: Seconds = dataclasses.field(default_factory=Seconds)
    console: Console = dataclasses.field(default_factory=_console)
    mesh: Mesh | None = None

    def __post_init__(self) -> None:
        """Add the time that earlier processes of a resumed run took."""
        if self.run.resumed and (self.run.root / SECONDS).exists():
            before = Seconds(**self.run.read_json(SECONDS))
            self.seconds.compile += before.compile
            self.seconds.run += before.run

    def train(
        self,
        stage: str,
        step: Callable[[State, Any], tuple[State, dict[str, jax.Array]]],
        state: State,
        params: Any,
        num_iterations: int,
        options: dict[str, Any] | None = None,
    ) -> State:
        """Step a batch of learners until they have done `num_iterations`.

        Metrics go to `metrics.jsonl`, one line an iteration. A checkpoint is written each minute,
        at the end, and on an interrupt, with the time so far; a resumed run goes on from the
        newest.

        Args:
            stage: Name of this part of the run.
            step: `(state, params) -> (state, metrics)`; metrics are [seeds], and an entry
                `finished` that is true for all seeds ends the stage early.
            state: Where to start, leading axis [seeds].
            params: Passed on to every step.
            num_iterations: How many steps.
            options: XLA's compiler options.

        Raises:
            DivergedError: A learner stopped being finite, or its worlds left the finite numbers too
                often.
            UserError: The newest checkpoint is damaged, or the run was not opened to be resumed.
        """
        folder = self.run.path(f"checkpoints/{stage}")
        first = 0
        if (latest := checkpoint.latest_step(folder)) is not None:
            if not self.run.resumed:
                raise UserError(
                    f"{self.run.root} holds {stage!r} already: open it by RunDirectory.create(..., "
                    "resume=True) to go on with it, or give a new run directory"
                )
            state, first = checkpoint.restore(folder, state), latest
            self.console.print(f"{stage}: restored after iteration {first}")
        if self._was_over(stage, first):
            return state
        if self.run.resumed:
            self.run.rewind(first, stage)
        compiled, run = self._compile(_with_finite(step), (state, params), options)
        self.console.print(f"{stage}: memory {_memory(compiled)}")
        return self._loop(stage, run, state, params, first, num_iterations)

    def _was_over(self, stage: str, iteration: int) -> bool:
        """Say whether a stage ended after so many iterations, rather than after more."""
        done = _done(stage)
        if not (self.run.root / done).exists():
            return False
        return iteration >= self.run.read_json(done)["iterations"]

    def call(self, function: Callable, *arguments: Any, options: dict[str, Any] | None = None):
        """Compile a function, call it once, and return its result when it is there."""
        _, run = self._compile(function, arguments, options)
        started = time.monotonic()
        with deferred_interrupt():
            result = jax.block_until_ready(run(*arguments))
        self._spent(started)
        return result

    def _spent(self, started: float) -> float:
        """Count the time since `started`, write it down, and return when that was."""
        now = time.monotonic()
        self.seconds.run += now - started
        self.run.write_json(SECONDS, self.seconds)
        return now

    def _compile(self, function: Callable, arguments: tuple, options: dict[str, Any] | None):
        started = time.monotonic()
        if self.mesh is not None:
            compiled, run = split.compile_on(self.mesh, function, arguments, options)
        else:
            run = compiled = jax.jit(function, compiler_options=options).lower(*arguments).compile()
        self.seconds.compile += time.monotonic() - started
        return compiled, run

    def _loop(self, stage, step, state, params, first: int, num_iterations: int):
        folder = self.run.path(f"checkpoints/{stage}")
        saved = reported = time.monotonic()
        progress = (first, state)  # one name, so that an interrupt never parts the two
        is_over, is_finished = first >= num_iterations, False
        try:
            with deferred_interrupt() as interrupted:
                while not is_over and not interrupted():
                    iteration, last = progress[0] + 1, progress[1]
                    new, metrics, finite = step(last, params)
                    metrics = {name: np.asarray(value) for name, value in metrics.items()}
                    self._check(stage, iteration, last, new, metrics, np.asarray(finite))
                    self.run.log(iteration, stage=stage, **metrics)
                    progress = (iteration, new)
                    is_finished = "finished" in metrics and bool(metrics["finished"].all())
                    is_over = is_finished or iteration >= num_iterations
                    now = time.monotonic()
                    if now - reported > REPORT_SECONDS:
                        reported = now
                        self._report(stage, iteration, num_iterations, metrics)
                    if now - saved > CHECKPOINT_SECONDS and not is_over:
                        self._save(folder, *progress)
                        saved = self._spent(saved)
        except KeyboardInterrupt:
            self._keep(stage, *progress, is_over)
            raise
        else:
            self._keep(stage, *progress, is_over)
        finally:
            self._spent(saved)
        how = "solved by every seed" if is_finished else "done"
        self.console.print(f"{stage}: {how} after {progress[0]} iterations")
        return progress[1]

    def _keep(self, stage: str, iteration: int, state, is_over: bool) -> None:
        """Save a stage as it is left: over, or to be resumed."""
        if is_over:
            # First: a process that is killed in between does the last iterations again. With the
            # checkpoint alone it would not know that every seed has solved its task.
            self.run.write_json(_done(stage), {"iterations": iteration})
        self._save(self.run.path(f"checkpoints/{stage}"), iteration, state)

    def _save(self, folder, iteration: int, state) -> None:
        latest = checkpoint.latest_step(folder)
        if latest is None or iteration > latest:
            checkpoint.save(folder, iteration, state)

    def _report(self, stage: str, iteration: int, of: int, metrics) -> None:
        shown = [
            f"{SHOWN[name]} {value.mean():,.4g}" for name, value in metrics.items() if name in SHOWN
        ]
        self.console.print(", ".join([f"{stage}: {iteration} of {of}", *shown]))

    def _check(self, stage: str, iteration: int, last, new, metrics, finite: np.ndarray) -> None:
        """Stop where a learner is not finite or its worlds fail too often; warn where one does."""
        if not finite.all():
            self._diverged(stage, iteration, last, new, ~finite, "stopped being finite at")
        shares = [value for name, value in metrics.items() if name.endswith(FAULTY)]
        share = np.max(shares, axis=0) if shares else np.zeros(len(self.seeds))
        if np.any(share > LARGEST_FAULTY_SHARE):
            what = f"{_too_many(share)} of"
            self._diverged(stage, iteration, last, new, share > LARGEST_FAULTY_SHARE, what)
        self._warn_of_faults(stage, share, f"the steps of iteration {iteration}")

    def check_faults(self, what: str, share: np.ndarray) -> None:
        """Warn of what was done outside of a stage where it had faulty steps.

        Args:
            what: Its name.
            share: Share of its steps in which physics left the finite numbers, [seeds].

        Raises:
            DivergedError: The share is above `LARGEST_FAULTY_SHARE`.
        """
        if np.any(share > LARGEST_FAULTY_SHARE):
            seeds = self._named(share > LARGEST_FAULTY_SHARE)
            raise DivergedError(f"{what}: seed {seeds} {_too_many(share)}")
        self._warn_of_faults(what, share, "the steps")

    def _warn_of_faults(self, what: str, share: np.ndarray, steps: str) -> None:
        if np.any(share > 0):
            self.console.print(
                f"{what}: warning: physics left the finite numbers in "
                f"{100 * share.max():.2g} % of {steps}; those episodes were ended",
            )

    def _named(self, bad: np.ndarray) -> str:
        """Return the seeds that are bad [seeds]."""
        return ", ".join(str(seed) for seed, is_bad in zip(self.seeds, bad, strict=True) if is_bad)

    def _diverged(self, stage: str, iteration: int, last, new, bad: np.ndarray, what: str):
        """Leave the last finite state and the offending one, and say where they are."""
        self._save(self.run.path(f"checkpoints/{stage}"), iteration - 1, last)
        leaves = jax.tree_util.tree_flatten_with_path(new)[0]
        arrays = {
            jax.tree_util.keystr(path): np.asarray(leaf)
            for path, leaf in leaves
            if not jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        }
        path = self.run.path(f"diverged/{stage}-{iteration}.npz")
        np.savez_compressed(path, allow_pickle=False, **arrays)
        raise DivergedError(
            f"{stage}: seed {self._named(bad)} {what} iteration {iteration}; "
            f"the last finite state is in checkpoints/{stage}, the offending one, with the first "
            f"faulty step before and after, in {path}"
        )


def _memory(compiled: jax.stages.Compiled) -> str:
    """Say how much memory a program takes while it runs, and this process at most so far."""
    process = f"{peak_mebibytes():.0f} MiB of this process so far"
    sizes = compiled.memory_analysis()
    if sizes is None:  # not every backend says
        return process
    held = sizes.argument_size_in_bytes + sizes.output_size_in_bytes
    return (
        f"{held / 2**20:.1f} MiB of states and {sizes.temp_size_in_bytes / 2**20:.1f} MiB more "
        f"within an iteration, {process}"
    )


def _too_many(share: np.ndarray) -> str:
    return (
        f"saw physics leave the finite numbers in {100 * share.max():.3g} % of the steps "
        f"(up to {100 * LARGEST_FAULTY_SHARE:g} % is let pass)"
    )


def _done(stage: str) -> str:
    """Return the file that says after how many iterations a stage is over."""
    return f"stages/{stage}.json"


def _with_finite(step):
    """Add to a step's results whether each seed's learner is finite in all its floats, [seeds].

    The record of a fault holds what was not finite, and is left out. So are environments: what of
    theirs must be finite `Env.must_be_finite` says, and `guarded_step` sees to it.
    """

    def is_left_out(node) -> bool:
        return isinstance(node, Fault | EnvState)

    def stepped(state, params):
        state, metrics = step(state, params)
        finite = [
            jnp.isfinite(leaf).reshape(leaf.shape[0], -1).all(axis=1)
            for leaf in jax.tree.leaves((state, metrics), is_leaf=is_left_out)
            if not is_left_out(leaf) and jnp.issubdtype(leaf.dtype, jnp.floating)
        ]
        return state, metrics, jnp.stack(finite).all(axis=0)

    return stepped


class UntilSolved(NamedTuple):
    """A learner that stays as it is once it has solved its task.

    Attributes:
        state: The learner.
        score: Mean return at its last evaluation, [].
        solved: Whether that solved the task, [].
        key: PRNG key.
    """

    state: Any
    score: jax.Array
    solved: jax.Array
    key: jax.Array

    @classmethod
    def start(cls, state: Any, key: jax.Array) -> "UntilSolved":
        """Return a learner that has not been evaluated."""
        return cls(state, jnp.zeros(()), jnp.zeros((), bool), key)


def until_solved(step, evaluate, solved_return: float):
    """Wrap a learner's step so that the learner stays as it is once it has solved its task.

    Args:
        step: `(state, params) -> (state, metrics, ...)` of one learner.
        evaluate: `(state, params, key, wanted) -> (mean return, share of faulty steps)` of one
            learner, which is not looked at where `wanted` is false.
        solved_return: Mean return that counts as solved.

    Returns:
        `(UntilSolved, params) -> (UntilSolved, metrics)`.
    """

    def stepped(carry: UntilSolved, params):
        state, score, was_solved, key = carry
        new, metrics = step(state, params)[:2]
        state = jax.tree.map(lambda old, n: jnp.where(was_solved, old, n), state, new)
        key, evaluate_key = jax.random.split(key)
        found, faulty_share = evaluate(state, params, evaluate_key, ~was_solved)
        score = jnp.where(was_solved, score, found)
        solved = score >= solved_return
        faults = {f"evaluation_{FAULTY}": faulty_share}
        metrics = _of_learners(metrics, ~was_solved)
        metrics = metrics | {"evaluation": score, "finished": solved} | faults
        return UntilSolved(state, score, solved, key), metrics

    return stepped


def _of_learners(metrics: Metrics, learns: jax.Array) -> Metrics:
    """Return metrics in which a step that was thrown away cannot stop the run."""

    def kept(name: str, value: jax.Array) -> jax.Array:
        is_harmless = jnp.isfinite(value) & (not name.endswith(FAULTY))
        return jnp.where(learns | is_harmless, value, jnp.zeros_like(value))

    return {name: kept(name, jnp.asarray(value)) for name, value in metrics.items()}
