"""Commands that hold a model against recordings: compare, diagnose, improve, ground, plan."""

import dataclasses
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from garat_jax.commandline import arg
from garat_jax.commands.checks import (
    check_files,
    check_once,
    check_optional,
    make_run,
    writing,
)
from garat_jax.errors import UserError, choose
from garat_jax.terminal import say


@dataclasses.dataclass(frozen=True)
class OnRecordings:
    """What every command takes that holds a model against recordings."""

    model: Annotated[Positional[Path], arg(metavar="MODEL")]
    """MJCF (.xml) or model card (.toml)."""
    data: Annotated[Positional[tuple[Path, ...]], arg(metavar="DATA...")]
    """One recording or more (CSV, Parquet or NPZ), one a file."""
    map: Annotated[Path | None, arg(metavar="MAP.toml")] = None
    """How the recordings' columns are named, and in which units."""
    effects: Annotated[tuple[Path, ...], arg(metavar="FILE.py...")] = ()
    """Python files with effects of your own."""
    out: Annotated[Path | None, arg(metavar="DIR")] = None
    """Folder for the results; runs/COMMAND-MODEL by default."""
    force: bool = False
    """Replace an earlier run in DIR."""

    def check(self) -> None:
        """Refuse files that are not there, and recordings that are given twice.

        Raises:
            UserError: A file is missing, or a recording is there twice.
        """
        check_files([self.model], "MODEL")
        check_files(self.data, "DATA")
        check_optional(self.map, "--map")
        check_once(self.recordings())

    def recordings(self) -> list[Path]:
        """List all recordings."""
        return list(self.data)

    def folder(self, command: str) -> Path:
        """Return where the results go."""
        return self.out or Path("runs") / f"{command}-{self.model.stem}"


@dataclasses.dataclass(frozen=True)
class WithHoldout(OnRecordings):
    """The same, with recordings that prove the result."""

    holdout: Annotated[tuple[Path, ...], arg(metavar="FILE...")] = ()
    """Recordings to prove the result on; by default some of DATA are held out."""

    def check(self) -> None:
        """Refuse files that are not there, and proof on what was fitted."""
        super().check()
        check_files(self.holdout or self.data, "--holdout")

    def recordings(self) -> list[Path]:
        """List all recordings."""
        return [*self.data, *self.holdout]


@dataclasses.dataclass(frozen=True)
class Compare(OnRecordings):
    """Measure the error of a model as it is, by signal and horizon.

    It writes DIR/compare.json and DIR/report.html.
    """

    also: Annotated[tuple[Path, ...], arg(metavar="MODEL...")] = ()
    """Other models to score in the same table, a repaired model card for example."""
    grounded: Annotated[tuple[Path, ...], arg(metavar="DIR...")] = ()
    """Runs of `garat ground` to score in the same table."""

    def run(self) -> None:
        """Compare the model with the recordings."""
        self.check()
        check_files(self.also or [self.model], "--also")
        from garat_jax.diagnosis import load_model, run_compare
        from garat_jax.effects.catalogue import load_catalogue

        catalogue = load_catalogue(self.effects)
        also = [load_model(path, catalogue) for path in self.also]
        if self.grounded:
            from garat_jax.ground import load_grounded
            from garat_jax.presets import GROUNDING

            also += [load_grounded(path, GROUNDING, catalogue) for path in self.grounded]
        with make_run(self, self.folder("compare")) as run:
            found = run_compare(self.model, self.data, run, self.map, catalogue, also)
        say(str(found))
        say(f"report: {run.root / 'report.html'}")


@dataclasses.dataclass(frozen=True)
class WithConditions(WithHoldout):
    """The same, with recordings that were made under other conditions."""

    condition: Annotated[tuple[str, ...], arg(metavar="NAME=FILE...")] = ()
    """Recordings under other conditions, such as with a payload. What DATA shows is shared by all;
    what these show besides belongs to NAME. Each NAME gets its own model card,
    DIR/model-NAME.toml."""

    def recordings(self) -> list[Path]:
        """List all recordings, those of the other conditions last."""
        others = parse_conditions(self.condition).values()
        return [*super().recordings(), *itertools.chain(*others)]


@dataclasses.dataclass(frozen=True)
class Diagnose(WithConditions):
    """Find where a model fails and which physical effect it is missing.

    It writes DIR/diagnosis.json and DIR/report.html.
    """

    def run(self) -> None:
        """Diagnose the model."""
        self.check()
        conditions = parse_conditions(self.condition)
        from garat_jax.diagnosis import run_diagnose
        from garat_jax.effects.catalogue import load_catalogue

        catalogue = load_catalogue(self.effects)
        with make_run(self, self.folder("diagnose")) as run:
            run_diagnose(self.model, self.data, self.holdout, run, self.map, catalogue, conditions)
        say(f"report: {run.root / 'report.html'}")


def parse_conditions(given: Sequence[str]) -> dict[str, list[Path]]:
    """Read NAME=FILE words into the files of each condition.

    Raises:
        UserError: A word is no NAME=FILE, the name is none for a file, or there is no such file.
    """
    conditions: dict[str, list[Path]] = {}
    for word in given:
        name, equals, file = word.partition("=")
        if not (name and equals and file):
            raise UserError(f"--condition: {word!r} is not NAME=FILE, as in loaded=run3.csv")
        if Path(name).name != name:
            raise UserError(f"--condition: {name!r} names a file, so it may hold no folder")
        check_files([Path(file)], "--condition")
        conditions.setdefault(name, []).append(Path(file))
    return conditions


@dataclasses.dataclass(frozen=True)
class Improve(WithConditions):
    """Repair a model: diagnose, add what is missing, repeat until nothing more is certain.

    It writes DIR/model.toml with the model's files beside it, DIR/improve.json and DIR/report.html.
    """

    def run(self) -> None:
        """Repair the model."""
        self.check()
        conditions = parse_conditions(self.condition)
        from garat_jax.diagnosis.improve import run_improve
        from garat_jax.effects.catalogue import load_catalogue

        catalogue = load_catalogue(self.effects)
        with make_run(self, self.folder("improve")) as run:
            done = run_improve(
                self.model, self.data, self.holdout, run, self.map, catalogue, conditions
            )
        say(str(done))
        say(f"model card: {run.root / 'model.toml'} {done.card}")
        say(f"report: {run.root / 'report.html'}")


@dataclasses.dataclass(frozen=True)
class Ground(WithHoldout):
    """Learn what physics does not explain: an action transformer of a model, from recordings.

    It writes DIR/summary.json, the transformer's checkpoint, the model and DIR/report.html; `garat
    compare --grounded DIR` scores it beside other models.
    """

    method: str = "gat"
    """How to ground: gat or garat."""
    policy: Annotated[Path | None, arg(metavar="FILE.py")] = None
    """The policy that acted: a function policy(obs, key); cloned from the commands by default."""
    interval: Annotated[float | None, arg(metavar="SECONDS")] = None
    """Length of a control step; about 0.02 s by default, in whole samples."""
    out: Annotated[Path | None, arg(metavar="DIR")] = None
    """Folder for the results; runs/METHOD-MODEL by default."""
    seed: int = 0
    """Seed of everything random."""
    resume: bool = False
    """Go on from the last checkpoint in DIR."""

    def run(self) -> None:
        """Ground the model."""
        self.check()
        from garat_jax.effects.catalogue import load_catalogue
        from garat_jax.ground import run_ground
        from garat_jax.presets import GROUNDING

        config = choose("method", self.method, GROUNDING)
        catalogue = load_catalogue(self.effects)
        with make_run(self, self.folder(self.method), seeds=[self.seed], resume=self.resume) as run:
            done = run_ground(
                self.model,
                self.data,
                self.holdout,
                config,
                run,
                policy=self.policy,
                interval=self.interval,
                seed=self.seed,
                columns=self.map,
                catalogue=catalogue,
            )
        say(done.sentence)
        say(f"report: {run.root / 'report.html'}")


@dataclasses.dataclass(frozen=True)
class Plan:
    """Plan an excitation that tells two effects apart, within the actuators' and joints' limits."""

    model: Annotated[Positional[Path], arg(metavar="MODEL")]
    """MJCF (.xml) or model card (.toml)."""
    separate: Annotated[tuple[str, str], arg(metavar="A B")]
    """Two effects, each KIND or KIND@TARGET."""
    out: Annotated[Path, arg(metavar="FILE.csv")]
    """The commands to play: time and ctrl.ACTUATOR."""
    seconds: float = 8.0
    """Length of the excitation."""
    seed: int = 0
    """Draws the excitations that are tried."""
    effects: Annotated[tuple[Path, ...], arg(metavar="FILE.py...")] = ()
    """Python files with effects of your own."""
    force: bool = False
    """Replace FILE.csv."""

    def run(self) -> None:
        """Plan the excitation."""
        check_files([self.model], "MODEL")
        with writing(self.out, ".csv", self.force):
            from garat_jax.diagnosis import load_model
            from garat_jax.diagnosis.plan import plan, write_plan
            from garat_jax.diagnosis.progress import tell
            from garat_jax.effects.catalogue import load_catalogue

            model = load_model(self.model, load_catalogue(self.effects))
            planned = plan(model, *self.separate, self.seconds, self.seed, tell)
            write_plan(planned, self.out)
            say(str(planned))
            say(f"excitation: {self.out}")
