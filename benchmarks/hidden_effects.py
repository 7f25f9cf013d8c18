"""Hide effects in seven robots and see what the diagnosis finds; or time it beside mujoco.sysid.

Thresholds are tuned on seed 0; a seed whose sets nobody has looked at says what to expect of new
data. Every seed has a result file of its own. Rows are appended to OUT/rows.jsonl as they come, so
an interrupted run goes on. `--sample N` diagnoses the first N sets of a random order; the result
says of how many. A larger sample with `--extend` keeps what the result file has, but for the sets
of robots that are measured `--anew`; each row has its commit. `--category` measures one category of
a seed, of which a sample has few sets, and has a result file of its own. A set that takes longer
than `--limit` counts as wrong. A run of hand-picked cases writes no result. `--timing` needs
`pip install 'mujoco[sysid]'`.
"""

import argparse
import concurrent.futures
import json
import multiprocessing
import os
import signal
import tempfile
import time
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hidden import score
from hidden.generate import Case, Surveys, Truth, draw, generate, list_cases, shuffled
from hidden.robots import ROBOTS
from jobs import end_with_parent
from record import command_line, result_path, write_result

from garat_jax.diagnosis import diagnose, load_model
from garat_jax.diagnosis.compare import read_recordings
from garat_jax.dynamics import native_model
from garat_jax.effects import CATALOGUE
from garat_jax.plain import finite_or_null, to_plain
from garat_jax.provenance import git_state

NAME = "hidden_effects"
"""What the names of the result files begin with."""


def run_case(case: Case, robots: Sequence[str], limit: int = 0) -> dict[str, Any]:
    """Draw, record and diagnose one set, in `limit` seconds if that is not 0; return its row."""
    row: dict[str, Any] = {"case": case.name, "category": case.category, "seed": case.seed[0]}
    lacking = [k for k in case.kinds if case.category != "outside" and k not in CATALOGUE]
    if lacking:
        return row | {"status": score.NOT_YET, "lacking": lacking}
    started = time.monotonic()

    def stop(*_) -> None:
        raise TimeoutError

    signal.signal(signal.SIGALRM, stop)
    signal.alarm(limit)
    try:
        scenes = Surveys()
        truth = draw(case, scenes, robots)
        row |= {**truth.to_json(), "seed": case.seed[0]}
        with tempfile.TemporaryDirectory() as folder:
            paths = generate(truth, scenes[truth.robot], Path(folder))
            row["seconds_to_make"] = time.monotonic() - started
            row |= _diagnose(truth, paths)
    except TimeoutError:
        row |= {"status": f"error: not ended within {limit} s"}
    except Exception as error:
        row |= {"status": f"error: {error!r}", "traceback": traceback.format_exc(limit=-4)}
    finally:
        signal.alarm(0)
    return finite_or_null(to_plain(row))


def _diagnose(truth: Truth, paths: list[Path]) -> dict[str, Any]:
    model = load_model(paths[0].parent / f"{truth.robot}.xml")
    fitted, held_out = read_recordings(model, paths[:-1]), read_recordings(model, paths[-1:])
    found = diagnose(model, fitted, held_out)
    row = score.score(found, truth, native_model(model.compile(engine="mujoco")))
    error = found.error
    row |= {"before": error.before, "after": error.after, "noise_floor": error.noise_floor}
    true = score.true_error(model, fitted, held_out, found, truth)
    if true:
        row |= {"true_model": true, "ratio": error.after / true}
    return {"status": "done", **row}


def say(row: dict[str, Any]) -> None:
    """Print one row."""
    head = f"{row['case']:44s} {row.get('robot', ''):9s}"
    if row["status"] != "done":
        print(f"{head} {row['status']}", flush=True)
        return
    true = f"{row['true_model']:.3g}" if row.get("true_model") else "–"
    errors = f"{row['before']:.3g} → {row['after']:.3g} (true model {true})"
    secrets = "; ".join(f"{s['kind']} at {s['target']}" for s in row["secrets"]) or "nothing"
    mark = "right" if row["ok"] else "WRONG"
    first = " = ".join(row["first"][:4]) or "nothing"
    print(f"{head} {mark}: hid {secrets}, first {first}; {row['verdict']}, {len(row['claimed'])} "
          f"claimed; {errors}; {row['seconds']:.0f} s", flush=True)  # fmt: skip
    for e in row.get("estimates", []):
        print(f"{'':10s}{e['parameter']} {e['estimate']:.4g} [{e['low']:.4g}, {e['high']:.4g}], "
              f"true {e['true']:.4g}", flush=True)  # fmt: skip


def read_rows(path: Path, commit: str | None) -> dict[str, dict[str, Any]]:
    """Return the rows of an interrupted run of the same commit, by case."""
    if not path.exists():
        return {}
    rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    same = [row for row in rows if row["status"] == "done" and row["commit"] == commit]
    return {row["case"]: row for row in same}


def result_name(seed: int, category: str | None) -> str:
    """Return the name of the result file of a seed, or of one of its categories."""
    return f"{NAME}_seed_{seed}" + (f"_{category}" if category else "")


def recorded_rows(seed: int, category: str | None) -> dict[str, dict[str, Any]]:
    """Return the rows of the result file that come from this seed, by case."""
    path = result_path(result_name(seed, category))
    if not path.exists():
        return {}
    rows = json.loads(path.read_text(encoding="utf-8"))["rows"]
    return {row["case"]: row for row in rows if row["seed"] == seed and row["status"] == "done"}


def _begin(numbers, jobs: int) -> None:
    """Let a job end with this process, and keep it to its share of the cores.

    Threads of two jobs that take turns wait for long. BLAS has made its threads by now, on
    all cores: `run` sees to it that they are as few.
    """
    end_with_parent()
    if hasattr(os, "sched_setaffinity"):
        cores = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, cores[numbers.get() % len(cores) :: jobs])


def run(
    cases: list[Case],
    robots: Sequence[str],
    jobs: int,
    path: Path,
    recorded: dict[str, dict[str, Any]],
    limit: int,
) -> list[dict[str, Any]]:
    """Run all cases that have no earlier row, append them to a file, and return all rows."""
    commit = (git_state() or {}).get("commit")
    earlier = recorded | read_rows(path, commit)
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = [earlier[case.name] for case in cases if case.name in earlier]
    todo = [case for case in cases if case.name not in earlier]
    os.environ["OPENBLAS_NUM_THREADS"] = str(max(1, (os.cpu_count() or 1) // jobs))
    context = multiprocessing.get_context("spawn")
    numbers = context.SimpleQueue()
    for number in range(jobs):
        numbers.put(number)
    with concurrent.futures.ProcessPoolExecutor(
        jobs, context, initializer=_begin, initargs=(numbers, jobs)
    ) as pool:
        futures = [pool.submit(run_case, case, robots, limit) for case in todo] if jobs > 1 else []
        made = (
            (future.result() for future in concurrent.futures.as_completed(futures))
            if jobs > 1
            else (run_case(case, robots, limit) for case in todo)
        )
        for row in made:
            row["commit"] = commit
            rows.append(row)
            say(row)
            with path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(row) + "\n")
    return rows


def report(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Print and return the table of measures beside their targets."""
    lines = score.aggregate(rows)
    print()
    for line in lines:
        value = line.get("value")
        text = f"{line['measure']}: {'–' if value is None else f'{value:.3g}'}"
        if "count" in line:
            text += f" of {line['count']}"
        if "interval" in line:
            text += " (95 % interval {:.2f}–{:.2f})".format(*line["interval"])
        if "target" in line:
            text += f", target {line['target']}: {'met' if line['met'] else 'falls short'}"
        print(text)
        for name in (*line.get("short", []), *line.get("cases", [])):
            print(f"    {name}")
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=0, help="tune on 0, report on others")
    parser.add_argument("--only", nargs="+", metavar="TEXT", help="cases whose name holds a text")
    parser.add_argument("--category", choices=score.CATEGORIES, help="only its sets")
    parser.add_argument("--robots", nargs="+", choices=list(ROBOTS), default=list(ROBOTS))
    parser.add_argument("--sample", type=int, metavar="N", help="the first N of a random order")
    parser.add_argument("--extend", action="store_true", help="keep the rows of the result file")
    parser.add_argument(
        "--anew", nargs="+", choices=list(ROBOTS), default=[], help="robots whose rows are not kept"
    )
    parser.add_argument("--limit", type=int, default=0, metavar="SECONDS", help="of a set; 0: none")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, help="folder of rows.jsonl")
    parser.add_argument("--timing", action="store_true", help="time garat beside mujoco.sysid")
    arguments = parser.parse_args()
    command = command_line()
    if arguments.timing:
        from hidden import timing

        print(write_result(f"{NAME}_timing", timing.measure_all(), seeds=[], command=command))
        return
    cases = shuffled(list_cases(arguments.seed), arguments.seed)
    if arguments.category:
        cases = [case for case in cases if case.category == arguments.category]
    num_cases = len(cases)
    if arguments.anew and not arguments.extend:
        parser.error("--anew needs --extend: it is said of which rows are kept")
    if arguments.only:
        cases = [c for c in cases if any(text in c.name for text in arguments.only)]
    cases = cases[: arguments.sample]
    path = (arguments.out or Path("runs") / f"{NAME}-{arguments.seed}") / "rows.jsonl"
    earlier = recorded_rows(arguments.seed, arguments.category) if arguments.extend else {}
    if beyond := earlier.keys() - {case.name for case in cases}:
        parser.error(f"--extend would drop {len(beyond)} recorded sets; give a larger --sample")
    kept = {name: row for name, row in earlier.items() if row["robot"] not in arguments.anew}
    rows = run(cases, arguments.robots, arguments.jobs, path, kept, arguments.limit)
    lines = report(rows)
    picked = arguments.only or arguments.robots != list(ROBOTS)
    if not picked and not any(row["status"] == score.NOT_YET for row in rows):
        details = {"cases": num_cases, "sample": len(rows), "category": arguments.category}
        details |= {"anew": arguments.anew, "table": lines}
        name, seeds = result_name(arguments.seed, arguments.category), [arguments.seed]
        print(write_result(name, rows, seeds=seeds, command=command, details=details))


if __name__ == "__main__":
    main()
