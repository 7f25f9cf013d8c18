"""The report: self-contained, escaped, and holding what it was given."""

import json
import re

import numpy as np
import plotly.graph_objects as go
import pytest

from garat_jax import report
from garat_jax.runs import RunDirectory


def write(path, **changes):
    figure = report.styled(go.Figure(go.Scatter(y=np.arange(3.0), name="</script><b>x")))
    section = report.Section(
        "Error <by> signal",
        "First paragraph.\n\n- one\n- two",
        figures=[report.Figure(figure, "What the line shows.")],
        tables=[report.Table(("signal", "error"), [("qpos.a", 0.123456789), ("b", None)])],
    )
    content = {
        "title": "A <b>title</b>",
        "lead": "It works.",
        "sections": [section],
        "reproduce": report.Reproduce("garat compare a.xml b.csv"),
        **changes,
    }
    return report.write(path, **content).read_text(encoding="utf-8")


def markup(page: str) -> str:
    """The page without scripts."""
    return re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL)


def test_page_loads_nothing_from_elsewhere(tmp_path):
    page = markup(write(tmp_path / "report.html"))
    assert not re.findall(r"(?:src|href)\s*=\s*\"(?!#)", page)
    assert "@import" not in page
    assert "url(" not in page


def test_text_is_escaped(tmp_path):
    page = markup(write(tmp_path / "report.html"))
    assert "<h1>A &lt;b&gt;title&lt;/b&gt;</h1>" in page
    assert "Error &lt;by&gt; signal" in page


def test_figure_stays_within_its_script(tmp_path):
    page = write(tmp_path / "report.html")
    (text,) = re.findall(r'class="plot-data">(.*?)</script>', page, flags=re.DOTALL)
    assert json.loads(text)["data"][0]["name"] == "</script><b>x"


def test_numbers_in_tables_are_rounded_and_absent_ones_are_empty(tmp_path):
    page = write(tmp_path / "report.html")
    assert '<td class="number">0.1235</td>' in page
    assert '<td class="number"></td>' in page


def test_a_folded_table_says_what_it_holds(tmp_path):
    table = report.Table(("effect",), [("friction",)], folded="1 <more>")
    section = report.Section("Others", tables=[table])
    page = markup(write(tmp_path / "report.html", sections=[section]))
    (inside,) = re.findall(
        r"<details><summary>1 &lt;more&gt;</summary>(.*)</details>", page, flags=re.DOTALL
    )
    assert "friction" in inside


def test_lists_and_paragraphs(tmp_path):
    page = write(tmp_path / "report.html")
    assert "<p>First paragraph.</p>" in page
    assert "<li>one</li><li>two</li>" in page


def test_facts_and_sections_are_listed(tmp_path):
    sections = [report.Section(f"Part {i}") for i in range(4)]
    facts = [report.Fact("0.98", "scaled return")]
    page = markup(write(tmp_path / "report.html", sections=sections, facts=facts))
    assert "<dt>scaled return</dt><dd>0.98</dd>" in page
    assert [page.index(f'href="#section-{i}"') for i in range(1, 5)]


def test_a_table_with_a_short_row_is_refused(tmp_path):
    bad = report.Section("x", tables=[report.Table(("a", "b"), [(1, 2), (3,)])])
    with pytest.raises(ValueError, match="argument"):
        write(tmp_path / "report.html", sections=[bad])


def test_reproduce_names_command_versions_and_seeds(tmp_path):
    run = RunDirectory.create(tmp_path / "run", {}, "garat demo", [3])
    found = report.Reproduce.from_config(run.read_json("config.json"))
    assert found.command == "garat demo"
    text = " ".join(found.lines)
    assert "jax " in text
    assert "Seed: 3." in text
