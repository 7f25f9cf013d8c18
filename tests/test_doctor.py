"""What `garat doctor` finds, measures and advises."""

import os
import subprocess
import sys

import jax
import pytest

from garat_jax import cli, doctor
from garat_jax.doctor import BATCH, MANY, Rate
from garat_jax.errors import UserError


def rates(mujoco: float, mjx: float) -> list[Rate]:
    return [
        Rate(engine, batch, rate * (1 if batch == 1 else 10))
        for engine, rate in (("mujoco", mujoco), ("mjx", mjx))
        for batch in (1, BATCH)
    ]


def test_it_measures_both_engines_and_names_what_there_is(monkeypatch, capsys, knows_emitters):
    found = []

    def examine(device: str, examine=doctor.examine):
        found.append(examine(device, seconds=0.04))
        return found[0]

    monkeypatch.setattr(doctor, "examine", examine)
    monkeypatch.delenv("XLA_FLAGS", raising=False)  # the tests' own
    assert cli.main(["doctor"]) == 0
    told = capsys.readouterr().out
    for part in ("devices: ", "XLA_FLAGS: ", f"jax {jax.__version__}", "auto takes", "at once"):
        assert part in told
    assert "XLA options around C MuJoCo: xla_backend_optimization_level=1" in told
    emitters = "xla_cpu_use_fusion_emitters=false" if knows_emitters else "none"
    assert f"XLA options for MJX, deep chains: {emitters}" in told
    assert [(rate.engine, rate.batch) for rate in found[0].rates] == [
        ("mujoco", 1), ("mujoco", BATCH), ("mjx", 1), ("mjx", BATCH),
    ]  # fmt: skip
    assert all(rate.steps_per_second > 0 for rate in found[0].rates)


def test_on_an_accelerator_it_measures_thousands_of_simulations_in_mjx(monkeypatch):
    class Accelerator:
        platform, device_kind = "gpu", "a GPU"

    monkeypatch.setattr(doctor, "use", lambda device: [Accelerator()])
    monkeypatch.setattr(doctor, "measure", lambda program, start, batch, seconds: float(batch))
    found = doctor.examine("gpu")
    assert ("mjx", MANY) in [(rate.engine, rate.batch) for rate in found.rates]
    assert ("mujoco", MANY) not in [(rate.engine, rate.batch) for rate in found.rates]
    assert any("4096 at once do 64.0 times" in line for line in found.advice)


def test_it_measures_programs_as_they_are_compiled_elsewhere(monkeypatch):
    taken = []

    def compile(self, options=None, compile=jax.stages.Lowered.compile):
        taken.append(options)
        return compile(self, options)

    monkeypatch.delenv("XLA_FLAGS", raising=False)
    monkeypatch.setattr(jax.stages.Lowered, "compile", compile)
    doctor.examine("auto", seconds=0.04)
    assert taken.count({"xla_backend_optimization_level": 1}) == 2
    assert {} in taken


def test_it_advises_host_devices_for_mjx_where_there_are_cores(monkeypatch):
    monkeypatch.setattr(doctor, "num_cores", lambda: 6)
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    flag = "--xla_force_host_platform_device_count"
    assert any(f"XLA_FLAGS={flag}=6" in x for x in doctor.advise(rates(2.0, 1.0), "cpu"))
    assert not any(flag in line for line in doctor.advise(rates(1.0, 2.0), "gpu"))
    monkeypatch.setenv("XLA_FLAGS", f"{flag}=2")
    assert not any(flag in line for line in doctor.advise(rates(2.0, 1.0), "cpu"))


def test_advice_follows_from_the_rates_and_the_settings(monkeypatch):
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    first, batch, *rest = doctor.advise(rates(2.0, 1.0), "cpu")
    assert "mujoco is 2.0 times" in first
    assert "10 times the steps of one" in batch
    assert not [line for line in rest if line.startswith("XLA_FLAGS")]
    assert "time yours with --engine mjx" in doctor.advise(rates(1.0, 2.0), "cpu")[0]
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_use_fusion_emitters=true")
    monkeypatch.setenv("JAX_ENABLE_COMPILATION_CACHE", "false")
    assert {"XLA_FLAGS", "Compiled"} <= {
        line.split()[0] for line in doctor.advise(rates(1.0, 1.0), "cpu")
    }


def test_on_an_accelerator_it_says_what_thousands_of_simulations_gain():
    told = doctor.advise([*rates(1.0, 2.0), Rate("mjx", MANY, 600.0)], "gpu")
    assert any("4096 at once do 30.0 times the steps of 64" in line for line in told)
    assert not any("4096" in line for line in doctor.advise(rates(1.0, 2.0), "cpu"))


def test_a_device_that_is_not_there_is_one_line_and_status_2(monkeypatch, capsys):
    def no_device():
        raise RuntimeError("Unable to initialize backend 'tpu': no libtpu (set JAX_PLATFORMS='')")

    monkeypatch.setattr(jax, "devices", no_device)
    assert cli.main(["doctor"]) == 2
    complaint = capsys.readouterr().err
    assert complaint.startswith("garat: error: JAX finds no device")
    assert "no libtpu" in complaint
    assert complaint.count("\n") == 1
    with pytest.raises(UserError, match="JAX finds no device"):
        doctor.use("auto")


@pytest.mark.parametrize(
    ("platforms", "complaint"),
    [
        ("gpu,cpu", RuntimeError("Backend 'rocm' is not in the list of known backends: ['cpu']")),
        ("cuda", AssertionError()),
    ],
)
def test_where_no_backend_of_a_gpu_is_installed_the_line_says_what_to_install(
    monkeypatch, capsys, platforms, complaint
):
    def no_backend():
        raise complaint

    monkeypatch.setattr(jax, "devices", no_backend)
    monkeypatch.setattr(jax.config, "update", lambda name, value: None)
    monkeypatch.setattr(type(jax.config), "jax_platforms", platforms, raising=False)
    assert cli.main(["doctor", "--device", "gpu"]) == 2
    line = capsys.readouterr().err
    assert "garat_jax[cuda]" in line
    assert "rocm" not in line


@pytest.mark.parametrize("platform", ["cuda", "tpu"])
def test_a_device_that_only_shows_later_is_one_line_too(platform):
    program = (
        "import jax, sys; from garat_jax import cli\n"
        "cli.List.run = lambda self: jax.devices()\n"
        "sys.exit(cli.main(['list']))"
    )
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", program],
        env=os.environ | {"JAX_PLATFORMS": platform},
        capture_output=True,
        text=True,
    )
    if done.returncode == 0:
        pytest.skip(f"this machine has the device {platform!r}")
    assert done.returncode == 2, done.stderr
    assert done.stderr.startswith("garat: error: JAX finds no device")
    assert done.stderr.count("\n") == 1


def test_an_error_that_is_not_of_devices_stays_one(monkeypatch):
    def fail(self):
        raise AssertionError

    monkeypatch.setattr(cli.List, "run", fail)
    with pytest.raises(AssertionError):
        cli.main(["list"])
