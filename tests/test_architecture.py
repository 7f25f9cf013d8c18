"""Rules about the source as a whole: who may import whom, who may call what, and sizes."""

import ast
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import garat_jax.envs

REPOSITORY = Path(__file__).resolve().parent.parent
PACKAGE = REPOSITORY / "garat_jax"
ROOTS = (PACKAGE, REPOSITORY / "envs", REPOSITORY / "benchmarks", REPOSITORY / "tests")
SOURCES = sorted({path.resolve() for root in ROOTS for path in root.rglob("*.py")})
LIBRARY = [path for path in SOURCES if path.is_relative_to(PACKAGE)]


def name_of(path: Path) -> str:
    return path.relative_to(REPOSITORY).as_posix()


def calls(path: Path) -> Iterator[ast.Call]:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return (node for node in ast.walk(tree) if isinstance(node, ast.Call))


def callers(path: Path, method: str, owners: tuple[str, ...]) -> list[str]:
    """Return the calls `owner.method(...)` in a file, the owner being a name or an attribute."""
    found = []
    for call in calls(path):
        function = call.func
        if not isinstance(function, ast.Attribute) or function.attr != method:
            continue
        owner = function.value
        name = owner.attr if isinstance(owner, ast.Attribute) else getattr(owner, "id", "")
        if name in owners:
            found.append(f"{name_of(path)}:{call.lineno}")
    return found


def lint_imports(folder: Path) -> subprocess.CompletedProcess[str]:
    """Check the import contracts of the tree in a folder, in a process of its own."""
    program = (
        "import sys; from importlinter.cli import lint_imports as f; sys.exit(f(no_cache=True))"
    )
    return subprocess.run(
        [sys.executable, "-c", program],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(folder)},
        capture_output=True,
        text=True,
    )


def test_import_contracts_hold():
    done = lint_imports(REPOSITORY)
    assert done.returncode == 0, done.stdout
    assert "0 broken" in done.stdout


def test_an_upward_import_breaks_the_contracts(tmp_path):
    package = tmp_path / "garat_jax"
    package.mkdir()
    words = (
        "commandline",
        "compilation_cache",
        "earlier_run",
        "errors",
        "interrupt",
        "files",
        "plain",
        "provenance",
        "terminal",
    )
    for name in ("__init__", "cli", "report", "summary", *words):
        (package / f"{name}.py").touch()
    (package / "runs.py").write_text("from garat_jax import cli\n")
    (tmp_path / "pyproject.toml").write_bytes((REPOSITORY / "pyproject.toml").read_bytes())
    done = lint_imports(tmp_path)
    assert done.returncode == 1
    assert "Imports run down one way BROKEN" in done.stdout


def test_envs_is_a_relative_link_to_the_content():
    link = PACKAGE / "envs"
    assert link.is_symlink()
    assert link.readlink() == Path("../envs")
    assert [Path(p).resolve() for p in garat_jax.envs.__path__] == [REPOSITORY / "envs"]


@pytest.mark.parametrize("path", LIBRARY + [s for s in SOURCES if "envs" in s.parts], ids=name_of)
def test_only_dynamics_steps_the_physics_engine(path):
    if name_of(path) != "garat_jax/dynamics.py":
        assert callers(path, "step", ("mjx",)) == []


@pytest.mark.parametrize("path", LIBRARY, ids=name_of)
def test_only_the_guarded_step_and_the_views_of_an_environment_step_it(path):
    views = ("env.py", "methods/grounded.py", "adapters/brax_side.py")
    if name_of(path).removeprefix("garat_jax/") not in views:
        assert callers(path, "step", ("env", "environment", "source", "target")) == []


@pytest.mark.parametrize("path", SOURCES, ids=name_of)
def test_files_stay_readable(path):
    assert path.stem not in ("utils", "util", "helpers", "common")
    lines = path.read_text(encoding="utf-8").count("\n")
    assert lines <= 400, f"{name_of(path)} has {lines} lines; split it"


@pytest.mark.parametrize("path", SOURCES, ids=name_of)
def test_nothing_is_pickled(path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        names += [str(node.module)] if isinstance(node, ast.ImportFrom) else []
        assert not {"pickle", "cloudpickle", "dill", "joblib"} & {n.split(".")[0] for n in names}
        if isinstance(node, ast.keyword) and node.arg == "allow_pickle":
            assert isinstance(node.value, ast.Constant) and node.value.value is False


@pytest.mark.parametrize("path", [p for p in LIBRARY if p.name != "cli.py"], ids=name_of)
def test_the_library_does_not_print(path):
    assert [call.lineno for call in calls(path) if getattr(call.func, "id", "") == "print"] == []
