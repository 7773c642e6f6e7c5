"""``coview-stream info``: the contents of a map, or one line."""

import json

import pytest

from coview_stream.basemap import file_format
from coview_stream.basemap.basemap import BaseMap
from coview_stream.cli import main


@pytest.mark.slow
def test_info_prints_map_facts_and_draws_the_map(world_file, tmp_path, capsys):
    base_map = BaseMap.load(world_file)
    assert main(["info", str(world_file), "--plot", str(tmp_path / "map.png")]) == 0
    out = capsys.readouterr().out
    for fact in (f"{len(base_map)}", f"{len(base_map.points)}", base_map.sha256, "site.ply", "radius = 30.0"):
        assert fact in out
    assert (tmp_path / "map.png").read_bytes().startswith(b"\x89PNG")


def test_info_prints_json(world_file, capsys):
    base_map = BaseMap.load(world_file)
    assert main(["info", str(world_file), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert "ambiguity" not in facts  # it takes long, so it has an option
    assert facts["stations"] == len(base_map)
    assert facts["sha256"] == base_map.sha256
    assert facts["parameters"]["descriptor"]["radius"] == 30.0
    assert facts["from"][0] == pytest.approx(-34.0, abs=0.3)
    assert facts["to"][0] == pytest.approx(34.0, abs=0.5)
    assert facts["sources"].keys() == {"site.ply"}


def test_names_in_a_map_reach_the_terminal_without_control_characters(world_file, tmp_path, capsys, refused):
    arrays, parameters, _ = file_format.load(world_file)
    escape = "\x1b]0;title\x07\x1b[2J"
    named = parameters | {"crs": escape + "EPSG:1", "sources": {f"{escape}a.las": "ab"}, "ground_filter": escape}
    file_format.save(tmp_path / "a.coview", arrays, named)
    assert main(["info", str(tmp_path / "a.coview")]) == 0
    told = capsys.readouterr()
    assert all(line.isprintable() for line in (told.out + told.err).splitlines())
    assert refused("info", tmp_path / f"{escape}.coview").strip().isprintable()


@pytest.mark.parametrize("content", [None, b"", b"nonsense" * 20, "flipped", "half"])
def test_damaged_map_is_one_line(world_file, tmp_path, refused, content):
    path = tmp_path / "site.coview"
    whole = world_file.read_bytes()
    at = len(whole) // 2
    damaged = {"flipped": whole[:at] + bytes([whole[at] ^ 4]) + whole[at + 1 :], "half": whole[:at]}
    if content is not None:
        path.write_bytes(damaged[content] if isinstance(content, str) else content)
    assert "site.coview" in refused("info", path)
