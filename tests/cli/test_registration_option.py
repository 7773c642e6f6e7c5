"""``--registration`` of ``locate`` and ``serve``: it reaches those who register, in processes of their own too."""

from __future__ import annotations

import sys

from coview_stream.cli import main


def test_locate_registration_option_names_missing_library(world_file, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "small_gicp", None)
    run, out = tmp_path / "not-even-looked-for", tmp_path / "out"
    assert main(["locate", str(world_file), str(run), "-o", str(out), "--registration", "gicp"]) == 2
    said = capsys.readouterr().err
    assert "pip install 'coview-stream[gicp]'" in said
    assert said.count("\n") == 1
