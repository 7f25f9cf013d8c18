"""Progress is told where nobody watches a terminal, too."""

from types import SimpleNamespace

from garat_jax.diagnosis.progress import progress


def test_a_log_gets_a_line_each_with_minutes_and_seconds(capsys, monkeypatch):
    clock = iter([100.0, 100.2, 161.5])
    time = SimpleNamespace(monotonic=lambda: next(clock))
    monkeypatch.setattr("garat_jax.diagnosis.progress.time", time)
    with progress("reading") as say:
        say("fitting [1, 2]")
    assert capsys.readouterr().err == "  0:00 reading\n  1:01 fitting [1, 2]\n"


def test_a_terminal_gets_one_line_that_changes(capsys, monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")
    with progress("reading") as say:
        say("fitting [1, 2]")
    shown = capsys.readouterr().err
    assert "fitting [1, 2]" in shown
    assert "0:00:00" in shown
    assert "reading\n" not in shown
