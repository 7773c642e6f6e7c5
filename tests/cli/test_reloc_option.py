"""``--reloc`` of ``locate`` and ``serve``, and ``build --learned``, which it needs."""

from __future__ import annotations

import sys

import pytest

from coview_stream.basemap.basemap import BaseMap
from coview_stream.basemap.file_format import load, save
from coview_stream.cli import main
from coview_stream.config import LocalizerConfig
from coview_stream.descriptors.network import network
from coview_stream.localization.localizer import Localizer
from coview_stream.localization.search.acceptance import BY_FEATURES
from coview_stream.stream.node.engine_process import EngineProcess
from coview_stream.stream.node.engine_queue import SearchJob


def test_locate_reloc_learned_on_map_without_features_names_remedy(world_file, tmp_path, capsys):
    run, out = tmp_path / "not-even-looked-for", tmp_path / "out"
    assert main(["locate", str(world_file), str(run), "-o", str(out), "--reloc", "learned"]) == 2
    said = capsys.readouterr().err
    assert "build it again" in said
    assert "--reloc coview" in said
    assert said.count("\n") == 1


def test_serve_reloc_learned_on_map_without_features_fails_before_opening(world_file, capsys):
    given = ["serve", str(world_file), "--robot", "r1", "--reloc", "learned", "--no-state", "--quiet"]
    assert main(given) == 2
    assert "build it again" in capsys.readouterr().err


@pytest.mark.slow
def test_search_engine_process_uses_learned_features(learned_file, world_drive):
    base_map = BaseMap.load(learned_file)
    localizer = Localizer(base_map, LocalizerConfig(reloc="learned"))
    query = localizer.add_frame(world_drive.clouds[0], world_drive.T_odom_body[0], 0.0)
    process = EngineProcess("search", str(learned_file), base_map.sha256, LocalizerConfig(reloc="learned"))
    try:
        process.start()
        process.wait_ready()
        assert process.run(SearchJob("r1", query)).evidence.reason.endswith(BY_FEATURES)
    finally:
        process.close()


def test_build_learned_names_missing_library(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    network.cache_clear()
    scan = tmp_path / "not-even-looked-for.ply"
    assert main(["build", str(scan), "-o", str(tmp_path / "site.coview"), "--learned"]) == 2
    said = capsys.readouterr().err
    assert "pip install 'coview-stream[node]'" in said
    assert said.count("\n") == 1


@pytest.fixture(scope="module")
def learned_file(map_cloud_file, tmp_path_factory):
    path = tmp_path_factory.mktemp("learned") / "site.coview"
    given = ["build", str(map_cloud_file), "-o", str(path), "--radius", "20", "--block-size", "4"]
    assert main([*given, "--learned"]) == 0
    return path


@pytest.mark.slow
def test_build_learned_stores_features_and_info_shows_them(learned_file, capsys):
    assert BaseMap.load(learned_file).learned is not None
    assert main(["info", str(learned_file)]) == 0
    assert "features of" in capsys.readouterr().out


def test_features_of_other_weights_are_refused_or_skipped(learned_file, tmp_path, capsys):
    arrays, parameters, _ = load(learned_file)
    parameters["learned"]["weights"] = "0" * 64
    save(tmp_path / "old.coview", arrays, parameters)
    given = ["locate", str(tmp_path / "old.coview"), "run", "-o", str(tmp_path / "out"), "--reloc"]
    assert main([*given, "learned"]) == 2
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1
    assert "build it again" in said[0]
    assert main([*given, "auto"]) == 2  # there is no such run
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 2
    assert "going without learned features" in said[0]
    assert "build it again" in said[0]
    assert "error: run" in said[1]
    assert main([*given, "coview"]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
