"""Commands about models and files: add an effect, export, convert a log, print the catalogue."""

import dataclasses
import inspect
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional

from garat_jax.commandline import arg
from garat_jax.commands.checks import (
    check_files,
    check_once,
    check_optional,
    writing,
)
from garat_jax.errors import UserError
from garat_jax.terminal import print_table, say

if TYPE_CHECKING:
    from garat_jax.effects import Effect


@dataclasses.dataclass(frozen=True)
class Add:
    """Add a physical effect to a model, of a size that you set or that recordings tell."""

    model: Annotated[Positional[Path], arg(metavar="MODEL")]
    """MJCF (.xml) or model card (.toml)."""
    effect: Annotated[Positional[str], arg(metavar="EFFECT")]
    """Kind of effect; `garat effects` names them."""
    at: Annotated[str, arg(metavar="TARGET")]
    """Where it acts: joint/NAME, actuator/NAME, body/NAME, geom/NAME, world or all."""
    out: Annotated[Path, arg(metavar="NEW.toml")]
    """The model card to write, in the folder of the MJCF or above it."""
    set: Annotated[tuple[str, ...], arg(metavar="NAME=VALUE...")] = ()
    """Parameters, in SI units; those that are not given leave the model as it is, or are fitted."""
    fit: Annotated[tuple[Path, ...], arg(metavar="DATA...")] = ()
    """Recordings to fit the parameters to that --set does not give."""
    map: Annotated[Path | None, arg(metavar="MAP.toml")] = None
    """How the recordings' columns are named, and in which units."""
    effects: Annotated[tuple[Path, ...], arg(metavar="FILE.py...")] = ()
    """Python files with effects of your own."""
    force: bool = False
    """Replace NEW.toml."""

    def run(self) -> None:
        """Write the card; with recordings, fit the effect first."""
        check_files([self.model], "MODEL")
        check_files(self.fit or [self.model], "--fit")
        check_once(self.fit)
        check_optional(self.map, "--map")
        values = _assignments(self.set)
        with writing(self.out, ".toml", self.force):
            from garat_jax.diagnosis import load_model
            from garat_jax.diagnosis.add import add
            from garat_jax.diagnosis.compare import read_recordings
            from garat_jax.diagnosis.model_card import mjcf_in_card, save_card
            from garat_jax.diagnosis.progress import tell
            from garat_jax.effects.catalogue import load_catalogue

            model = load_model(self.model, load_catalogue(self.effects))
            mjcf_in_card(self.out, model)
            recordings = read_recordings(model, self.fit, self.map)
            done = add(model, self.effect, self.at, values, recordings, tell)
            save_card(self.out, done.model)
            say(str(done))
            say(f"model card: {self.out}")


@dataclasses.dataclass(frozen=True)
class Export:
    """Write a model card as plain MJCF, and name what MJCF cannot express."""

    model: Annotated[Positional[Path], arg(metavar="MODEL")]
    """Model card (.toml), or MJCF (.xml)."""
    out: Annotated[Path, arg(metavar="NEW.xml")]
    """The MJCF file to write; meshes and textures stay where they are."""
    effects: Annotated[tuple[Path, ...], arg(metavar="FILE.py...")] = ()
    """Python files with effects of your own."""
    force: bool = False
    """Replace NEW.xml."""

    def run(self) -> None:
        """Write the MJCF."""
        check_files([self.model], "MODEL")
        with writing(self.out, ".xml", self.force):
            from garat_jax.diagnosis import load_model
            from garat_jax.diagnosis.export import export_mjcf
            from garat_jax.effects.catalogue import load_catalogue

            model = load_model(self.model, load_catalogue(self.effects))
            done = export_mjcf(model, self.out)
            for line in done.unsaid:
                say(f"not in MJCF: {line}")
            say(f"MJCF: {done.path}")


@dataclasses.dataclass(frozen=True)
class Convert:
    """Turn a log into a recording: ROS bag or MCAP, Parquet, NPZ, MAT, or a foreign CSV."""

    log: Annotated[Positional[Path], arg(metavar="LOG")]
    """ROS 1 or 2 bag, MCAP, .parquet, .npz, .mat or .csv."""
    map: Annotated[Path, arg(metavar="MAP.toml")]
    """Which topic or column becomes which column, with unit, sign and offset."""
    out: Annotated[Path, arg(metavar="DATA.csv")]
    """The recording to write."""
    force: bool = False
    """Replace DATA.csv."""

    def run(self) -> None:
        """Convert the log."""
        if not self.log.exists():
            raise UserError(f"LOG: there is no file {self.log}")
        check_files([self.map], "--map")
        if self.out.resolve() == self.log.resolve():
            raise UserError(f"--out {self.out} is LOG itself; give another name")
        with writing(self.out, ".csv", self.force):
            from garat_jax.diagnosis.convert_logs import convert_log

            say(convert_log(self.log, self.map, self.out))


@dataclasses.dataclass(frozen=True)
class Effects:
    """Print the catalogue of physical effects: law, parameters, units, what identifies them."""

    effect: Annotated[Positional[str | None], arg(metavar="[EFFECT]")] = None
    """Print all there is to know about one effect."""
    effects: Annotated[tuple[Path, ...], arg(metavar="FILE.py...")] = ()
    """Python files with effects of your own."""

    def run(self) -> None:
        """Print the catalogue, or one entry."""
        from garat_jax.effects.catalogue import choose_kind, load_catalogue

        catalogue = load_catalogue(self.effects)
        if self.effect is not None:
            _print_effect(choose_kind(self.effect, catalogue))
            return
        rows = [
            (
                kind,
                ", ".join(effect.elements),
                effect.law,
                ", ".join(f"{p.name} [{p.unit}]" for p in effect.parameters()),
                effect.identified_by,
            )
            for kind, effect in catalogue.items()
        ]
        print_table(("effect", "acts on", "law", "parameters", "identified by"), rows)


def _assignments(texts: Sequence[str]) -> dict[str, float]:
    """Read `name=value` words."""
    values = dict[str, float]()
    for text in texts:
        name, equals, value = text.partition("=")
        if name in values:
            raise UserError(f"--set gives {name} twice; expected it once")
        try:
            values[name] = float(value)
        except ValueError:
            equals = ""
        if not name or not equals:
            raise UserError(
                f"--set {text!r}: expected NAME=VALUE with a number, such as torque=0.2"
            )
    return values


def _print_effect(effect: "type[Effect]") -> None:
    """Print what an effect does, and its parameters with units, bounds and their source."""
    from garat_jax.effects.units import LEVER, at_slide

    say(f"{effect.kind}: {effect.law}\n\n{inspect.getdoc(effect)}\n")
    say(f"Acts on: {', '.join(effect.elements)}. Identified by: {effect.identified_by}.")
    rows = [
        (p.name, p.unit, f"{p.nominal:g}", f"{p.low:g} to {p.high:g}", p.source)
        for p in effect.parameters()
    ]
    print_table(("parameter", "unit", "no effect", "bounds", "source of the bounds"), rows)
    if "joint" in effect.elements and any(at_slide(p.unit) != p.unit for p in effect.parameters()):
        say(f"At a slide joint bounds of forces are what they are at a lever of {LEVER:g} m.")
