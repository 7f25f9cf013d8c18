"""Where compiled programs are kept, and what the user says about it."""

import os

import pytest

from garat_jax import compilation_cache

VARIABLES = ("JAX_COMPILATION_CACHE_DIR", "JAX_ENABLE_COMPILATION_CACHE", "XDG_CACHE_HOME")


@pytest.fixture(autouse=True)
def own_environment(monkeypatch, tmp_path):
    for name in (*VARIABLES, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))


@pytest.mark.parametrize("variable", ["HOME", "XDG_CACHE_HOME"])
def test_it_is_on_in_the_users_cache_folder(variable, monkeypatch, tmp_path):
    monkeypatch.setenv(variable, str(tmp_path))
    compilation_cache.enable()
    home = tmp_path / ".cache" if variable == "HOME" else tmp_path
    assert compilation_cache.folder() == home / "garat_jax" / "jax"
    assert compilation_cache.folder().is_dir()
    assert os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] == "0"


@pytest.mark.parametrize("name", ["/somewhere/else", ""])
def test_another_folder_or_none_is_respected(name, monkeypatch, tmp_path):
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", name)
    compilation_cache.enable()
    assert os.environ["JAX_COMPILATION_CACHE_DIR"] == name
    assert os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] == "0"
    assert str(compilation_cache.folder() or "") == name
    assert list(tmp_path.iterdir()) == []


def test_how_long_a_program_compiles_that_is_kept_stays_as_it_was_set(monkeypatch):
    monkeypatch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "5")
    compilation_cache.enable()
    assert os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] == "5"


def test_jax_can_be_told_to_use_none(monkeypatch):
    monkeypatch.setenv("JAX_ENABLE_COMPILATION_CACHE", "false")
    compilation_cache.enable()
    assert compilation_cache.folder() is None


def test_without_a_folder_to_write_to_there_is_none(monkeypatch, tmp_path):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    compilation_cache.enable()
    assert compilation_cache.folder() is None


def test_without_leave_to_write_to_the_folder_there_is_none(monkeypatch, tmp_path):
    """Not even root writes to a folder of the kernel's."""
    (tmp_path / "garat_jax").mkdir()
    (tmp_path / "garat_jax" / "jax").symlink_to("/proc/self", target_is_directory=True)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    compilation_cache.enable()
    assert compilation_cache.folder() is None
