"""Progress is told where nobody watches a terminal, too."""

from garat_jax.diagnosis.progress import progress


def test_a_log_gets_a_line_each(capsys):
    with progress("reading") as say:
        say("fitting [1, 2]")
    assert capsys.readouterr().err == "reading\nfitting [1, 2]\n"


def test_a_terminal_gets_one_line_that_changes(capsys, monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")
    with progress("reading") as say:
        say("fitting")
    assert "reading\n" not in capsys.readouterr().err
