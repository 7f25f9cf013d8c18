"""XLA's options for programs that step a model on a CPU."""

import jax
import mujoco
import pytest

from garat_jax import compiler_options, dynamics

JOINT = "<body pos='0 0 .1'><joint axis='0 1 0'/><geom size='.02' mass='.1'/>"


def make_chain(depth: int, engine: str = "mjx"):
    bodies = JOINT * depth + "</body>" * depth
    spec = mujoco.MjSpec.from_string(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    return dynamics.compile(spec, engine=engine)


@pytest.fixture
def without_emitters(knows_emitters) -> dict[str, bool]:
    """The option that switches fusion emitters off, where there is one."""
    return {compiler_options.FUSION_EMITTERS: False} if knows_emitters else {}


@pytest.fixture(autouse=True)
def no_flags(monkeypatch):
    monkeypatch.delenv("XLA_FLAGS", raising=False)


def test_only_deep_chains_in_mjx_are_compiled_without_fusion_emitters(
    monkeypatch, without_emitters
):
    assert compiler_options.compiler_options(make_chain(6)) == without_emitters
    assert compiler_options.compiler_options(make_chain(2)) == {}
    less_optimised = {compiler_options.OPTIMISATION_LEVEL: 1}
    assert compiler_options.compiler_options(make_chain(6, engine="mujoco")) == less_optimised
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert compiler_options.compiler_options(make_chain(6)) == {}


def test_programs_of_a_diagnosis_are_optimised_only_if_they_run_often(
    monkeypatch, without_emitters
):
    level, emitters = compiler_options.OPTIMISATION_LEVEL, compiler_options.FUSION_EMITTERS
    for runs_often in (False, True):
        options = compiler_options.options_of_replay("mujoco", runs_often)
        assert options == {level: int(runs_often), **without_emitters}
    assert compiler_options.options_of_replay("mjx", runs_often=True) == {}
    monkeypatch.setenv("XLA_FLAGS", f"--{emitters}=true")
    assert compiler_options.options_of_replay("mujoco", runs_often=False) == {level: 0}
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert compiler_options.options_of_replay("mujoco", runs_often=True) == {}


def test_the_users_own_flag_is_left_alone(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", f"--{compiler_options.FUSION_EMITTERS}=true")
    assert compiler_options.compiler_options(make_chain(6)) == {}
    monkeypatch.setenv("XLA_FLAGS", f"--{compiler_options.OPTIMISATION_LEVEL}=3")
    assert compiler_options.compiler_options(make_chain(6, engine="mujoco")) == {}


def test_chain_depth_counts_dofs_of_the_longest_branch():
    forked = JOINT + "</body>" + JOINT * 3 + "</body>" * 3
    spec = mujoco.MjSpec.from_string(f"<mujoco><worldbody>{forked}</worldbody></mujoco>")
    assert compiler_options.chain_depth(dynamics.compile(spec, engine="mujoco")) == 3


def test_an_option_that_xla_does_not_know_is_not_used(monkeypatch, knows_emitters):
    assert compiler_options.is_known_option(compiler_options.OPTIMISATION_LEVEL, 1)
    assert compiler_options.is_known_option(compiler_options.FUSION_EMITTERS) == knows_emitters
    assert not compiler_options.is_known_option("xla_cpu_option_that_is_gone")
    monkeypatch.setattr(compiler_options, "FUSION_EMITTERS", "xla_cpu_option_that_is_gone")
    assert compiler_options.compiler_options(make_chain(6)) == {}
