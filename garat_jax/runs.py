"""Run directories: what was run, with which versions and seeds, and what came out. No JAX.

A run directory holds `config.json` (format "garat-run/1": the command's arguments as `config`, the
settings that they stand for as `settings`, seeds, versions, machine), `metrics.jsonl` (one line a
logged step), and whatever the command adds to it: summaries, checkpoints, plots, `report.html`.
"""

import contextlib
import dataclasses
import json
import shlex
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from garat_jax.errors import UserError
from garat_jax.files import write_whole
from garat_jax.plain import finite_or_null, to_plain
from garat_jax.provenance import provenance, versions

FORMAT = "garat-run/1"
CONFIG = "config.json"
METRICS = "metrics.jsonl"
SECONDS = "seconds.json"
"""How long the run has taken so far."""
CONTENTS = ".contents"
"""Names at the top of the folder that the run has written, a line each: others are the user's."""
FILES = ".files"
"""Every file of a run that has ended, a line each: others came later and are the user's."""


@dataclasses.dataclass(frozen=True)
class RunDirectory:
    """A folder that holds one run.

    Attributes:
        root: The folder.
        resumed: Whether the folder held this run before it was opened.
        made: The folders that were made for it to lie in, innermost first.
        others: What the folder held beside the run when that was gone on with.
    """

    root: Path
    resumed: bool = False
    made: tuple[Path, ...] = dataclasses.field(default=(), repr=False)
    others: tuple[str, ...] = dataclasses.field(default=(), repr=False)

    @classmethod
    def create(
        cls,
        path: str | Path,
        config: Any,
        command: Sequence[str] | str,
        seeds: Sequence[int],
        *,
        force: bool = False,
        resume: bool | None = False,
    ) -> "RunDirectory":
        """Make a run directory and write its `config.json`, or go on with one that exists.

        Args:
            path: The folder; its parents are made as needed.
            config: A dataclass or mapping with the settings that decide the results; what is
                infinite becomes null, because JSON has no infinity.
            command: The command line that started the run.
            seeds: The seeds of the run.
            force: Replace the folder if it holds an earlier run and nothing that the run did not
                write. Hidden files are not looked at, and what lies in its folders only if the run
                has noted its files.
            resume: Go on with the run that the folder holds; start one if it is absent or empty.
                None if the command cannot go on with a run.

        Raises:
            UserError: The folder is not empty and neither `force` nor `resume` was given, it holds
                something else than a run, or more than that, or `resume` was given and the run in
                it has other settings or seeds.
        """
        if force and resume:
            raise UserError(
                "--force and --resume exclude each other: one replaces the run, one continues it"
            )
        root = Path(path)
        line = command if isinstance(command, str) else shlex.join(command)
        record = {"config": finite_or_null(to_plain(config)), "seeds": to_plain(list(seeds))}
        if is_occupied(root):
            if resume:
                _check_same_run(root, line, record)
                others = tuple(not_of_run(root))
                (root / FILES).unlink(missing_ok=True)  # there will be more
                return cls(root, resumed=True, others=others)
            check_replaceable(root)
            if not force:
                go_on = "" if resume is None else "--resume to go on, "
                raise UserError(
                    f"{root} exists already: give --force to replace it, {go_on}or another --out"
                )
            shutil.rmtree(root)
        missing = tuple(folder for folder in root.parents if not folder.exists())
        try:
            root.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(f"cannot make the folder {root}: {error.strerror}") from error
        run = cls(root, made=missing)
        run.write_json(CONFIG, {"format": FORMAT, "command": line, **record, **provenance()})
        return run

    @classmethod
    def open(cls, path: str | Path) -> "RunDirectory":
        """Open the run directory at `path` to read from it.

        Raises:
            UserError: There is no run in that folder.
        """
        root = Path(path)
        if not is_run(root):
            raise UserError(f"{root} holds no run: {CONFIG} of format {FORMAT!r} is not there")
        return cls(root, resumed=True)

    def record_settings(self, settings: Any) -> None:
        """Write down every setting that decides the results, defaults included.

        A limit that is infinite becomes null, because JSON has no infinity.

        Args:
            settings: A dataclass or mapping.

        Raises:
            UserError: The run was begun with other settings.
        """
        record = self.read_json(CONFIG)
        new = finite_or_null(to_plain(settings))
        _check_same(self.root, record.get("settings", new), new, "settings")
        if "settings" not in record:
            self.write_json(CONFIG, {**record, "settings": new})

    def changed_versions(self) -> list[str]:
        """List the packages whose version is another than when the run was begun."""
        before, now = self.read_json(CONFIG)["versions"], versions()
        return [
            f"{name} {before.get(name)} -> {now.get(name)}"
            for name in sorted(before.keys() | now.keys())
            if before.get(name) != now.get(name)
        ]

    def discard(self) -> None:
        """Remove the folder if nothing came of the run: `config.json` is all that it holds.

        What was made for it to lie in goes with it, if nothing else lies there by now.
        """
        if not self.resumed and not holds_results(self.root):
            shutil.rmtree(self.root)
            with contextlib.suppress(OSError):
                for folder in self.made:
                    folder.rmdir()

    def note_files(self) -> None:
        """Write down that the run has ended, and which files it has left."""
        names = sorted(_files(self.root).difference(self.others))
        write_whole(self.root / FILES, "".join(f"{name}\n" for name in names))

    def path(self, name: str) -> Path:
        """Return the path of a file in the run, and make the folder that it belongs to."""
        path = self.root / name
        contents, top = self.root / CONTENTS, Path(name).parts[0]
        if not (self.root / top).exists() and (contents.exists() or name == CONFIG):
            with contents.open("a", encoding="utf-8") as file:
                file.write(top + "\n")
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def read_json(self, name: str) -> Any:
        """Return the content of a JSON file of the run.

        Raises:
            UserError: It is damaged.
        """
        path = self.root / name
        return _parsed(path.read_text(encoding="utf-8"), path)

    def write_json(self, name: str, value: Any) -> Path:
        """Write a JSON file whole or not at all.

        Args:
            name: The file's path inside the run.
            value: Dataclasses, mappings, sequences, numbers, arrays, paths.

        Returns:
            The path of the file.

        Raises:
            ValueError: The value holds a NaN or an infinity.
        """
        text = json.dumps(to_plain(value), indent=2, allow_nan=False) + "\n"
        return write_whole(self.path(name), text)

    def log(self, step: int, **metrics: Any) -> None:
        """Append one line to `metrics.jsonl`; numbers that are not finite become null.

        Args:
            step: The step that the metrics belong to.
            **metrics: Numbers, or arrays with one number a seed.
        """
        line = json.dumps({"step": int(step), **finite_or_null(to_plain(metrics))}, allow_nan=False)
        with self.path(METRICS).open("a", encoding="utf-8") as file:
            file.write(line + "\n")

    def metrics(self) -> Iterator[dict[str, Any]]:
        """Yield the logged lines in order; a last line that was cut short is left out.

        Raises:
            UserError: Another line is damaged.
        """
        path = self.root / METRICS
        if not path.exists():
            return
        with path.open(encoding="utf-8") as file:
            for line in file:
                if line.endswith("\n"):
                    yield _parsed(line, path)

    def rewind(self, step: int, stage: str | None = None) -> None:
        """Drop the metrics logged after `step`, so that a resumed run repeats none of them.

        Args:
            step: The last step that stays.
            stage: Drop only lines whose metric `stage` is this.
        """

        def stays(line: dict[str, Any]) -> bool:
            return line["step"] <= step or (stage is not None and line.get("stage") != stage)

        kept = [line for line in self.metrics() if stays(line)]
        write_whole(self.path(METRICS), "".join(json.dumps(line) + "\n" for line in kept))


def is_run(path: Path) -> bool:
    """Tell whether a folder is a run directory."""
    try:
        content = json.loads((path / CONFIG).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(content, dict) and content.get("format") == FORMAT


def _parsed(text: str, path: Path) -> Any:
    try:
        return json.loads(text)
    except ValueError as error:
        raise UserError(f"{path} is damaged ({error}); start anew with --force") from error


def has_ended(root: Path) -> bool:
    """Say whether the run in a folder has ended."""
    return (root / FILES).exists()


def not_of_run(root: Path) -> list[str]:
    """List what a folder holds beside the run in it, and beside the runs within that."""
    others = set()
    for noted, present in ((FILES, _files(root)), (CONTENTS, _names(root))):
        if (root / noted).exists():
            written = (root / noted).read_text(encoding="utf-8").splitlines()
            others |= present.difference(written)
    within = [part for part in root.glob("*") if is_run(part)]
    others |= {f"{part.name}/{name}" for part in within for name in not_of_run(part)}
    return sorted(others)


def _names(root: Path) -> set[str]:
    return {path.name for path in root.glob("[!.]*")}


def _files(root: Path) -> set[str]:
    """Return the paths of a folder's files, none of them hidden or in a hidden folder."""
    names = (path.relative_to(root) for path in root.rglob("*") if path.is_file())
    return {name.as_posix() for name in names if not any(p.startswith(".") for p in name.parts)}


def holds_results(root: Path) -> bool:
    """Say whether there is more in a run directory than how it was begun, and hidden files."""
    begun = (root / CONFIG, root / SECONDS)
    return any(path.is_file() and path not in begun for path in root.rglob("[!.]*"))


def is_occupied(root: Path) -> bool:
    """Say whether a folder is there and holds anything.

    Raises:
        UserError: It is a file.
    """
    if root.exists() and not root.is_dir():
        raise UserError(f"{root} is a file; expected a folder for the run")
    return root.is_dir() and any(path.name not in (CONTENTS, FILES) for path in root.iterdir())


def _check_same_run(root: Path, command: str, record: Mapping[str, Any]) -> None:
    if not is_run(root):
        raise UserError(f"{root} holds no run to resume; give another --out")
    before = json.loads((root / CONFIG).read_text(encoding="utf-8"))
    began, goes_on = (line.split()[:2] for line in (before["command"], command))
    if began != goes_on:
        raise UserError(f"{root} holds a run of {' '.join(began)}; give another --out")
    for what in ("config", "seeds"):
        _check_same(root, before[what], record[what], what)


def _check_same(root: Path, before: Any, now: Any, what: str) -> None:
    old, new = _leaves(before, what), _leaves(now, what)
    for name in sorted(old.keys() | new.keys()):
        if old.get(name) != new.get(name):
            raise UserError(
                f"{root} was started with {name} = {old.get(name)}, now it is {new.get(name)}: "
                "resume with the same settings, or start anew with --force"
            )


def _leaves(record: Any, name: str) -> dict[str, Any]:
    """Flatten settings to one entry a setting, named by its path."""
    if not isinstance(record, dict) or not record:
        return {name: record}
    flat: dict[str, Any] = {}
    for key, item in record.items():
        flat |= _leaves(item, f"{name}.{key}")
    return flat


def check_replaceable(root: Path) -> None:
    """Refuse to touch what is not recognisably an earlier run.

    Raises:
        UserError: It is none, holds more than that, or the current folder is within it.
    """
    if not is_run(root) or root.is_symlink():
        raise UserError(
            f"{root} is not empty and holds no run, so it is left alone; give another --out"
        )
    if others := not_of_run(root):
        raise UserError(
            f"{root} holds {', '.join(others)}, which the run in it did not write, so it is left "
            "alone; move that away or give another --out"
        )
    if Path.cwd().resolve().is_relative_to(root.resolve()):
        raise UserError(
            f"{root} is the current folder or holds it, so it is left alone; "
            "change the folder first, or give another --out"
        )
