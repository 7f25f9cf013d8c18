"""The set-up: the locked versions, and what `make setup` does on a day when one of them is gone."""

import os
import re
import subprocess
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

REPOSITORY = Path(__file__).resolve().parent.parent
LOCK = REPOSITORY / "requirements.lock"
PEERS = REPOSITORY / "requirements-peers.lock"
PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def locked(lock: Path = LOCK) -> dict[str, Requirement]:
    lines = lock.read_text(encoding="utf-8").splitlines()
    requirements = [Requirement(line) for line in lines if line and not line.startswith("#")]
    return {canonicalize_name(requirement.name): requirement for requirement in requirements}


def test_every_version_is_exact_but_that_of_the_nightly():
    for name, requirement in locked().items():
        operators = [specifier.operator for specifier in requirement.specifier]
        assert operators == ([">="] if name == "tfp-nightly" else ["=="]), str(requirement)


def test_the_nightly_range_takes_later_builds_and_releases():
    specifier = locked()["tfp-nightly"].specifier
    for version in ("0.26.0.dev20261027", "0.27.0.dev20271231", "0.26.0"):
        assert specifier.contains(version)
    assert not specifier.contains("0.25.0.dev20240101")


def test_the_peers_versions_are_exact_and_none_is_locked_twice():
    assert not locked(PEERS).keys() & locked().keys()
    for name, requirement in locked(PEERS).items():
        assert [s.operator for s in requirement.specifier] == ["=="], name


@pytest.mark.parametrize("line", PROJECT["optional-dependencies"]["bench"])
def test_what_the_bench_extra_asks_for_is_locked_to_a_version_that_it_accepts(line):
    wanted = Requirement(line)
    (exact,) = (locked() | locked(PEERS))[canonicalize_name(wanted.name)].specifier
    assert wanted.specifier.contains(exact.version), line


@pytest.mark.parametrize("lock", [LOCK, PEERS], ids=lambda lock: lock.name)
def test_the_locks_name_no_place_to_install_from(lock):
    text = lock.read_text(encoding="utf-8")
    assert not re.search(r"https?:|file:|--index-url|--extra-index-url|--find-links|\s@\s", text)


@pytest.mark.parametrize(
    "line", [*PROJECT["dependencies"], *PROJECT["optional-dependencies"]["dev"]]
)
def test_what_the_project_asks_for_is_locked_to_a_version_that_it_accepts(line):
    wanted = Requirement(line)
    (exact,) = locked()[canonicalize_name(wanted.name)].specifier
    assert wanted.specifier.contains(exact.version), line


def test_no_dependency_is_bound_to_an_address():
    extras = PROJECT["optional-dependencies"]
    assert {"cuda", "logs", "bench", "dev"} <= extras.keys()
    for line in [*PROJECT["dependencies"], *(line for lines in extras.values() for line in lines)]:
        assert Requirement(line).url is None


def test_every_installed_dependency_is_locked():
    """Each distribution that the package needs, directly or not, has its line in the lock."""
    known, seen = locked(), set()
    todo = [Requirement(line) for line in PROJECT["dependencies"]]
    while todo:
        requirement = todo.pop()
        name = canonicalize_name(requirement.name)
        if name in seen:
            continue
        seen.add(name)
        assert name in known, f"{name} is missing in {LOCK.name}"
        environments = [{"extra": extra} for extra in requirement.extras or {""}]
        for line in metadata.requires(name) or []:
            child = Requirement(line)
            if child.marker is None or any(child.marker.evaluate(e) for e in environments):
                todo.append(child)


# What a make that runs these tests would hand down to the make that they run.
MAKE_VARIABLES = ("MAKEFLAGS", "MAKELEVEL", "MFLAGS", "MAKEOVERRIDES")

FAKE_PYTHON = """#!/bin/sh
# Stands in for Python: logs what is asked of it, and refuses what FAIL matches.
echo "$*" >> "{log}"
if [ "$1 $2" = "-m venv" ]; then mkdir -p "$3/bin" && ln -s "{python}" "$3/bin/python"; exit 0; fi
case "$*" in {fail}) echo "no matching distribution" >&2; exit 1;; esac
"""


@pytest.fixture
def make(tmp_path):
    """Run make in a copy of the set-up whose Python only pretends to install."""

    for name in ("Makefile", "requirements.lock", "pyproject.toml"):
        (tmp_path / name).write_bytes((REPOSITORY / name).read_bytes())
    outside = {name: value for name, value in os.environ.items() if name not in MAKE_VARIABLES}

    def run(*targets: str, fail: str = "nothing") -> tuple[subprocess.CompletedProcess, list[str]]:
        log, python = tmp_path / "log", tmp_path / "python"
        log.write_text("")
        python.write_text(FAKE_PYTHON.format(log=log, python=python, fail=fail))
        python.chmod(0o755)
        done = subprocess.run(
            ["make", *targets, f"PYTHON={python}"],
            cwd=tmp_path,
            env=outside,
            capture_output=True,
            text=True,
        )
        return done, log.read_text().splitlines()

    return run


def test_setup_installs_the_lock_and_then_the_package(make):
    done, log = make("setup")
    assert done.returncode == 0, done.stderr
    installs = [line.partition("install ")[2] for line in log if "install" in line]
    assert installs == [
        "--quiet -r requirements.lock",
        "--quiet --no-deps --no-build-isolation --config-settings editable_mode=compat -e .",
    ]


def test_setup_is_skipped_when_it_is_up_to_date(make):
    make("setup")
    done, log = make("setup")
    assert (done.returncode, log) == (0, [])


def test_a_missing_nightly_is_replaced_by_another_build(make, tmp_path):
    done, log = make("setup", fail='*"-r requirements.lock"')
    assert done.returncode == 0, done.stderr
    assert "another build of tfp-nightly" in done.stderr
    assert log[-1].endswith("-e .")
    assert any(line.endswith("install --quiet --no-deps --pre tfp-nightly") for line in log)
    rest = (tmp_path / ".venv" / "without-nightly.txt").read_text()
    assert "tfp-nightly" not in rest.replace("Only tfp-nightly", "")
    assert f"distrax=={next(iter(locked()['distrax'].specifier)).version}" in rest


def test_without_any_nightly_a_later_release_is_tried(make):
    done, log = make("setup", fail='*"-r requirements.lock"|*"--pre tfp-nightly"')
    assert done.returncode == 0, done.stderr
    assert any(line.endswith("--no-deps tensorflow-probability>=0.26") for line in log)


@pytest.mark.parametrize(
    ("fail", "message"),
    [
        ('*"-r requirements.lock"|*"-c import distrax"', "distrax does not work"),
        ('*"install"*', "no matching distribution"),
        ('*"version_info"*', "Python 3.11 or newer"),
    ],
)
def test_a_failed_setup_fails_and_is_tried_again(make, fail, message):
    done, _ = make("setup", fail=fail)
    assert done.returncode != 0
    assert message in done.stderr
    done, log = make("setup")
    assert done.returncode == 0
    assert log


def test_ci_reports_the_status_of_the_checks(tmp_path):
    """`.ci/run` ends in pytest's own last line and fails when the checks fail."""
    (tmp_path / ".ci").mkdir()
    script = tmp_path / ".ci" / "run"
    script.write_bytes((REPOSITORY / ".ci" / "run").read_bytes())
    script.chmod(0o755)
    for lint, status in ((0, 0), (0, 1), (1, 0)):
        tests = f"@echo '=== 3 passed in 0.1s ==='; exit {status}"
        rules = f"check: static test\nstatic:\n\t@exit {lint}\ntest:\n\t{tests}\n"
        (tmp_path / "Makefile").write_text(rules)
        outside = {name: value for name, value in os.environ.items() if name not in MAKE_VARIABLES}
        done = subprocess.run([script], capture_output=True, text=True, cwd="/", env=outside)
        assert bool(done.returncode) == bool(lint or status)
        assert done.stdout.splitlines()[-1] == "=== 3 passed in 0.1s ==="
        assert done.stderr == ""
