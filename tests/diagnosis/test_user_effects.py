"""A user's own effect takes part in everything; a bad file is one clear line."""

import dataclasses
import importlib.metadata
from pathlib import Path

import numpy as np
import pytest

from garat_jax import cli
from garat_jax.diagnosis import load_model
from garat_jax.diagnosis.add import add
from garat_jax.diagnosis.diagnose import make_candidates
from garat_jax.diagnosis.own_effects import asked, check_identity
from garat_jax.diagnosis.suggest import suggest
from garat_jax.diagnosis.view import repaired
from garat_jax.dynamics import Override, compile
from garat_jax.effects import CATALOGUE, ViscousDamping, check_together
from garat_jax.effects.catalogue import load_catalogue
from garat_jax.errors import UserError
from tests import models
from tests.diagnosis import pendulum
from tests.diagnosis.test_diagnosis_report import FRICTION

MINE = '''
"""Effects of my own."""
import jax
from flax import struct
from garat_jax.effects import Effect, parameter


@struct.dataclass
class Spring(Effect):
    """A spring that pulls back."""

    kind = "my_spring"
    elements = ("joint",)
    law = "tau = -k q"
    identified_by = "rest poses"

    stiffness: jax.Array = parameter(
        0.0, unit="N m/rad", low=0.0, high=10.0, scale=0.1, source="my bench"
    )

    def fields(self, model):
        index = model.host.joint(self.name).id
        return {"jnt_stiffness": model["jnt_stiffness"].at[index].add(self.stiffness)}
'''


@pytest.fixture
def mine(tmp_path):
    path = tmp_path / "my_effects.py"
    path.write_text(MINE)
    (tmp_path / "pendulum.xml").write_text(models.PENDULUM)
    return path


def compile_with_spring(mine: Path, **sizes: float) -> None:
    model = load_model(mine.parent / "pendulum.xml", load_catalogue([mine]))
    effect = model.catalogue["my_spring"](target="joint/hinge", **sizes)
    model.compile(engine="mujoco", extra_effects=[effect])


def test_it_is_a_candidate_at_every_joint(mine):
    model = load_model(mine.parent / "pendulum.xml", load_catalogue([mine]))
    named = [(e.kind, e.target) for e in make_candidates(model)]
    assert ("my_spring", "joint/hinge") in named
    found = dataclasses.replace(FRICTION, effect="my_spring", parameters={})
    assert repaired(model, (found,)).effects[0].kind == "my_spring"


def test_it_is_added_listed_and_read_back(mine, capsys):
    options = ["--effects", str(mine)]
    out = mine.parent / "new.toml"
    model = str(mine.parent / "pendulum.xml")
    adding = ["add", model, "my_spring", "--at", "joint/hinge", "--set", "stiffness=2"]
    assert cli.main([*adding, "--out", str(out), *options]) == 0
    assert load_model(out, load_catalogue([mine])).effects[0].stiffness == 2.0
    assert cli.main(["effects", *options]) == 0
    assert "my_spring" in capsys.readouterr().out
    assert cli.main(["effects", "my_spring", *options]) == 0
    assert "my bench" in capsys.readouterr().out
    assert cli.main(["export", str(out), "--out", str(out.with_suffix(".xml"))]) == 2
    assert "unknown effect 'my_spring'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ("self.stifness", "my_effects.py line 23): AttributeError: 'Spring' object has no"),
        (
            "self.stiffness * jax.numpy.ones(7)",
            "my_effects.py line 23): ValueError: Cannot",
        ),
    ],
)
def test_a_mistake_in_a_law_is_one_line_that_says_where(mine, wrong, said):
    mine.write_text(MINE.replace("self.stiffness)", f"{wrong})"))
    model = load_model(mine.parent / "pendulum.xml", load_catalogue([mine]))
    with pytest.raises(UserError) as caught:
        add(model, "my_spring", "joint/hinge", {"stiffness": 1.0})
    assert str(caught.value).startswith("effect my_spring (") and said in str(caught.value)
    assert "\n" not in str(caught.value)


LAW = (
    MINE
    + """
    acts = tunes = senses = reads_state = True

    def init(self, host):
        return jax.numpy.zeros(2)

    def tune(self, model, state, ctrl):
        return {}

    def apply(self, model, state, ctrl, memory):
        return RETURNED

    def sense(self, host, state, memory):
        return state._replace(qpos=state.qpos + SENSED)
"""
)


@pytest.mark.parametrize(
    ("returned", "sensed", "said"),
    [
        ("ctrl, None, memory", "0", ""),
        ("ctrl", "0", "line 33): apply returns something else than (command, force or"),
        ("ctrl[:0], None, memory", "0", "line 33): apply returns the command of shape (0,); "),
        ("ctrl, ctrl[:0], memory", "0", "apply returns the force of shape (0,); expected (1,)"),
        ("ctrl, 0.0, memory", "0", "apply returns float for the force; expected an array of"),
        ("[ctrl[0]], None, memory", "0", "returns list for the command; expected an array of"),
        ("ctrl, None, memory[:1]", "0", "apply returns the memory float32(1,) "),
        ("ctrl, None, memory.astype(int)", "0", "apply returns the memory int32(2,) "),
        ("ctrl, None, ()", "0", "expected float32(2,) (PyTreeDef(*)), as of init"),
        ("ctrl * (1 + memory[0]), None, memory + 1", "0", "apply makes"),
        ("0.5 * ctrl, None, memory", "0", "at stiffness = 0, which means no effect, apply makes"),
        ("ctrl, state.qvel, memory", "0", "of 0 in the force; there a law may change nothing"),
        ("ctrl + jax.numpy.log(self.stiffness), None, memory", "0", "apply makes -inf of"),
        (
            "ctrl, None, memory",
            "jax.numpy.ones(2)",
            "sense returns qpos of shape (2,); expected (1,)",
        ),
        ("ctrl, None, memory", "0.1", "line 36): at stiffness = 0, which means no effect, sense"),
    ],
)
def test_what_a_law_returns_is_checked(mine, returned, sensed, said):
    mine.write_text(LAW.replace("RETURNED", returned).replace("SENSED", sensed))
    if not said:
        compile_with_spring(mine, stiffness=1.0)
        return
    with pytest.raises(UserError) as caught:
        compile_with_spring(mine, stiffness=1.0)
    assert str(caught.value).startswith(f"effect my_spring ({mine} line ")
    assert said in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (
            '"jnt_stiffness":',
            '"jnt_stifness":',
            "'jnt_stifness', which is no field of MuJoCo's model; did",
        ),
        ('"jnt_stiffness":', '"opt.grvity":', "did you mean opt.gravity or "),
        ('"jnt_stiffness":', '"nq":', "returns 'nq', which is no field"),
        (
            '"jnt_stiffness":',
            "3:",
            "returns 3, which is no field of MuJoCo's model; mujoco.MjModel has those that are",
        ),
        ("return {", "{", "fields returns something else than a dict of fields"),
        ('model["jnt_stiffness"]', "jax.numpy.zeros(3)", "of shape (3,); expected (1,)"),
        ("add(self.stiffness)", "add(1 + self.stiffness)", "fields makes 1 of 0 in jnt_stiffness"),
    ],
)
def test_what_fields_returns_is_checked(mine, old, new, said):
    assert old in MINE
    mine.write_text(MINE.replace(old, new))
    with pytest.raises(UserError) as caught:
        compile_with_spring(mine)
    assert f"({mine} line 21): " in str(caught.value) and said in str(caught.value)


@pytest.mark.parametrize(
    ("method", "body", "said"),
    [
        ("starts(cls, host, target)", "return ()", "line 25): starts lists no size"),
        ("starts(cls, host, target)", "return ({'stifness': 1.0},)", "did you mean stiffness"),
        ("starts(cls, host, target)", "return ({'stiffness': '1'},)", "stiffness = '1', not a"),
        ("starts(cls, host, target)", "return ({},)", "starts lists a size without parameters"),
        ("beside(cls, start, given)", "return start.stifness", "line 27): AttributeError"),
        ("opposite(cls, start)", "return {'stiffness': -1.0}", "opposite has stiffness = -1.0"),
        ("starts(cls, host, target)", "return 1 / 0", "line 27): ZeroDivisionError"),
        ("at(cls, host, target)", "return {'stifness': 0.0}", "unexpected keyword argument"),
        ("fits(cls, host, element, name)", "return host.name", "line 27): AttributeError"),
    ],
)
def test_what_tells_places_and_sizes_is_checked_before_a_diagnosis(mine, method, body, said):
    mine.write_text(f"{MINE}\n    @classmethod\n    def {method}:\n        {body}\n")
    model = load_model(mine.parent / "pendulum.xml", load_catalogue([mine]))
    with pytest.raises(UserError) as caught:
        make_candidates(model)
    (line,) = str(caught.value).splitlines()
    assert line.startswith(f"effect my_spring ({mine}")
    assert said in line


def test_an_opposite_has_the_parameters_of_what_it_is_the_opposite_of(mine):
    rest = "parameter(0.0, unit='rad', low=-3.0, high=3.0, scale=0.1, source='my bench')"
    more = f"    rest: jax.Array = {rest}\n"
    opposite = "    @classmethod\n    def opposite(cls, start):\n        return {'rest': 0.1}\n"
    mine.write_text(f"{MINE}\n{more}\n{opposite}")
    model = load_model(mine.parent / "pendulum.xml", load_catalogue([mine]))
    with pytest.raises(UserError, match=r"has other parameters: \{'rest': 0.1\}"):
        make_candidates(model)


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ("return [0.5]", "line 25): suggested returns something else than a Suggestion or None"),
        ("return Suggestion(({'stifness': 1.0},), 1)", "did you mean stiffness"),
        ("return Suggestion(({'stiffness': None},), 1)", "suggested has stiffness = None, not a"),
        ("return Suggestion(({'stiffness': -1},), 1)", "stiffness = -1, not a number from 0 to"),
        ("return Suggestion((0.5,), 1)", "suggested lists something else than parameters by name"),
        ("return Suggestion(({},), 1)", "suggested lists a size without parameters"),
        ("return Suggestion((), None)", "suggested has num_tried = None; expected how many"),
        ("return Suggestion((), -1)", "suggested has num_tried = -1; expected how many"),
        ("return torque / 'N m'", "line 27): "),
    ],
)
def test_what_a_law_suggests_is_checked(mine, body, said):
    head = "@classmethod\n    def suggested(cls, position, torque, rests):"
    text = MINE.replace("import Effect", "import Effect, Suggestion")
    mine.write_text(f"{text}\n    {head}\n        {body}\n")
    (cls,) = (c for c in load_catalogue([mine]).values() if c.kind == "my_spring")
    with pytest.raises(UserError) as caught:
        asked(cls(target="joint/hinge"), "suggested", np.zeros(5), np.zeros(5), np.zeros((2, 5)))
    (line,) = str(caught.value).splitlines()
    assert line.startswith(f"effect my_spring ({mine}")
    assert said in line


@pytest.mark.parametrize("head", ["@classmethod\n    ", ""])
def test_a_law_may_have_nothing_to_suggest(mine, head):
    text = MINE.replace("import Effect", "import Effect, Suggestion")
    method = "def suggested(cls, position, torque, rests):\n        return Suggestion((), 0)\n"
    mine.write_text(f"{text}\n    {head}{method}")
    spring = load_catalogue([mine])["my_spring"](target="joint/hinge")
    spec = models.spec(models.PENDULUM)
    (found,) = suggest([spring], spec.compile(), [pendulum.record(lambda spec: None, 0)]).values()
    assert found.starts == ()


def test_what_excludes_an_effect_is_excluded_by_it(mine):
    rule = "return other.kind == 'viscous_damping' and other.target == self.target"
    mine.write_text(f"{MINE}\n    def excludes(self, other):\n        {rule}\n")
    model = load_model(mine.parent / "pendulum.xml", load_catalogue([mine]))
    spring = model.catalogue["my_spring"](target="joint/hinge", stiffness=1.0)
    beside = make_candidates(dataclasses.replace(model, effects=(spring,)))
    places = [(e.kind, e.target) for e in beside]
    assert ("viscous_damping", "joint/hinge") not in places
    assert ("my_spring", "joint/hinge") not in places
    assert ("coulomb_friction", "joint/hinge") in places
    both = [spring, ViscousDamping("joint/hinge")]
    for effects in (both, both[::-1]):
        with pytest.raises(UserError, match="exclude each other; write one of them"):
            check_together(effects)
    mine.write_text(f"{MINE}\n    def excludes(self, other):\n        return other.stiffness > 0\n")
    model = load_model(mine.parent / "pendulum.xml", load_catalogue([mine]))
    with pytest.raises(UserError, match=r"line 26\): AttributeError"):
        make_candidates(model)
    card = mine.parent / "card.toml"
    spring = 'kind = "my_spring"\ntarget = "joint/hinge"\nparameters = { stiffness = 1.0 }\n'
    card.write_text(f'format = "garat-model/1"\nmjcf = "pendulum.xml"\n[[effect]]\n{spring}')
    with pytest.raises(UserError, match=r"line 26\): AttributeError"):
        load_model(card, load_catalogue([mine]))


@pytest.mark.parametrize("kind", CATALOGUE)
def test_the_catalogue_passes_for_a_users_own(kind):
    spec = models.spec(models.SLIDER if kind.startswith("contact") else models.ARM)
    targets = CATALOGUE[kind].targets(spec.copy().compile())
    assert targets
    for target in targets[:2]:
        effect = CATALOGUE[kind](target=target)
        check_identity(compile(spec, (), (effect,), "mujoco").host, CATALOGUE[kind], target)


def test_a_law_is_tried_in_the_model_with_its_overrides(mine):
    """It may need what the card overrides, whatever kind of value that has."""
    needs = "    def check(self, host):\n        if not host.dof_armature.all():\n"
    needs += '            raise UserError("needs an armature")\n\n    def fields'
    law = MINE.replace("    def fields", needs).replace(
        "import jax\n", "import jax\nfrom garat_jax.errors import UserError\n"
    )
    mine.write_text(law)
    model = load_model(mine.parent / "pendulum.xml", load_catalogue([mine]))
    overrides = (
        Override("joint", "hinge", "armature", 0.01),
        Override("body", "pole", "pos", [0, 0, 2]),
    )
    there = dataclasses.replace(model, overrides=overrides)
    effect = model.catalogue["my_spring"](target="joint/hinge")
    assert there.compile(engine="mujoco", extra_effects=[effect]).effects[0].kind == "my_spring"
    with pytest.raises(UserError, match="needs an armature"):
        model.compile(engine="mujoco", extra_effects=[effect])


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("0.0, unit", "0.0 unit", "line 18: SyntaxError"),
        ("import jax\n", "import jaxx\n", "line 3: ModuleNotFoundError: No module named 'jaxx'"),
        ('kind = "my_spring"', 'kind = "viscous_damping"', "already; give it another name"),
        ('kind = "my_spring"', "", "Spring lacks kind"),
        ('    law = "tau = -k q"\n', "", "Spring lacks law"),
        ('("joint",)', '("joints",)', "elements is ('joints',); expected a tuple of body, joint"),
        ('("joint",)', '"joint"', "expected a tuple of body, joint"),
        ("@struct.dataclass\n", "", "needs the decorator flax.struct.dataclass"),
        ("class Spring(Effect)", "class Spring", "holds no effect"),
        ("import jax\n", "import sys; sys.exit(7)\n", "line 3: SystemExit: 7"),
        ("high=10.0", "high=-10.0", "stiffness of Spring goes from 0 to -10; expected low below"),
        (
            "def fields(self, model)",
            "def apply(self, *_)",
            "Spring has apply, which is not called; write acts = True",
        ),
        ("low=0.0", "low=0.1", "stiffness of Spring means no effect at 0, outside its bounds 0.1"),
    ],
)
def test_a_bad_file_is_one_line(mine, capsys, old, new, said):
    assert old in MINE
    mine.write_text(MINE.replace(old, new, 1))
    assert cli.main(["effects", "--effects", str(mine)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line
    assert str(mine) in line


def test_a_relative_path_has_its_line_too(mine, monkeypatch):
    mine.write_text(MINE.replace("import jax\n", "import jaxx\n", 1))
    monkeypatch.chdir(mine.parent)
    with pytest.raises(UserError, match=rf"^{mine.name} line 3: ModuleNotFoundError"):
        load_catalogue([mine.name])


def test_other_files_are_refused(tmp_path):
    with pytest.raises(UserError, match="there is no file"):
        load_catalogue([tmp_path / "absent.py"])
    other = tmp_path / "effects.txt"
    other.touch()
    with pytest.raises(UserError, match=r"expected a Python file \(.py\)"):
        load_catalogue([other])


def test_a_list_of_kinds_is_no_catalogue(mine):
    with pytest.raises(UserError, match=r"catalogue is \['my_spring'\]; expected effects by kind"):
        load_model(mine.parent / "pendulum.xml", ["my_spring"])  # pyright: ignore


def test_entry_points_are_loaded_and_a_bad_one_is_named(mine, monkeypatch):
    (cls,) = (c for k, c in load_catalogue([mine]).items() if k == "my_spring")
    group = "garat_jax.effects"
    module = cls.__module__
    points = [importlib.metadata.EntryPoint("spring", f"{module}:Spring", group)]
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda group: points)
    assert load_catalogue()["my_spring"] is cls
    assert load_model(mine.parent / "pendulum.xml").catalogue["my_spring"] is cls
    points[:] = [importlib.metadata.EntryPoint("spring", f"{module}:Absent", group)]
    with pytest.raises(UserError, match=r"entry point spring .*AttributeError"):
        load_catalogue()
