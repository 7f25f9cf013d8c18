"""The transfer experiment as a whole, tiny; and as a command that is interrupted."""

import dataclasses
import json
import os
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest

from garat_jax import checkpoint
from garat_jax.agents.trpo import TRPOConfig
from garat_jax.envs.pairs import PAIRS
from garat_jax.methods.gat import GATConfig
from garat_jax.presets import METHODS
from garat_jax.runs import RunDirectory
from garat_jax.transfer import TransferConfig, run_transfer
from tests.test_split import finish, free_port

pytestmark = pytest.mark.slow  # a dozen programs to compile

NAME = "inverted_pendulum_heavy"
SEEDS = [0, 1]
REPOSITORY = Path(__file__).resolve().parents[2]
GARAT = "from garat_jax.cli import entry; entry()"
STAGES = [
    "source policy",
    "target policy",
    "grounding",
    "grounded policy",
    "more source training",
    "action noise",
]


def tiny(pair: str = NAME, method: str = "garat", engine: str = "mujoco") -> TransferConfig:
    """Return settings under which every part runs and nothing is learned."""
    preset = METHODS[method](PAIRS[pair], seeds=len(SEEDS), engine=engine)
    small = {"num_envs": 4, "num_steps": 16, "hidden": (8,)}
    learner = preset.grounding
    if isinstance(learner, GATConfig):
        learner = GATConfig(**small, minibatch=16, num_epochs=1)
    else:
        learner = dataclasses.replace(
            learner,
            transformer=dataclasses.replace(
                learner.transformer, **small, num_epochs=1, num_minibatches=2
            ),
            hidden=(8,),
            num_minibatches=2,
        )
    return dataclasses.replace(
        preset,
        agent=TRPOConfig(**small, cg_iterations=3, value_epochs=1, value_minibatch=32),
        grounding=learner,
        max_iterations=2,
        num_updates=2,
        num_retraining=2,
        num_target_transitions=40,
        num_episodes=2,
        num_solving_episodes=2,
    )


def directory(path: Path, resume: bool = False) -> RunDirectory:
    return RunDirectory.create(path, {"pair": NAME}, "garat transfer", SEEDS, resume=resume)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    root = tmp_path_factory.mktemp("transfer") / "run"
    return root, run_transfer(tiny(), directory(root))


def test_it_runs_where_jax_counts_in_double_precision(tmp_path):
    with jax.enable_x64(True):
        result = run_transfer(tiny(), directory(tmp_path))
    assert np.isfinite(result["returns"]["method"]).all()


def test_it_leaves_a_summary_of_everything(finished):
    root, result = finished
    summary = json.loads((root / "summary.json").read_text())
    assert summary == json.loads(json.dumps(result))
    assert summary["format"] == "garat-transfer/1"
    assert (summary["pair"], summary["method"], summary["seeds"]) == (NAME, "garat", SEEDS)
    rows = {
        "returns": ["source_policy", "target_policy", "method"],
        "transition_error": ["source", "grounded", "zero_action"],
    }
    for group, names in rows.items():
        for name in names:
            assert np.isfinite(summary[group][name]).all()
            assert len(summary[group][name]) == len(SEEDS)
    assert summary["scaled"].keys() == {"mean", "standard_error", "per_seed"}
    assert summary["controls"].keys() == {"more_source_training", "action_noise"}
    assert summary["target_transitions"] == 40
    settings = json.loads((root / "config.json").read_text())["settings"]
    assert settings["engine"] == "mujoco"
    assert settings["agent"]["discount"] == TRPOConfig().discount
    assert settings["num_updates"] == 2
    assert summary["seconds"]["compile"] > 0
    assert summary["seconds"]["run"] > 0


def test_env_steps_count_what_each_policy_saw(finished):
    _, result = finished
    steps = {name: set(value) for name, value in result["env_steps"].items()}
    assert steps["source_policy"] == steps["target_policy"] == {2 * 64}
    assert steps["method"] == steps["action_noise"] == {4 * 64}
    assert steps["grounding"] == {2 * 64}


def test_it_leaves_a_report_checkpoints_and_metrics(finished):
    root, result = finished
    assert NAME in (root / "report.html").read_text(encoding="utf-8")
    for stage in STAGES:
        assert checkpoint.latest_step(root / "checkpoints" / stage) == 2, stage
    lines = [json.loads(line) for line in (root / "metrics.jsonl").read_text().splitlines()]
    assert {line["stage"] for line in lines} == set(STAGES)
    errors = [line["error"] for line in lines if line["stage"] == "grounding"]
    assert result["transition_error_curve"] == {"update": [1, 2], "grounded": errors}
    np.testing.assert_allclose(errors[-1], result["transition_error"]["grounded"], rtol=1e-4)


def test_a_finished_run_resumed_gives_the_same_numbers(finished):
    root, result = finished
    again = run_transfer(tiny(), directory(root, resume=True))
    assert {**again, "seconds": None} == {**result, "seconds": None}


@pytest.mark.parametrize(
    ("pair", "method", "engine"),
    [
        *((pair, "garat", "mujoco") for pair in PAIRS if pair != NAME),
        (NAME, "gat", "mujoco"),
        (NAME, "garat", "mjx"),
    ],
)
def test_every_pair_method_and_engine_runs_whole(tmp_path, pair, method, engine):
    result = run_transfer(tiny(pair, method, engine), directory(tmp_path / "run"))
    assert (result["pair"], result["method"]) == (pair, method)
    for group in ("returns", "transition_error"):
        for numbers in result[group].values():
            assert np.isfinite(numbers).all()
    assert min(result["transition_error"]["source"]) > 0


TINY = """
import sys
from garat_jax import cli, presets
from tests.end_to_end.test_transfer import tiny

small = tiny()
presets.METHODS["garat"] = lambda pair, seeds, engine: small
sys.exit(cli.main())
"""
"""`garat`, in which GARAT has the settings of `tiny`."""
COUNTED = """
import atexit, sys
from garat_jax import compilation_cache

compilation_cache.enable()
from jax._src import compiler

compiled, compile = [], compiler.backend_compile_and_load

def counted(backend, module, *arguments):
    compiled.append(str(module.operation.attributes["sym_name"]))
    return compile(backend, module, *arguments)

compiler.backend_compile_and_load = counted
atexit.register(lambda: print("compiled:", *compiled, file=sys.stderr))
"""
"""What says at the end which programs XLA compiled, and did not read from the cache."""


def start_command(*arguments: str, program: str = GARAT, **environment: str):
    return subprocess.Popen(
        [sys.executable, "-W", "ignore", "-c", program, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=REPOSITORY,
        env={**os.environ, "COLUMNS": "500", **environment},
    )


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.mark.parametrize("which", ["first", "second"])
def test_the_command_in_two_processes_finds_what_one_process_finds(
    tmp_path, finished, cache, which
):
    del which  # start; the programs that the first may have kept are there for the second
    out = tmp_path / "run"
    arguments = ["transfer", NAME, "--seeds", "2", "--out", str(out), "--distributed"]
    arguments += ["--coordinator", f"localhost:{free_port()}", "--num-processes", "2"]
    kept = {"JAX_COMPILATION_CACHE_DIR": str(cache)}
    processes = [
        start_command(*arguments, "--process-id", str(number), program=TINY, **kept)
        for number in range(2)
    ]
    try:
        for process in processes:
            finish(process)
    finally:
        for process in processes:
            process.kill()
    assert {path.name for path in tmp_path.iterdir()} == {"run", "run-process-1"}
    for root in (out, tmp_path / "run-process-1"):
        assert (root / "report.html").is_file()
        found = json.loads((root / "summary.json").read_text())
        for group in ("returns", "transition_error"):
            for name, numbers in finished[1][group].items():
                np.testing.assert_allclose(found[group][name], numbers, rtol=1e-3)


def test_the_second_start_of_a_run_compiles_nothing(tmp_path, monkeypatch):
    for name in [name for name in os.environ if name.startswith("JAX_")]:
        monkeypatch.delenv(name)
    arguments = ["transfer", NAME, "--seeds", "2", "--out", str(tmp_path / "run"), "--force"]
    compiled = []
    for _ in range(2):
        process = start_command(
            *arguments, program=COUNTED + TINY, XDG_CACHE_HOME=str(tmp_path / "cache")
        )
        _, complaint = process.communicate(timeout=500)
        assert process.returncode == 0, complaint
        (line,) = [line for line in complaint.splitlines() if line.startswith("compiled:")]
        compiled.append(line.split()[1:])
    assert len(compiled[0]) > 10
    assert compiled[1] == []


def wait_for_lines(path: Path, count: int, process: subprocess.Popen[str]) -> None:
    deadline = time.monotonic() + 120
    while not path.exists() or path.read_text().count("\n") < count:
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline, "the run logged nothing"
        time.sleep(0.05)


def interrupt_after(path: Path, count: int, *arguments: str) -> str:
    """Run a command until a file has some lines, interrupt it, and return what it complained."""
    process = start_command(*arguments)
    try:
        wait_for_lines(path, count, process)
        process.send_signal(signal.SIGINT)
        _, complaint = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 130, complaint
    assert "Traceback" not in complaint
    return complaint


@pytest.mark.parametrize(
    ("command", "folder"),
    [(["transfer", NAME, "--seeds", "1", "--engine", "mujoco"], "."), (["demo"], "transfer")],
)
def test_ctrl_c_leaves_a_checkpoint_and_says_how_to_go_on(tmp_path, command, folder):
    arguments = [*command, "--out", str(tmp_path / "run")]
    run = tmp_path / "run" / folder
    last = interrupt_after(run / "metrics.jsonl", 2, *arguments).splitlines()[-1]
    assert last == f"garat: interrupted; go on with: {shlex.join(['garat', *arguments])} --resume"
    reached = checkpoint.latest_step(run / "checkpoints" / "source policy") or 0
    assert reached >= 1
    again = interrupt_after(run / "metrics.jsonl", reached + 2, *arguments, "--resume")
    assert f"source policy: restored after iteration {reached}" in again
    steps = [json.loads(line)["step"] for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert steps == list(range(1, len(steps) + 1))
