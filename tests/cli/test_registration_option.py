"""``--registration`` of ``locate`` and ``serve``: it reaches those who register, in processes of their own too."""

from __future__ import annotations

import sys

import pytest

from coview_stream.cli import main, serve


def test_locate_registration_option_names_missing_library(world_file, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "small_gicp", None)
    run, out = tmp_path / "not-even-looked-for", tmp_path / "out"
    assert main(["locate", str(world_file), str(run), "-o", str(out), "--registration", "gicp"]) == 2
    said = capsys.readouterr().err
    assert "pip install 'coview-stream[gicp]'" in said
    assert said.count("\n") == 1


@pytest.mark.parametrize(("given", "wanted"), [([], "trimmed-icp"), (["--registration", "gicp"], "gicp")])
def test_serve_passes_registration_option_to_engines(world_file, monkeypatch, given, wanted):
    asked = []
    monkeypatch.setattr(serve, "_serve", lambda options, *_: asked.append(options) or True)
    assert main(["serve", str(world_file), "--robot", "r1", *given]) == 0
    assert [options.localizer.registration.method for options in asked] == [wanted]
