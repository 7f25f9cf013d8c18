"""The documents: numbers are the result files', links lead somewhere, snippets run."""

import re
import subprocess
import sys
import tomllib
import types
from pathlib import Path

import numpy as np
import pytest

from garat_jax.diagnosis.hidden import make_recordings
from garat_jax.diagnosis.maps import read_map
from garat_jax.diagnosis.model_card import load_model
from garat_jax.effects.catalogue import ENTRY_POINTS
from tests import models
from tests.probe_envs import Hang

REPOSITORY = Path(__file__).resolve().parent.parent
DOCUMENTS = [*REPOSITORY.glob("*.md"), *(REPOSITORY / "docs").glob("*.md")]
SNIPPETS = re.findall(r"```python\n(.*?)```", (REPOSITORY / "README.md").read_text(), re.DOTALL)


def test_tables_are_what_the_result_files_give():
    program = REPOSITORY / "benchmarks" / "figures" / "tables.py"
    done = subprocess.run(
        [sys.executable, str(program), "--check"], cwd=REPOSITORY, capture_output=True, text=True
    )
    assert done.returncode == 0, f"{done.stdout}; run python benchmarks/figures/tables.py"


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)
def test_relative_links_lead_somewhere(path):
    text = path.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if "://" not in target:
            name, _, heading = target.partition("#")
            page = path.parent / name if name else path
            assert page.exists(), f"{path.name}: {target}"
            assert not heading or heading in _anchors(page), f"{path.name}: {target}"


def _anchors(page: Path) -> set[str]:
    """Return what GitHub makes of a page's headings, by which links name them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("number", range(len(SNIPPETS)))
def test_the_readmes_snippets_compile(number):
    compile(SNIPPETS[number], f"README snippet {number}", "exec")


def test_the_readmes_world_runs(capsys):
    (snippet,) = (text for text in SNIPPETS if "make_world(" in text)
    exec(snippet, {})
    assert "(64, 4)" in capsys.readouterr().out


@pytest.mark.filterwarnings("ignore:Brax System:UserWarning")
@pytest.mark.filterwarnings("ignore:Accessing .* directly from `Data` is deprecated")
def test_the_page_on_your_own_robot_runs(tmp_path, monkeypatch, capsys):
    page = (REPOSITORY / "docs" / "own_robot.md").read_text(encoding="utf-8")
    (model,) = re.findall(r"```xml\n(.*?)```", page, re.DOTALL)
    monkeypatch.chdir(tmp_path)
    Path("wheel.xml").write_text(model)
    names: dict = {"__name__": "own_robot"}
    monkeypatch.setitem(sys.modules, "own_robot", types.ModuleType("own_robot"))  # for dataclasses
    for snippet in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        exec(snippet, names)
    source, target = names["config"].pair.worlds()
    assert source.env.obs_size == target.env.obs_size == names["obs"].shape[1]
    assert names["obs"].shape == (8, 4)
    assert np.isfinite(names["metrics"]["value_loss"])
    assert "(8, 4)" in capsys.readouterr().out


def test_the_page_on_python_runs(tmp_path, monkeypatch, capsys):
    page = (REPOSITORY / "docs" / "python.md").read_text(encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    Path("pendulum.xml").write_text(models.PENDULUM)
    for name, seed in (("recordings", 5), ("recordings/warm", 6)):
        made = make_recordings(
            Path("pendulum.xml"), Path("made", str(seed)), seed, num_recordings=3, seconds=3.0,
            rate=125.0, kind="coulomb_friction",
        )  # fmt: skip
        Path(name).mkdir()
        for path in (*made.fit, *made.holdout):
            path.rename(Path(name, path.name))
    names: dict = {"task": Hang(Path("pendulum.xml"))}
    for snippet in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        exec(snippet, names)
    printed = capsys.readouterr().out
    for said in (
        "times what noise and the integrator alone make",
        "Missing: coulomb_friction at joint/hinge",
        "coulomb_friction at joint/hinge torque 0.0",  # the estimates, one by one
        "coulomb_friction at joint/hinge:\ntorque = 0.0",
        "+ coulomb_friction at joint/hinge (torque 0.0",
        "Under the condition warm, with the above: Missing: coulomb_friction",
        "['coulomb_friction at joint/hinge']",
        "and coulomb_friction at joint/hinge: cosine",
        "report.html",
    ):
        assert said in printed
    assert names["world"].params.effects[0].kind == "coulomb_friction"
    assert Path("repaired.toml").exists() and Path("excitation.csv").exists()


def test_the_page_on_own_effects_shows_the_example():
    page = (REPOSITORY / "docs" / "own_effects.md").read_text(encoding="utf-8")
    (shown,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    assert shown == (REPOSITORY / "examples" / "my_effects.py").read_text(encoding="utf-8")
    (group,) = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    assert list(tomllib.loads(group)["project"]["entry-points"]) == [ENTRY_POINTS]


def test_the_diagnosis_pages_card_and_map_are_read(tmp_path):
    page = (REPOSITORY / "docs" / "diagnosis.md").read_text(encoding="utf-8")
    card, text = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    (tmp_path / "card.toml").write_text(card)
    (tmp_path / "arm.xml").write_text(models.ARM)
    model = load_model(tmp_path / "card.toml")
    assert model.compile(engine="mujoco").host.model.body("forearm").mass[0] == 2.0
    assert [effect.kind for effect in model.effects] == ["motor_curve"]
    (tmp_path / "map.toml").write_text(text)
    assert read_map(tmp_path / "map.toml").columns["qpos.elbow"].unit == "deg"
