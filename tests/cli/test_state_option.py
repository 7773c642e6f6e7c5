"""``serve --state`` and ``--no-state``: where the last poses go, by default and by word."""

import argparse
import sys
import threading

import pytest
from sockets import free_endpoint

from coview_stream.cli import options, serve
from coview_stream.stream.node.serve import NetworkOptions, ServeOptions, open_node
from coview_stream.stream.transport.keys import robot_keys


def folder(*args):
    parser = argparse.ArgumentParser()
    serve.add_arguments(parser)
    return options.state_folder(parser.parse_args(["site.coview", "--robot", "r1", *args]))


def test_state_folder_defaults_to_user_state_directory(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    assert folder("--no-state") is None
    assert not list(tmp_path.iterdir())
    assert folder() == tmp_path / "coview-stream"


def test_state_and_no_state_together_are_refused(capsys):
    with pytest.raises(SystemExit):
        folder("--state", "x", "--no-state")
    assert "not allowed with" in capsys.readouterr().err


def test_without_home_directory_no_pose_is_saved(monkeypatch, caplog, tmp_path):
    for name in ("XDG_STATE_HOME", "HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setitem(sys.modules, "pwd", None)
    assert folder() is None
    assert "--state DIR" in caplog.text
    assert folder("--state", str(tmp_path / "there")) == tmp_path / "there"


def test_state_directory_is_created_tested_and_logged(tmp_path, caplog):
    caplog.set_level("INFO")
    place = tmp_path / "new" / "place"
    assert folder("--state", str(place)) == place
    assert list(place.iterdir()) == []
    assert [r.getMessage() for r in caplog.records] == [f"the last poses are kept in {place}"]
    assert folder("--no-state") is None


def test_unusable_state_option_is_refused_at_once(world_file, tmp_path, refused):
    (tmp_path / "file").write_text("")
    for name, text in (
        (str(tmp_path / "file"), "file"),
        (str(tmp_path / "file" / "in"), "Not a directory"),
        ("", "''"),
    ):
        said = refused("serve", world_file, "--robot", "r1", "--listen", "tcp/127.0.0.1:0", "--state", name)
        assert "--state" in said
        assert text in said


@pytest.mark.parametrize(
    "wrong",
    [["--connect", "foo"], ["--listen", "foo"], ["--zenoh-config", "none.json5"], ["none.coview"], ["bad.coview"]],
)
def test_nothing_is_made_or_logged_before_map_and_options_are_right(world_file, tmp_path, monkeypatch, refused, wrong):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bad.coview").write_text("no map")
    site = [] if wrong[-1].endswith(".coview") else [world_file]
    assert wrong[-1] in refused("serve", *site, *wrong, "--state", tmp_path / "state", "--robot", "r1")
    assert not (tmp_path / "state").exists()


def test_unusable_default_state_directory_is_a_warning(monkeypatch, tmp_path, caplog):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "file"))
    assert folder() == tmp_path / "file" / "coview-stream"
    (line,) = [r.getMessage() for r in caplog.records if r.levelname == "WARNING"]
    assert "cannot be kept" in line
    assert "--state DIR or --no-state" in line


@pytest.mark.slow
@pytest.mark.parametrize("folder", [True, False])
def test_serve_runs_last_pose_keeper_unless_no_state(world_file, tmp_path, folder):
    keys, network = [robot_keys("native", "coview", "r1")], NetworkOptions(listen=[free_endpoint()])
    node = open_node(ServeOptions(world_file, keys, network, state=tmp_path if folder else None))
    try:
        assert ("coview-last-pose" in [thread.name for thread in threading.enumerate()]) == folder
    finally:
        node.close(5.0)
