"""Workers of the benchmarks do not outlive the process that started them."""

import subprocess
import sys
from pathlib import Path

from benchmarks import jobs

PARENT = """
import multiprocessing, sys, time
sys.path.insert(0, {folder!r})
from jobs import end_with_parent

def work():
    end_with_parent()
    print("begun", flush=True)
    time.sleep(60)

if __name__ == "__main__":
    job = multiprocessing.get_context("spawn").Process(target=work)
    job.start()
    job.join()
"""


def test_a_worker_ends_when_its_parent_is_killed(tmp_path):
    script = tmp_path / "parent.py"
    script.write_text(PARENT.format(folder=str(Path(jobs.__file__).parent)))
    parent = subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, text=True)
    assert parent.stdout
    assert parent.stdout.readline() == "begun\n"
    parent.kill()
    rest, _ = parent.communicate(timeout=20)  # the worker holds the other end while it runs
    assert rest == ""
