"""The view in rerun: a file without a viewer, and one line where there is no display."""

import sys

import pytest

from coview_stream.errors import ConfigError, InputError
from coview_stream.viewers.rerun_sink import RerunSink
from tests.viewers.test_foxglove_sink import shown

pytest.importorskip("rerun", reason="rerun-sdk is not there; pip install 'coview-stream[viz]'")


def test_file_holds_map_robot_and_hypotheses(tmp_path):
    sink = RerunSink(tmp_path / "a.rrd")
    shown(sink)
    sink.close()
    raw = (tmp_path / "a.rrd").read_bytes()
    assert raw[:3] == b"RRF"
    assert len(raw) > 8 * 500
    for name in (b"map/points", b"robots/r1/body", b"robots/r1/covariance", b"hypotheses", b"scan", b"state"):
        assert name in raw


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere a viewer needs no variable")
def test_no_display_is_one_line(monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(ConfigError, match="no display here; write a file with --record"):
        RerunSink()


def test_file_in_no_directory_is_told(tmp_path):
    with pytest.raises(InputError, match="no such directory"):
        RerunSink(tmp_path / "none" / "a.rrd")
