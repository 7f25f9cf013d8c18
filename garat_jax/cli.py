"""The command `garat`: reads the arguments, makes the run directory, hands over to the library.

Each command is a frozen dataclass: its docstrings are the help, its `run` does the work. Imports of
anything that loads JAX stand inside `run`, so that help and what is wrong with options come at
once.
"""

import dataclasses
import errno
import inspect
import io
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn, Protocol

from tyro.conf import Positional

from garat_jax import __version__, compilation_cache
from garat_jax.commandline import PROGRAM, arg, how_to_go_on, parse
from garat_jax.commands.checks import LARGEST_SEED, make_run
from garat_jax.commands.diagnosis import Compare, Diagnose, Ground, Improve, Plan
from garat_jax.commands.machine import Device, Doctor
from garat_jax.commands.models import Add, Convert, Effects, Export
from garat_jax.errors import DivergedError, EarlierRunStays, UserError, choose
from garat_jax.interrupt import interruptible
from garat_jax.terminal import complain, print_table, say

DESCRIPTION = "Ground a simulator in data, and find the physical effect that it is missing."

DONE, FAILED, USER_ERROR, INTERRUPTED = 0, 1, 2, 130
FULL = (errno.ENOSPC, errno.EDQUOT)
"""What a full disk, or a quota that is used up, says when something is written, naming no file."""


class Command(Protocol):
    """What `garat` can be told to do."""

    def run(self) -> None:
        """Do it, or raise UserError."""


@dataclasses.dataclass(frozen=True)
class Demo:
    """Take the tour: ground a simulator with GARAT, then find a hidden physical effect.

    It writes DIR/transfer/summary.json, DIR/diagnosis/diagnosis.json and DIR/report.html.
    """

    out: Annotated[Path, arg(metavar="DIR")] = Path("runs/demo")
    """Folder for the results."""
    seed: int = 0
    """Seed of everything random, the hidden effect among it."""
    measurements: Annotated[Path | None, arg(metavar="FOLDER")] = None
    """Folder that holds SinglePendulumDataForParameterEstimation.mat, recordings of a real pendulum
    (dynamicslab/MultiArm-Pendulum) to diagnose as well."""
    force: bool = False
    """Replace an earlier run in DIR."""
    resume: bool = False
    """Go on from the last checkpoint in DIR."""

    def run(self) -> None:
        """Run the tour."""
        if self.measurements is not None and not self.measurements.is_dir():
            raise UserError(f"--measurements: there is no folder {self.measurements}")
        from garat_jax.demo import SEEDS, run_demo

        seeds = range(self.seed, self.seed + SEEDS)
        with make_run(self, self.out, seeds=seeds, resume=self.resume) as run:
            run_demo(run, seed=self.seed, measurements=self.measurements)
        say(f"report: {run.root / 'report.html'}")


@dataclasses.dataclass(frozen=True)
class Transfer:
    """Train in the source, ground it with the target's data, and evaluate in the target.

    All seeds run as one program. It writes DIR/summary.json, checkpoints and DIR/report.html.
    """

    pair: Annotated[Positional[str], arg(metavar="PAIR")]
    """Source and target; `garat list` names the pairs."""
    method: str = "garat"
    """How to ground; `garat list` names the methods."""
    seeds: int = 5
    """How many seeds: 0, 1, ..."""
    engine: Literal["auto", "mjx", "mujoco"] = "auto"
    """Physics: MJX, C MuJoCo (mujoco), or C MuJoCo on a CPU and MJX elsewhere (auto)."""
    device: Device = "auto"
    """What computes."""
    distributed: bool = False
    """Work with other processes, started alike, on the devices of all."""
    coordinator: Annotated[str | None, arg(metavar="HOST:PORT")] = None
    """Process 0; JAX_COORDINATOR_ADDRESS, Slurm or MPI by default."""
    num_processes: Annotated[int | None, arg(metavar="INT")] = None
    """How many processes; JAX_NUM_PROCESSES, Slurm or MPI by default."""
    process_id: Annotated[int | None, arg(metavar="INT")] = None
    """Which of them, from 0; JAX_PROCESS_ID, Slurm or MPI by default."""
    out: Annotated[Path | None, arg(metavar="DIR")] = None
    """Folder for the results; runs/PAIR-METHOD by default."""
    force: bool = False
    """Replace an earlier run in DIR."""
    resume: bool = False
    """Go on from the last checkpoint in DIR."""

    def run(self) -> None:
        """Run the transfer experiment."""
        if not 1 <= self.seeds <= LARGEST_SEED + 1:
            raise UserError(f"--seeds {self.seeds}: expected 1 to {LARGEST_SEED + 1}")
        alone = {
            "--coordinator": self.coordinator,
            "--num-processes": self.num_processes,
            "--process-id": self.process_id,
        }
        given = [name for name, value in alone.items() if value is not None]
        if given and not self.distributed:
            raise UserError(f"{given[0]} is for runs with --distributed; give that, too")
        if self.distributed and self.resume:
            raise UserError("--distributed cannot go on with a run; leave out --resume")
        from garat_jax.devices import join_processes, use
        from garat_jax.envs.pairs import PAIRS
        from garat_jax.presets import METHODS
        from garat_jax.summary import describe
        from garat_jax.transfer import run_transfer

        process = 0
        if self.distributed:
            process = join_processes(
                self.coordinator, self.num_processes, self.process_id, self.device
            )
        else:
            use(self.device)
        config = choose("method", self.method, METHODS)(
            choose("pair", self.pair, PAIRS), seeds=self.seeds, engine=self.engine
        )
        out = self.out or Path("runs") / f"{self.pair}-{self.method}"
        if process:  # each writes what it has, and process 0 where it was told to
            out = Path(f"{os.path.abspath(out)}-process-{process}")  # `.` has no name
        with make_run(self, out, seeds=range(self.seeds), resume=self.resume) as run:
            say(describe(run_transfer(config, run)))
        say(f"report: {run.root / 'report.html'}")


@dataclasses.dataclass(frozen=True)
class List:
    """Print the environments, pairs and methods that there are."""

    def run(self) -> None:
        """Print the registries."""
        from garat_jax.envs import ENVS
        from garat_jax.envs.pairs import PAIRS
        from garat_jax.presets import METHODS

        print_table(("environment", "what it is"), [(n, first_line(e)) for n, e in ENVS.items()])
        print_table(("pair", "what it is"), [(n, pair.summary) for n, pair in PAIRS.items()])
        print_table(("method", "what it is"), [(n, first_line(m)) for n, m in METHODS.items()])


COMMANDS: dict[str, type[Command]] = {
    "demo": Demo,
    "transfer": Transfer,
    "compare": Compare,
    "diagnose": Diagnose,
    "improve": Improve,
    "ground": Ground,
    "add": Add,
    "export": Export,
    "convert": Convert,
    "plan": Plan,
    "effects": Effects,
    "list": List,
    "doctor": Doctor,
}


def entry() -> NoReturn:
    """Run `garat` as the process that this is."""
    if isinstance(sys.stdout, io.TextIOWrapper):  # what its encoding lacks is escaped, as on stderr
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        status = main()
    except BrokenPipeError:  # who reads the output has seen enough, as `head` has
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        status = FAILED
    if status == INTERRUPTED:  # XLA's threads may still call Python, which would no longer be there
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    sys.exit(status)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `garat` and return its exit status.

    Args:
        arguments: The command line without the program's name; that of the process if None.

    Returns:
        0 done, 1 a computation diverged, 2 the user's input is wrong or a disk full,
        130 interrupted by Ctrl-C or SIGTERM. Anything else is a fault of the program and leaves as
        an exception.
    """
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    compilation_cache.enable()
    try:
        if arguments == ["--version"]:
            say(f"{PROGRAM} {__version__}")
        elif command := parse(arguments, COMMANDS, DESCRIPTION):
            with interruptible():
                command.run()
    except KeyboardInterrupt as stop:
        stays = isinstance(stop, EarlierRunStays)
        news = f"interrupted; {stop}" if str(stop) else "interrupted"
        go_on = how_to_go_on(arguments, COMMANDS, begun=not stays)
        return complain(f"{news}; {go_on}", INTERRUPTED)
    except DivergedError as error:
        return complain(f"error: {error}", FAILED)
    except UserError as error:
        return complain(f"error: {error}", USER_ERROR)
    except OSError as error:
        if error.filename is None and error.errno not in FULL:
            raise
        where = f"{error.filename}: " if error.filename else ""
        return complain(f"error: {where}{error.strerror}", USER_ERROR)
    except (AssertionError, RuntimeError) as error:
        from garat_jax.devices import describe, is_of_devices

        if not is_of_devices(error):
            raise
        return complain(f"error: {describe(error)}", USER_ERROR)
    return DONE


def first_line(entry: Any) -> str:
    """Return the first line of what an entry says of itself."""
    return (inspect.getdoc(entry) or "").partition("\n")[0]
