import dataclasses
import errno
import subprocess
import sys
from pathlib import Path

import pytest

from garat_jax import cli, devices, transfer
from garat_jax.commandline import how_to_go_on, parse
from garat_jax.commands.checks import make_run, writing
from garat_jax.earlier_run import earlier_run_kept
from garat_jax.errors import DivergedError, UserError, nearest, unknown_name
from garat_jax.runs import RunDirectory
from garat_jax.terminal import print_table, say
from tests.test_split import free_port


def garat(*arguments: str) -> subprocess.CompletedProcess[str]:
    program = [sys.executable, "-m", "garat_jax"]
    return subprocess.run([*program, *arguments], capture_output=True, text=True, timeout=120)


def test_letters_that_the_output_has_no_code_for_are_escaped(monkeypatch):
    monkeypatch.setenv("PYTHONIOENCODING", "ascii")
    done = garat("effects", "viscous_damping")
    assert done.returncode == 0, done
    assert r"\u03c4" in done.stdout


def assert_refused(done: subprocess.CompletedProcess[str], *parts: str) -> None:
    assert done.returncode == 2, done
    assert done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert line.startswith("garat: error: ")
    for part in parts:
        assert part in line


@pytest.mark.parametrize("module", ["garat_jax", "garat_jax.cli", "garat_jax.runs"])
def test_import_loads_nothing_heavy(module):
    heavy = ("jax", "mujoco", "brax", "flax", "pandas", "plotly", "scipy", "orbax")
    program = f"import sys, {module}; print([m for m in {heavy!r} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout == "[]\n", done


def test_help_names_every_command():
    done = garat("--help")
    assert done.returncode == 0
    assert done.stderr == ""
    for name in cli.COMMANDS:
        assert f" {name} " in done.stdout


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_help_of_a_command_explains_every_option(name):
    done = garat(name, "--help")
    assert done.returncode == 0
    for field in dataclasses.fields(cli.COMMANDS[name]):  # pyright: ignore[reportArgumentType]
        positional = field.name.upper() in done.stdout
        assert positional or f"--{field.name.replace('_', '-')}" in done.stdout
    assert "default: None" not in done.stdout
    assert "default: )" not in done.stdout


@pytest.mark.parametrize("arguments", [["transfer", "--help"], ["list"], ["compare", "--help"]])
def test_output_that_nobody_reads_ends_in_silence(arguments):
    program = [sys.executable, "-m", "garat_jax", *arguments]
    with subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.close()
        _, complaint = process.communicate(timeout=120)
    assert (process.returncode, complaint) == (1, b"")


def test_version():
    done = garat("--version")
    assert (done.returncode, done.stdout) == (0, "garat 0.1.0\n")


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        ([], ["no command", "demo, transfer"]),
        (["transfr", "x"], ["unknown command 'transfr'", "did you mean transfer?"]),
        (["qqqq"], ["unknown command 'qqqq'", "known: add, compare"]),
        (["--verison"], ["unknown option '--verison'", "--version"]),
        (["transfer", "x", "--sedes", "2"], ["'--sedes'", "did you mean --seeds"]),
        (["transfer", "x", "--sedes=2"], ["'--sedes'", "did you mean --seeds"]),
        (["transfer"], ["missing: PAIR"]),
        (["transfer", "x", "y"], ["Unrecognized", "y"]),
        (["transfer", "x", "--seeds", "many"], ["--seeds 'many': expected a whole number"]),
        (["transfer", "x", "--seeds=1.5"], ["--seeds '1.5': expected a whole number"]),
        (["ground", "x", "y", "--interval", "abc"], ["--interval 'abc': expected a number"]),
        (["transfer", "x", "--seeds"], ["--seeds: expected a value after it"]),
        (["transfer", "x", "--seeds", "0"], ["--seeds 0: expected 1 to 2147483648"]),
        (["transfer", "x", "--seeds", "2", "--seeds=3"], ["--seeds is given twice"]),
        (["compare", "x", "y", "--out", "a", "--out", "b"], ["--out is given twice"]),
        (["compare", "x", "y", "--also", "--force"], ["--also: expected one value or more"]),
        (["compare", "x", "y", "--also"], ["--also: expected one value or more"]),
        (["transfer", "x", "--engine", "mjxx"], ["'mjxx'", "'auto', 'mjx', 'mujoco'"]),
        (["transfer", "x", "--distributed", "--resume"], ["--distributed", "leave out --resume"]),
        (["transfer", "x", "--process-id", "1"], ["--process-id", "with --distributed"]),
        (["transfer", "x", "--device", "abacus"], ["'abacus'", "'auto', 'cpu', 'gpu', 'tpu'"]),
        (["compare", "no.xml", "no.csv"], ["MODEL", "there is no file no.xml"]),
        (["compare", __file__], ["missing: DATA"]),
        (["compare", "--also", "a", "b", "c"], ["missing: MODEL, DATA", "put MODEL before it"]),
        (["compare", "x", "y", "--also=--force"], ["--also: expected one value or more"]),
        (["compare", "x", "y", "--out", "--also=a", "z"], ["--out: expected a value after it"]),
        (["compare", "x", "y", "--force=yes"], ["--force: expected no value after it"]),
        (["compare", "x", "--help=x"], ["unknown option of garat compare '--help'"]),
        (["compare", "--alos", "--help"], ["did you mean --also"]),
        (["plan", "x", "--separate", "a"], ["--separate: expected 2 values after it"]),
        (
            ["compare", __file__, __file__, "--also", "no.xml", "--also", __file__],
            ["--also: there is no file no.xml"],
        ),
        (["compare", __file__, "no.csv"], ["DATA", "there is no file no.csv"]),
        (["compare", __file__, "."], ["DATA", ". is a folder; name the files in it"]),
        (["diagnose", __file__, "no.csv"], ["DATA", "there is no file no.csv"]),
        (["diagnose", __file__, __file__, "--holdout", "no.csv"], ["--holdout", "no file no.csv"]),
        (["diagnose", __file__, __file__, "--holdout", __file__], ["test_cli.py is given twice"]),
        (
            ["diagnose", __file__, __file__, "--condition", f"loaded={__file__}"],
            ["test_cli.py is given twice"],
        ),
        (["compare", __file__, __file__, __file__], ["test_cli.py is given twice"]),
        (
            ["add", __file__, "x", "--at", "y", "--fit", __file__, __file__, "--out", "never.toml"],
            ["test_cli.py is given twice"],
        ),
        (["demo", "--seed", "-1", "--out", "never"], ["--seed -1: expected 0 to 2147483643"]),
        (
            ["demo", "--seed", "2147483644", "--out", "never"],  # it has five of them
            ["--seed 2147483644: expected 0 to 2147483643"],
        ),
        (
            ["transfer", "x", "--seeds", "10000000000000"],
            ["--seeds 10000000000000: expected 1 to 2147483648"],
        ),
        (
            ["effects", "viscous_dampin"],
            ["did you mean viscous_damping? (--effects FILE.py adds others)"],
        ),
        (["compare", 300 * "n" + ".xml", "no.csv"], ["n.xml: File name too long"]),
        (["transfer", "hopper_heavy", "--out", 300 * "n"], ["nn: File name too long"]),
        (["demo", "--measurements", "nowhere"], ["--measurements", "no folder nowhere"]),
    ],
)
def test_a_users_mistake_is_one_line_and_status_2(arguments, parts):
    assert_refused(garat(*arguments), *parts)


@dataclasses.dataclass(frozen=True)
class Failing:
    """Fail."""

    how: str = "user"
    force: bool = False
    resume: bool = False

    def run(self) -> None:
        """Fail as asked."""
        failures = {
            "user": UserError("expected an apple,\n got a pear"),
            "interrupt": KeyboardInterrupt(),
            "full": OSError(errno.ENOSPC, "No space left on device"),
            "diverged": DivergedError("step 3, seed 1: the loss is NaN"),
        }
        if self.how == "library":
            int("pear")
        raise failures[self.how]


@pytest.fixture
def failing(monkeypatch):
    monkeypatch.setitem(cli.COMMANDS, "fail", Failing)


def test_names_are_printed_as_they_are(capsys):
    say("joint/robot:leg: [b]1[/b]")
    print_table(["joint"], [["left:hand:"]])
    printed = capsys.readouterr().out
    assert "joint/robot:leg: [b]1[/b]" in printed
    assert "left:hand:" in printed


def test_an_error_is_one_line(failing, capsys):
    assert cli.main(["fail"]) == 2
    assert capsys.readouterr().err == "garat: error: expected an apple, got a pear\n"


def test_a_full_disk_is_one_line(failing, capsys):
    assert cli.main(["fail", "--how", "full"]) == 2
    assert capsys.readouterr().err == "garat: error: No space left on device\n"


def test_a_fault_of_the_program_keeps_its_traceback(failing):
    with pytest.raises(ValueError, match="invalid literal"):
        cli.main(["fail", "--how", "library"])


def test_a_diverged_run_is_one_line_and_status_1(failing, capsys):
    assert cli.main(["fail", "--how", "diverged"]) == 1
    assert capsys.readouterr().err == "garat: error: step 3, seed 1: the loss is NaN\n"


def test_an_interrupt_says_how_to_go_on(failing, capsys):
    assert cli.main(["fail", "--how", "interrupt", "--force"]) == 130
    line = capsys.readouterr().err
    assert line == "garat: interrupted; go on with: garat fail --how interrupt --resume\n"


def test_a_run_that_a_killed_process_was_to_replace_is_put_back(tmp_path, monkeypatch, capsys):
    RunDirectory.create(tmp_path / ".run.replaced", {}, "garat fail", [0]).log(1, loss=0.5)
    RunDirectory.create(tmp_path / "run", {}, "garat fail", [0])

    def fail(self):
        with make_run(self, tmp_path / "run"):
            raise UserError("wrong input")

    monkeypatch.setattr(Failing, "run", fail)
    monkeypatch.setitem(cli.COMMANDS, "fail", Failing)
    assert cli.main(["fail", "--force"]) == 2
    assert f"put the run back in {tmp_path / 'run'} that" in capsys.readouterr().err
    run = RunDirectory.open(tmp_path / "run")
    assert [entry["loss"] for entry in run.metrics()] == [0.5]
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_an_interrupt_before_a_replacement_has_results_leaves_the_earlier_run(
    tmp_path, monkeypatch, capsys
):
    out = tmp_path / "run"
    earlier = RunDirectory.create(out, {}, "garat fail", [0])
    earlier.log(1, loss=0.5)

    def interrupted(self):
        with earlier_run_kept(out):
            RunDirectory.create(out, {}, "garat fail", [0], force=True)
            raise KeyboardInterrupt

    monkeypatch.setattr(Failing, "run", interrupted)
    monkeypatch.setitem(cli.COMMANDS, "fail", Failing)
    assert cli.main(["fail", "--force"]) == 130
    line = capsys.readouterr().err
    said = f"the earlier run stays in {out}; start again with: garat fail --force\n"
    assert line == f"garat: interrupted; {said}"
    assert [entry["loss"] for entry in RunDirectory.open(out).metrics()] == [0.5]


def test_an_interrupt_of_what_cannot_resume_says_how_to_start_again(monkeypatch, capsys):
    def interrupted(self):
        raise KeyboardInterrupt

    monkeypatch.setattr(cli.Diagnose, "run", interrupted)
    assert cli.main(["diagnose", "my model.xml", "a.csv"]) == 130
    line = capsys.readouterr().err
    assert line.endswith("start again with: garat diagnose 'my model.xml' a.csv --force\n")


def test_a_run_of_several_processes_cannot_go_on():
    line = how_to_go_on(["transfer", "p", "--distributed"], cli.COMMANDS)
    assert line == "start again with: garat transfer p --distributed --force"


def test_arguments_reach_the_command():
    command = parse(["transfer", "p", "--seeds", "3", "--resume"], cli.COMMANDS, "")
    assert command == cli.Transfer("p", seeds=3, resume=True)


def test_an_output_that_fails_leaves_no_folders_and_is_tried_first(tmp_path):
    out = tmp_path / "new" / "deep" / "x.csv"
    with pytest.raises(UserError, match="no luck"), writing(out, ".csv", force=False):
        raise UserError("no luck")
    assert list(tmp_path.iterdir()) == []
    with writing(out, ".csv", force=False):
        out.touch()
    with pytest.raises(UserError, match="no luck"), writing(out, ".csv", force=True):
        raise UserError("no luck")
    assert out.is_file()
    under_a_file = out / "new" / "x.csv"
    with pytest.raises(UserError, match="cannot be written"), writing(under_a_file, ".csv", False):
        raise AssertionError


def test_a_list_option_may_be_given_in_several_places():
    words = "m.xml d.csv --holdout a.csv b.csv --force --effects=e.py --holdout=c.csv --force"
    command = parse(["diagnose", *words.split()], cli.COMMANDS, "")
    holdout = tuple(map(Path, ("a.csv", "b.csv", "c.csv")))
    data, effects = (Path("d.csv"),), (Path("e.py"),)
    expected = cli.Diagnose(Path("m.xml"), data, effects=effects, force=True, holdout=holdout)
    assert command == expected


def test_nearest_is_closest_first_and_ignores_case():
    assert nearest("Hoper", ["walker2d", "Hopper", "hop"])[0] == "Hopper"
    assert nearest("xyz", ["walker2d"]) == []


def test_unknown_name_without_a_near_one_lists_all():
    assert "known: a, b" in str(unknown_name("effect", "friction", ["b", "a"]))


def test_another_process_writes_beside_where_the_first_one_does(tmp_path, monkeypatch, capsys):
    def stop(config, run):
        raise UserError(f"it writes into {run.root}")

    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    monkeypatch.setattr(devices, "join_processes", lambda *arguments: 1)
    monkeypatch.setattr(transfer, "run_transfer", stop)
    for out in (".", str(here), "../here"):
        assert cli.main(["transfer", "hopper_heavy", "--distributed", "--out", out]) == 2
        assert f"it writes into {here}-process-1\n" in capsys.readouterr().err


@pytest.mark.parametrize("joining", [[], ["--distributed", "--num-processes", "1"]])
def test_a_device_that_is_not_there_is_refused_alone_and_with_other_processes(joining, tmp_path):
    arguments = ["transfer", "inverted_pendulum_heavy", "--device", "tpu", "--out", str(tmp_path)]
    if joining:
        joining = [*joining, "--process-id", "0", "--coordinator", f"localhost:{free_port()}"]
    assert_refused(garat(*arguments, *joining), "no device 'tpu'", "--device")


def test_a_device_that_comes_too_late_is_refused():
    program = "import jax; jax.devices(); from garat_jax.devices import use; use('gpu')"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert "UserError: JAX computes on 'cpu' already, so 'gpu' comes too late" in done.stderr
