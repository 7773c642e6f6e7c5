"""Measured tables go to their places in a page, and nowhere else."""

import json
from pathlib import Path

import pytest
from bench.harness.publish import PAGE, filled, main, suite_tables

from bench.harness import publish
from bench.harness.rows import against, bounded

PLACED = "before\n<!-- table: bench match -->\nold\n<!-- end -->\nafter\n<!-- table: machine -->\nwas\n<!-- end -->\n"
ROWS = [against("match/top 10, 1 thread", 2.0, 8.0, "ms", 3), bounded("start/import", 0.1, "s", 0.25)]


def test_only_what_was_measured_changes():
    page = filled(PLACED, {"bench match": "new"})
    assert page == PLACED.replace("old", "new")


def test_a_table_without_a_place_is_an_error():
    with pytest.raises(ValueError, match="no place for bench start"):
        filled(PLACED, suite_tables(ROWS))


def test_rows_are_shown_under_their_benchmark():
    tables = suite_tables(ROWS)
    assert list(tables) == ["bench match", "bench start"]
    head, _, row = tables["bench match"].splitlines()
    assert head.split("|")[1].strip() == "benchmark"
    assert [cell.strip() for cell in row.split("|")[1:-1]] == [
        "top 10, 1 thread", "2", "8", "ms", "4", ">= 3", "holds",
    ]  # fmt: skip


def test_peers_that_failed_say_why():
    trial = {
        "peer": "A",
        "scene": "town",
        "asked": 2,
        "prepare_s": None,
        "answers": [],
        "trouble": "not installed",
    }
    shown = publish.peers_table([trial])
    assert "0 of 2" in shown
    assert shown.endswith("A, town: not installed")


def test_the_command_fills_a_page(tmp_path, capsys):
    page, rows = tmp_path / "page.md", tmp_path / "rows.json"
    page.write_text(PLACED)
    rows.write_text(json.dumps([ROWS[0].to_dict()]))
    assert main([str(rows), "--page", str(page)]) == 0
    text = page.read_text()
    assert "top 10, 1 thread" in text
    assert "numpy" in text
    assert main([str(tmp_path / "missing.json"), "--page", str(page)]) == 2
    assert "missing.json" in capsys.readouterr().err
    assert page.read_text() == text


def test_the_page_has_a_place_for_every_benchmark_of_the_suite():
    from bench.harness.suite import SUITE

    page = (Path(__file__).parents[2] / PAGE).read_text()
    filled(page, {f"bench {entry.name}": "" for entry in SUITE} | {"bench.peers": "", "machine": ""})


def test_a_file_of_another_kind_is_named(tmp_path, capsys):
    page, other = tmp_path / "page.md", tmp_path / "other.json"
    page.write_text(PLACED)
    for text in ("[]", "{}", "no json", '[{"name": "match/x"}]'):
        other.write_text(text)
        for arguments in ([str(other)], ["--peers", str(other)]):
            assert main([*arguments, "--page", str(page)]) == 2
            assert str(other) in capsys.readouterr().err
    with pytest.raises(SystemExit, match="2"):
        main(["--page", str(page)])
    assert page.read_text() == PLACED
