"""``coview-stream info``: the contents of a map; with ``--ambiguity`` a sentence, numbers, a picture."""

import json

import numpy as np
import pytest

from coview_stream.basemap import file_format
from coview_stream.basemap.basemap import BaseMap
from coview_stream.cli import main
from coview_stream.localization.search import ambiguity as module
from coview_stream.report import ambiguity as report
from coview_stream.report.ambiguity import facts, plot_ambiguity, summary


@pytest.fixture(autouse=True)
def few_places(monkeypatch):
    """Few places to look from: the default is for sites."""
    monkeypatch.setattr(module.ambiguity, "__defaults__", (None, 6, 0.3, None))


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


def made_up(base_map, drive, wrong=False):
    count, station = len(drive), np.arange(len(drive))
    zeros, wrongs = np.zeros(count), np.full(count, wrong)
    position = base_map.stations[station].astype(np.float64)
    return module.Ambiguity(station, position, np.array(drive), wrongs, zeros, zeros, zeros, wrongs, 1e-4, 0.3)


@pytest.mark.slow
def test_option_prints_a_sentence_and_draws(world_file, tmp_path, capsys):
    picture = tmp_path / "ambiguity.png"
    assert main(["info", str(world_file), "--ambiguity", "-o", str(picture)]) == 0
    line = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("ambiguity"))
    assert "told apart at once" in line
    assert "risk 0.0001" in line
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_option_prints_numbers_for_each_station(world_file, capsys):
    assert main(["info", str(world_file), "--ambiguity", "--json", "--risk", "1e-3"]) == 0
    found = json.loads(capsys.readouterr().out)["ambiguity"]
    base_map = BaseMap.load(world_file)
    assert found["risk"] == 1e-3
    assert 1 <= len(found["stations"]) <= 6
    for each in found["stations"]:
        np.testing.assert_allclose(each["position"], base_map.stations[each["station"]] + base_map.origin, atol=0.01)
        assert each["drive"] is None or each["drive"] >= 0.0
        assert 0.0 <= each["error"] <= 1.0
    assert found["within"]["40"] + found["never"] == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["-o", "a.png"], "give --ambiguity as well"),
        (["--risk", "1e-4"], "give --ambiguity as well"),
        (["--ambiguity", "--risk", "2"], "[1e-6, 0.5)"),
        (["--ambiguity", "-o", "{}"], "is a directory; name the picture"),
        (["--ambiguity", "-o", "{}/none/a.png"], "make it first"),
        (["--plot", "{}"], "is a directory; name the picture"),
    ],
)
def test_options_that_do_not_go_together_are_one_line_before_anything_is_looked_at(tmp_path, refused, more, said):
    none = str(tmp_path / "not-even-looked-for.coview")
    assert said in refused("info", none, *(each.format(tmp_path) for each in more))
    assert not list(tmp_path.iterdir())


def test_picture_says_what_its_colours_mean(world_map, tmp_path, monkeypatch):
    drawn = {}

    def kept(drawing, axes, title):
        drawn["labels"], drawn["legend"], drawn["title"] = (
            axes.get_legend_handles_labels()[1], title, axes.get_title("left")
        )  # fmt: skip

    monkeypatch.setattr(report, "legend_below", kept)
    plot_ambiguity(made_up(world_map, [0.0, 0.0, 8.0, np.inf]), world_map, tmp_path / "a.png", "site.coview")
    assert drawn["labels"] == ["at once: 50 %", "after 5 to 10 m: 25 %", "not within 40 m: 25 %"]
    assert "found" in drawn["legend"]
    assert drawn["title"].startswith("site.coview: ")


def test_summary_says_how_many_and_where(world_map):
    text = summary(made_up(world_map, [0.0, 0.0, 8.0, np.inf]), world_map)
    for part in ("50 % of 4 places", "25 % after driving up to 8 m", "25 % stay ambiguous", "worst around"):
        assert part in text
    assert "another place" not in text
    assert "worst" not in summary(made_up(world_map, [0.0, 0.0]), world_map)
    assert "at 2 another place" in summary(made_up(world_map, [np.inf, np.inf], wrong=True), world_map)
    assert summary(made_up(world_map, []), world_map) == "no stations"


def test_numbers_and_picture_of_a_map_that_tells_nothing_apart(world_map, tmp_path):
    found = made_up(world_map, [np.inf, np.inf])
    assert [each["drive"] for each in facts(found, world_map)["stations"]] == [None, None]
    json.dumps(facts(found, world_map))
    for number, each in enumerate((found, made_up(world_map, []))):
        plot_ambiguity(each, world_map, tmp_path / f"{number}.png", "site")
        assert (tmp_path / f"{number}.png").read_bytes().startswith(b"\x89PNG")
