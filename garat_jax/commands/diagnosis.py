"""Commands that hold a model against recordings: compare, diagnose, improve, plan."""

import dataclasses
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from garat_jax.commands.console import check_files, check_optional, make_run, say


@dataclasses.dataclass(frozen=True)
class Compare:
    """Measure the error of a model as it is, by signal and horizon."""

    model: Annotated[Positional[Path], arg(metavar="MODEL")]
    """MJCF (.xml) or model card (.toml)."""
    data: Annotated[Positional[tuple[Path, ...]], arg(metavar="DATA...")]
    """Recordings (CSV, Parquet or NPZ), one a file."""
    map: Annotated[Path | None, arg(metavar="MAP.toml")] = None
    """How the recordings' columns are named, and in which units."""
    effects: Annotated[tuple[Path, ...], arg(metavar="FILE.py...")] = ()
    """Python files with effects of your own."""
    out: Annotated[Path | None, arg(metavar="DIR")] = None
    """Folder for compare.json and report.html; runs/compare-MODEL by default."""
    force: bool = False
    """Replace an earlier run in DIR."""

    def run(self) -> None:
        """Compare the model with the recordings."""
        check_files([self.model], "MODEL")
        check_files(self.data, "DATA")
        check_optional(self.map, "--map")
        from garat_jax.diagnosis import run_compare
        from garat_jax.effects.catalogue import load_catalogue

        catalogue = load_catalogue(self.effects)
        out = self.out or Path("runs") / f"compare-{self.model.stem}"
        with make_run(self, out) as run:
            found = run_compare(self.model, self.data, run, self.map, catalogue)
        say(str(found))
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
    map: Annotated[Path | None, arg(metavar="MAP.toml")] = None
    """How the recordings' columns are named, and in which units."""
    effects: Annotated[tuple[Path, ...], arg(metavar="FILE.py...")] = ()
    """Python files with effects of your own."""
    out: Annotated[Path | None, arg(metavar="DIR")] = None
    """Folder for diagnosis.json and report.html; runs/diagnose-MODEL by default."""
    force: bool = False
    """Replace an earlier run in DIR."""

    def run(self) -> None:
        """Diagnose the model."""
        check_files([self.model], "MODEL")
        check_files(self.data, "DATA")
        check_files(self.holdout or self.data, "--holdout")
        check_optional(self.map, "--map")
        from garat_jax.diagnosis import run_diagnose
        from garat_jax.effects.catalogue import load_catalogue

        catalogue = load_catalogue(self.effects)
        out = self.out or Path("runs") / f"diagnose-{self.model.stem}"
        with make_run(self, out) as run:
            run_diagnose(self.model, self.data, self.holdout, run, self.map, catalogue)
        say(f"report: {run.root / 'report.html'}")
