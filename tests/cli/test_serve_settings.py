"""``serve --config node.toml``: every option and setting, the command line before the file, mistakes by name."""

from __future__ import annotations

import argparse

import pytest

from coview_stream.cli import main, serve
from coview_stream.stream.node import serve as node_serve


@pytest.fixture
def opened(monkeypatch, world_file):
    """Options that ``serve`` would open a node with, for the arguments given."""
    found = []

    def refuse(options, *_):
        found.append(options)
        raise node_serve.CancelledError

    monkeypatch.setattr(node_serve, "open_node", refuse)
    monkeypatch.setattr("coview_stream.stream.node.engine_process.start_children", lambda lidar: {})
    monkeypatch.setattr("coview_stream.cli.signals.Stop.wait", lambda self, seconds: bool(found))

    def open_with(*argv):
        assert main(["serve", *argv]) == 0
        return found[-1]

    return open_with


def test_a_file_sets_options_and_tables(opened, world_file, tmp_path):
    path = tmp_path / "node.toml"
    path.write_text(
        f'map = "{world_file}"\nrobot = ["a", "b"]\nlisten = "tcp/127.0.0.1:0"\nno_state = true\npose-rate = 20\n'
        'cloud_key = "lidar/{robot}"\nmount = "180,0,0"\n[node]\nmax_outage = 7\n[localizer]\nreloc = "coview"\n'
        "[localizer.acceptance]\nrisk = 1e-5\n"
    )
    options = opened("--config", str(path))
    assert [keys.cloud for keys in options.keys] == ["lidar/a", "lidar/b"]
    assert (options.node.pose_rate, options.node.max_outage, options.node.mount.option) == (20.0, 7.0, "180,0,0")
    assert (options.localizer.reloc, options.localizer.acceptance.risk) == ("coview", 1e-5)
    assert options.state is None


def test_the_command_line_goes_before_the_file(opened, world_file, tmp_path):
    path = tmp_path / "node.toml"
    path.write_text(
        'robot = "a"\nbase = "there"\nno_state = true\n[node]\npose_rate = 5\n[localizer.acceptance]\nrisk = 0.01\n'
    )
    options = opened(str(world_file), "--config", str(path), "--base", "coview", "--robot", "b", "--pose-rate", "3")
    assert options.keys[0].pose == "coview/b/out/pose"
    assert (options.node.pose_rate, options.localizer.acceptance.risk) == (3.0, 0.01)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('robt = "a"\n', "unknown key 'robt'; did you mean 'robot'?"),
        ('robot = "a"\npose_rate = "fast"\n', "pose_rate is 'fast'"),
        ('robot = "a"\nquiet = 1\n', "quiet is 1; write true or false"),
        ('robot = "a"\nregistration = "icp"\n', "registration is 'icp'; choose one of trimmed-icp, gicp"),
        ('robot = "a"\nnode = 3\n', "node is 3; write a table [node]"),
        ('robot = "a"\n[node]\npose_rte = 3\n', "[node]: unknown key 'pose_rte'; did you mean 'pose_rate'?"),
        ('robot = "a"\n[localizer.keyframe]\ndistance = -1\n', "distance is -1"),
        ("[node]\n", "--robot is missing"),
    ],
)
def test_mistakes_are_named(text, message, world_file, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("coview_stream.stream.node.engine_process.start_children", lambda lidar: {})
    path = tmp_path / "node.toml"
    path.write_text(text)
    assert main(["serve", str(world_file), "--config", str(path), "--no-state"]) == 2
    assert message in capsys.readouterr().err


def test_help_fits_a_screen_and_help_all_has_the_rest(capsys):
    assert main(["serve", "--help"]) == 0
    short = capsys.readouterr().out
    assert len(short.splitlines()) <= 50
    assert main(["serve", "--help-all"]) == 0
    everything = capsys.readouterr().out
    parser = argparse.ArgumentParser()
    serve.add_arguments(parser)
    for action in parser._actions:
        for option in action.option_strings[-1:]:
            assert option in everything
    assert "--cloud-key" not in short
