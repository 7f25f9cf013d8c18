"""The command `garat`: reads the arguments, makes the run directory, hands over to the library.

Each command is a frozen dataclass: its docstrings are the help, its `run` does the work. Imports of
anything that loads JAX stand inside `run`, so that help and errors come at once.
"""

import contextlib
import dataclasses
import inspect
import shlex
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Protocol

from rich.console import Console
from rich.table import Table
from tyro.conf import Positional, arg

from garat_jax import __version__
from garat_jax.commandline import PROGRAM, how_to_go_on, parse
from garat_jax.errors import DivergedError, UserError, choose

if TYPE_CHECKING:
    from garat_jax.effects import Effect
    from garat_jax.runs import RunDirectory

DESCRIPTION = "Ground a simulator in data, and find the physical effect that it is missing."

DONE, FAILED, USER_ERROR, INTERRUPTED = 0, 1, 2, 130


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
    """Recordings of a free pendulum to diagnose as well."""
    force: bool = False
    """Replace an earlier run in DIR."""
    resume: bool = False
    """Go on from the last checkpoint in DIR."""

    def run(self) -> None:
        """Run the tour."""
        if self.measurements is not None and not self.measurements.is_dir():
            raise UserError(f"--measurements: there is no folder {self.measurements}")
        from garat_jax.demo import run_demo

        with make_run(self, self.out, seeds=[self.seed], resume=self.resume) as run:
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
    """Physics: MJX, C MuJoCo, or the faster of the two on this machine."""
    out: Annotated[Path | None, arg(metavar="DIR")] = None
    """Folder for the results; runs/PAIR-METHOD by default."""
    force: bool = False
    """Replace an earlier run in DIR."""
    resume: bool = False
    """Go on from the last checkpoint in DIR."""

    def run(self) -> None:
        """Run the transfer experiment."""
        if self.seeds < 1:
            raise UserError(f"--seeds {self.seeds}: expected 1 or more")
        from garat_jax.envs.pairs import PAIRS
        from garat_jax.presets import METHODS
        from garat_jax.summary import describe
        from garat_jax.transfer import run_transfer

        config = choose("method", self.method, METHODS)(
            choose("pair", self.pair, PAIRS), seeds=self.seeds, engine=self.engine
        )
        out = self.out or Path("runs") / f"{self.pair}-{self.method}"
        with make_run(self, out, seeds=range(self.seeds), resume=self.resume) as run:
            say(describe(run_transfer(config, run)))
        say(f"report: {run.root / 'report.html'}")


@dataclasses.dataclass(frozen=True)
class Compare:
    """Measure the error of a model as it is, by signal and horizon."""

    model: Annotated[Positional[Path], arg(metavar="MODEL")]
    """MJCF (.xml) or model card (.toml)."""
    data: Annotated[Positional[tuple[Path, ...]], arg(metavar="DATA...")]
    """Recordings (CSV, Parquet or NPZ), one a file."""
    out: Annotated[Path | None, arg(metavar="DIR")] = None
    """Folder for compare.json and report.html; runs/compare-MODEL by default."""
    force: bool = False
    """Replace an earlier run in DIR."""

    def run(self) -> None:
        """Compare the model with the recordings."""
        check_files([self.model], "MODEL")
        check_files(self.data, "DATA")
        from garat_jax.diagnosis import run_compare

        out = self.out or Path("runs") / f"compare-{self.model.stem}"
        with make_run(self, out) as run:
            run_compare(self.model, self.data, run)
        say(f"report: {run.root / 'report.html'}")


@dataclasses.dataclass(frozen=True)
class Diagnose:
    """Find where a model fails and which physical effect it is missing."""

    model: Annotated[Positional[Path], arg(metavar="MODEL")]
    """MJCF (.xml) or model card (.toml)."""
    data: Annotated[Positional[tuple[Path, ...]], arg(metavar="DATA...")]
    """Recordings (CSV, Parquet or NPZ), one a file."""
    holdout: Annotated[tuple[Path, ...], arg(metavar="FILE...")] = ()
    """Recordings to prove the result on; by default some of DATA are held out."""
    out: Annotated[Path | None, arg(metavar="DIR")] = None
    """Folder for diagnosis.json and report.html; runs/diagnose-MODEL by default."""
    force: bool = False
    """Replace an earlier run in DIR."""

    def run(self) -> None:
        """Diagnose the model."""
        check_files([self.model], "MODEL")
        check_files(self.data, "DATA")
        check_files(self.holdout or self.data, "--holdout")
        from garat_jax.diagnosis import run_diagnose

        out = self.out or Path("runs") / f"diagnose-{self.model.stem}"
        with make_run(self, out) as run:
            run_diagnose(self.model, self.data, self.holdout, run)
        say(f"report: {run.root / 'report.html'}")


@dataclasses.dataclass(frozen=True)
class Effects:
    """Print the catalogue of physical effects: law, parameters, units, what identifies them."""

    effect: Annotated[Positional[str | None], arg(metavar="EFFECT")] = None
    """Print all there is to know about one effect."""

    def run(self) -> None:
        """Print the catalogue, or one entry."""
        from garat_jax.effects import CATALOGUE

        if self.effect is not None:
            print_effect(choose("effect", self.effect, CATALOGUE))
            return
        rows = [
            (
                kind,
                ", ".join(effect.elements),
                effect.law,
                ", ".join(f"{p.name} [{p.unit}]" for p in effect.parameters()),
                effect.identified_by,
            )
            for kind, effect in CATALOGUE.items()
        ]
        print_table(("effect", "acts on", "law", "parameters", "identified by"), rows)


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
    "effects": Effects,
    "list": List,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `garat` and return its exit status.

    Args:
        arguments: The command line without the program's name; that of the process if None.

    Returns:
        0 done, 1 a computation diverged, 2 the user's input is wrong, 130 interrupted. Anything
        else is a fault of the program and leaves as an exception.
    """
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    try:
        if arguments == ["--version"]:
            say(f"{PROGRAM} {__version__}")
        elif command := parse(arguments, COMMANDS, DESCRIPTION):
            command.run()
    except KeyboardInterrupt:
        return complain(f"interrupted; {how_to_go_on(arguments, COMMANDS)}", INTERRUPTED)
    except DivergedError as error:
        return complain(f"error: {error}", FAILED)
    except UserError as error:
        return complain(f"error: {error}", USER_ERROR)
    return DONE


def complain(message: str, status: int) -> int:
    """Print one line on stderr and return the exit status that goes with it."""
    line = " ".join(message.split())
    sys.stderr.write(f"{PROGRAM}: {line}\n")
    return status


def say(message: str) -> None:
    """Print one line on stdout, as it is."""
    Console(soft_wrap=True, highlight=False, markup=False).print(message)


@contextlib.contextmanager
def make_run(
    command: Any, out: Path, seeds: Sequence[int] = (), resume: bool | None = None
) -> Iterator["RunDirectory"]:
    """Make the run directory of a command; the command's fields are the run's config.

    Wrong input that shows only within the block leaves no empty run behind.

    Args:
        command: A command with a field `force`.
        out: The folder.
        seeds: The seeds of the run.
        resume: Go on with the run that the folder holds; None if the command cannot.
    """
    from garat_jax.runs import RunDirectory

    config = {
        field.name: getattr(command, field.name)
        for field in dataclasses.fields(command)
        if field.name not in ("out", "force", "resume")
    }
    line = shlex.join([PROGRAM, *sys.argv[1:]])
    run = RunDirectory.create(out, config, line, seeds, force=command.force, resume=resume)
    if run.resumed and (changed := run.changed_versions()):
        complain(f"warning: the run was begun with other versions: {', '.join(changed)}", DONE)
    try:
        yield run
    except UserError:
        run.discard()
        raise


def check_files(paths: Sequence[Path], what: str) -> None:
    """Refuse an empty list of files and files that are not there."""
    if not paths:
        raise UserError(f"{what}: expected one file or more")
    for path in paths:
        if not path.is_file():
            raise UserError(f"{what}: there is no file {path}")


def print_table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table, as wide as the terminal or, where there is none, as its content."""
    table = Table(*columns)
    for row in rows:
        table.add_row(*row)
    console = Console()
    width = console.width if console.is_terminal else max(console.width, 160)
    Console(width=width, markup=False).print(table)


def print_effect(effect: "type[Effect]") -> None:
    """Print what an effect does, and its parameters with units, bounds and their source."""
    say(f"{effect.kind}: {effect.law}\n\n{inspect.getdoc(effect)}\n")
    say(f"Acts on: {', '.join(effect.elements)}. Identified by: {effect.identified_by}.")
    rows = [
        (p.name, p.unit, f"{p.nominal:g}", f"{p.low:g} to {p.high:g}", p.source)
        for p in effect.parameters()
    ]
    print_table(("parameter", "unit", "no effect", "bounds", "source of the bounds"), rows)


def first_line(entry: Any) -> str:
    """Return the first line of what an entry says of itself."""
    return (inspect.getdoc(entry) or "").partition("\n")[0]
