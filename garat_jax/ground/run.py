"""The command `garat ground`: read the files, learn, write the run with its report."""

import contextlib
import dataclasses
import hashlib
import inspect
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import plotly.graph_objects as go

from garat_jax import report
from garat_jax.diagnosis.compare import read_recordings
from garat_jax.diagnosis.export import copy_model
from garat_jax.diagnosis.measurements import Recording
from garat_jax.diagnosis.model_card import Model, load_model, save_card
from garat_jax.diagnosis.progress import tell
from garat_jax.diagnosis.report_data import side_by_side_section
from garat_jax.effects import CATALOGUE
from garat_jax.effects.catalogue import Catalogue, line_in, run_python
from garat_jax.errors import UserError
from garat_jax.ground.learn import Grounded, ground
from garat_jax.ground.source import CARD, SUMMARY
from garat_jax.plain import finite_or_null, to_plain
from garat_jax.report import Fact, Figure, Reproduce, Section
from garat_jax.runs import RunDirectory
from garat_jax.transfer import GroundConfig
from garat_jax.types import Params, Policy


def run_ground(
    model: Path,
    data: Sequence[Path],
    holdout: Sequence[Path],
    config: GroundConfig,
    run: RunDirectory,
    *,
    policy: Path | None = None,
    interval: float | None = None,
    seed: int = 0,
    columns: Path | None = None,
    catalogue: Catalogue | None = None,
) -> Grounded:
    """Ground a model file with recordings.

    It writes summary.json, compare.json, metrics.jsonl, the checkpoint `transformer/`, report.html,
    and the model that it belongs to: model.toml with its files in `model/`.

    Args:
        model: MJCF or model card.
        data: Recordings to learn from.
        holdout: Recordings to prove the result on; some of `data` are held out if there are none.
        config: Settings.
        run: Where to write.
        policy: Python file with the policy that acted; see `load_policy`.
        interval: Seconds of a control step; see `choose_bounds`.
        seed: Seed of everything random.
        columns: Map of the recordings' columns.
        catalogue: The kinds of effect that there are.

    Raises:
        UserError: A file cannot be read, does not fit the model, or cannot be copied.
    """
    loaded = load_model(model, catalogue)
    both = (*data, *holdout)
    recordings, held_out = (read_recordings(loaded, p, columns, both) for p in (data, holdout))
    acting = load_policy(policy, loaded, recordings) if policy else None
    files = [model, *data, *holdout, *(path for path in (columns, policy) if path)]
    for kind, law in (catalogue or {}).items():
        if kind not in CATALOGUE:
            with contextlib.suppress(OSError, TypeError):  # it was written in a notebook
                files.append(Path(inspect.getfile(law)))
    run.record_settings({**to_plain(config), "contents": _contents(loaded, files)})
    done = ground(
        loaded,
        recordings,
        config,
        run,
        holdout=held_out,
        policy=acting,
        interval=interval,
        seed=seed,
        say=tell,
    )
    copied = copy_model(loaded, run.path("model"))
    save_card(run.path(CARD), dataclasses.replace(loaded, mjcf=copied))
    run.write_json("compare.json", done.comparison.to_json())
    run.write_json(SUMMARY, finite_or_null(to_plain(done.summary)))
    _write_report(run, done, loaded.name)
    return done


def _contents(model: Model, files: Sequence[Path]) -> dict[str, str]:
    """Return a digest of each file and of the compiled model: a resumed run has the same.

    What a policy or a law of the user's own reads itself is not among them.
    """
    digests = {str(path): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}
    compiled = model.compile(engine="mujoco").host.digest
    return {path: digest[:16] for path, digest in {**digests, "compiled model": compiled}.items()}


def load_policy(path: Path, model: Model, recordings: Sequence[Recording]) -> Policy:
    """Read a policy from a Python file, which is run: `def policy(obs, key)` that JAX can trace.

    It is given (qpos, qvel) as the sensors report them, [nq + nv], and a PRNG key, and returns the
    command, [nu].

    Args:
        path: The file.
        model: The model that it acts in.
        recordings: What it has to have a command for.

    Raises:
        UserError: The file fails, has no such function, or the function returns something else, or
            no finite number in some recorded state.
    """
    function: Any = getattr(run_python(path, "--policy"), "policy", None)
    if not callable(function):
        raise UserError(f"{path}: holds no policy; expected a function policy(obs, key)")
    host = model.compile(engine="mujoco").host.model
    obs = jax.ShapeDtypeStruct((host.nq + host.nv,), "float32")
    key = jax.random.key(0)
    try:
        command = jax.eval_shape(function, obs, key)
        if getattr(command, "shape", None) != (host.nu,):
            raise UserError(
                f"{path}: policy(obs, key) returns {command}; expected an array of {host.nu} "
                f"command{'s' if host.nu > 1 else ''}, shape ({host.nu},)"
            )
        for recording in recordings:
            states = np.concatenate([recording.qpos, recording.qvel], axis=1, dtype="float32")
            commands = np.asarray(jax.vmap(function, (0, None))(states, key))
            _check_commands(path, recording, states, commands)
    except UserError:
        raise
    except Exception as error:
        where = f"{path}{line_in(path, error)}"
        if isinstance(error, jax.errors.TracerBoolConversionError):
            raise UserError(
                f"{where}: policy(obs, key) takes a decision by a number that is not known while "
                "JAX traces it; write it with jnp.where"
            ) from error
        line = " ".join(str(error).partition("\n")[0].split())
        raise UserError(f"{where}: policy(obs, key): {type(error).__name__}: {line}") from error

    def policy(params: Params, obs: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        del params
        return jnp.asarray(function(obs, key)), jnp.zeros(())

    return policy


def _check_commands(
    path: Path, recording: Recording, states: np.ndarray, commands: np.ndarray
) -> None:
    """Refuse a policy that has no finite command [T, nu] for a recorded state [T, nq + nv]."""
    wrong = ~np.isfinite(commands).all(axis=1)
    if wrong.any():
        i = int(np.argmax(wrong))
        raise UserError(
            f"{path}: policy(obs, key) returns {commands[i].tolist()} at {recording.time[i]:.4g} s "
            f"of {recording.name}, where obs is {np.round(states[i], 4).tolist()}; expected finite "
            "numbers"
        )


def _write_report(run: RunDirectory, done: Grounded, name: str) -> None:
    summary, comparison = done.summary, done.comparison
    errors, chosen = summary["transition_error"], summary["chosen"]
    interval = summary["control"]["interval"]
    before = {"model as it is": chosen["path_error_of_model"]}
    single = {"model as it is": errors["source"], "every command zero": errors["zero_action"]}
    report.write(
        run.path("report.html"),
        kind="A model grounded in measurements",
        title=f"{summary['method']} on {name}",
        lead=" ".join([done.sentence, *(f"Warning: {warning}." for warning in done.warnings)]),
        facts=[
            Fact(f"{100 * comparison.error.before:.3g} %", "held-out error of the model as it is"),
            Fact(f"{100 * comparison.also[0].error:.3g} %", "with the action transformer"),
            Fact(
                f"{100 * comparison.error.noise_floor:.2g} %",
                "what noise and the integrator alone make",
            ),
            Fact(str(summary["transitions"]), "recorded control steps to learn from"),
        ],
        sections=[
            *side_by_side_section(comparison),
            Section(
                "Which update was taken",
                f"Recorded commands are replayed for {1000 * interval * chosen['steps']:.3g} ms "
                f"from {chosen['paths']} states in the recordings that the transformer was learned "
                "from. The error is how far the state strays, as a share of the signals' spread. "
                + _chosen(chosen["update"]),
                figures=[
                    Figure(
                        _curve(run, "path_error", before, "error over a path", chosen["update"]),
                        "Error of the paths over the updates of the transformer.",
                    )
                ],
            ),
            Section(
                "One control step at a time",
                "From each held-out state the recorded command is held for one control step of "
                f"{1000 * interval:.3g} ms in the source, with and without "
                "the transformer. The error is the distance of the next state (qpos, qvel) from "
                "the recorded one (L2), the sensors' noise included. A transformer is learned on "
                "such steps; whether it helps to predict longer motion is said above.",
                figures=[
                    Figure(
                        _curve(run, "error", single, "error of one step"),
                        "Mean error of a held-out step over the updates of the transformer. "
                        "Dashed: the model as it is, and the model with every command zero.",
                    )
                ],
            ),
        ],
        reproduce=Reproduce.from_config(run.read_json("config.json")),
    )


def _chosen(update: int) -> str:
    if update == 0:
        return "The model without a transformer strays least, so none is used."
    return f"The transformer of update {update} strays least, and is the one that is used."


def _curve(
    run: RunDirectory, metric: str, others: Mapping[str, float], label: str, chosen: int = 0
) -> go.Figure:
    """Draw a metric over the updates, beside others that do not change, and the chosen update."""
    lines = [line for line in run.metrics() if line["stage"] == "grounding"]
    figure = go.Figure()
    figure.add_scatter(
        x=[line["step"] for line in lines],
        y=[line[metric][0] for line in lines],
        name="with the transformer",
        line={"color": report.COLOURS[0], "width": 2},
    )
    for colour, (name, value) in zip(report.COLOURS[1:], others.items(), strict=False):
        figure.add_scatter(
            x=[lines[0]["step"], lines[-1]["step"]],
            y=[value] * 2,
            name=name,
            mode="lines",
            line={"color": colour, "width": 1.5, "dash": "dash"},
        )
    if chosen:
        figure.add_scatter(
            x=[chosen],
            y=[lines[chosen - 1][metric][0]],
            name="taken",
            mode="markers",
            marker={"color": report.COLOURS[0], "size": 11},
        )
    figure = report.styled(figure, xaxis_title="update", yaxis_title=label)
    return figure.update_yaxes(rangemode="tozero")
