"""``coview-stream demo`` end to end in a small world."""

import json
import shutil

import pytest
from sockets import free_endpoint

from coview_stream.cli import main
from coview_stream.clouds import read_tum
from coview_stream.localization.search.global_search import GlobalSearch

SMALL = ["--scene", "campus", "--sensor", "os64", "--size", "100", "--length", "10"]


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    """(exit code, directory) of one demo."""
    out = tmp_path_factory.mktemp("demo") / "out"
    return main(["demo", "--offline", "--out", str(out), *SMALL]), out


@pytest.mark.slow
def test_live_demo_runs_node_robot_and_watcher(tmp_path):
    out = tmp_path / "out"
    address = free_endpoint().removeprefix("tcp/")
    assert main(["demo", "--out", str(out), "--web", address, *SMALL]) == 0
    assert f"page at http://{address}/" in (out / "logs" / "serve.log").read_text()
    report = json.loads((out / "report.json").read_text())
    assert report["success"] is True
    assert report["false_frames"] == 0
    assert report["posed"] > 10
    for name in ("map.png", "trajectory.png", "errors.png"):
        assert (out / name).read_bytes().startswith(b"\x89PNG"), name
    result = json.loads((out / "result.json").read_text())
    assert result["posed"] == report["posed"]
    assert result["keyframes"][-1]["score"] > 0.2
    assert {log.name for log in (out / "logs").iterdir()} == {"serve.log", "replay.log", "watch.log"}


@pytest.mark.slow
def test_demo_localizes_and_writes_the_promised_files(demo):
    code, out = demo
    report = json.loads((out / "report.json").read_text())
    assert code == 0
    assert report["success"] is True
    assert report["false_frames"] == 0
    assert report["translation"]["mean"] < 0.3
    assert report["world"]["scene"] == "campus"
    assert set(report["seconds"]) == {"simulate", "build", "locate", "report"}
    for name in ("map.png", "trajectory.png", "errors.png", "descriptors.png"):
        assert (out / name).read_bytes().startswith(b"\x89PNG"), name
    assert len(read_tum(out / "trajectory.tum")[0]) == report["posed"]
    assert json.loads((out / "result.json").read_text())["state"] == "TRACKING"


@pytest.mark.slow
def test_demo_without_fix_exits_with_one_and_removes_old_result(demo, tmp_path, capsys, monkeypatch):
    out = tmp_path / "again"
    shutil.copytree(demo[1], out)
    monkeypatch.setattr(GlobalSearch, "_register", lambda *given: None)  # no place registers
    assert main(["demo", "--offline", "--out", str(out), *SMALL, "--length", "1"]) == 1
    captured = capsys.readouterr()
    assert "never" in captured.out
    assert "reason" in captured.out
    assert captured.err.count("[4/4]") == 2
    assert "\r" not in captured.err  # no progress bars without a terminal
    assert (out / "trajectory.tum").read_text() == ""
    assert not (out / "descriptors.png").exists()
    assert json.loads((out / "report.json").read_text())["success"] is False


@pytest.mark.parametrize("option", ["--scene moon", "--sensor sonar", "--size 3", "--length nan", "--seed x"])
def test_bad_demo_options_are_one_line_and_leave_no_files(option, tmp_path, refused):
    refused("demo", "--out", tmp_path / "out", *option.split())
    assert not (tmp_path / "out").exists()


def test_demo_does_not_overwrite_foreign_files(tmp_path, refused):
    mine = tmp_path / "report.json"
    mine.write_text("mine")
    refused("demo", "--out", tmp_path)
    refused("demo", "--out", mine)
    assert mine.read_text() == "mine"
