"""``coview-stream eval`` on files."""

import json
import re

import numpy as np
import pytest

from coview_stream.cli import main
from coview_stream.clouds.trajectory import write_tum
from coview_stream.geometry.transforms import pose_from


@pytest.fixture
def truth(tmp_path):
    path = tmp_path / "truth.tum"
    write_tum(path, 0.1 * np.arange(10), [pose_from(np.eye(3), [k, 0, 0]) for k in range(10)])
    return path


def test_eval_prints_table_and_json(truth, tmp_path, capsys):
    estimate = tmp_path / "est.tum"
    write_tum(estimate, 0.1 * np.arange(4, 10), [pose_from(np.eye(3), [k, 0.25, 0]) for k in range(4, 10)])
    assert main(["eval", str(estimate), str(truth)]) == 0
    out = capsys.readouterr().out
    assert out.startswith(f"compared           {estimate}, with the truth in {truth}\n")
    assert "60.0% of 10 frames" in out
    assert "after 4.0 m" in out
    assert "mean 0.250" in out
    assert main(["eval", str(estimate), str(truth), "--json"]) == 0
    verdict = json.loads(capsys.readouterr().out)
    assert verdict["success"] is True
    assert verdict["translation"]["mean"] == 0.25


@pytest.mark.slow
def test_empty_trajectory_is_never_localized(truth, tmp_path, capsys):
    empty = tmp_path / "est.tum"
    empty.write_text("")
    assert main(["eval", str(empty), str(truth), "--plot", str(tmp_path / "errors.png")]) == 0
    assert re.search(r"^success +no: no pose$.*never", capsys.readouterr().out, re.MULTILINE | re.DOTALL)
    assert (tmp_path / "errors.png").stat().st_size > 1000


OTHER_RUN = "1700000000 0 0 0 0 0 0 1\n"


@pytest.mark.parametrize("content", ["", "1 2 3\n", "nonsense\n", None, OTHER_RUN])
def test_bad_ground_truth_is_one_line(truth, tmp_path, refused, content):
    bad = tmp_path / "bad.tum"
    if content is not None:
        bad.write_text(content)
    error = refused("eval", truth, bad)
    assert "bad.tum" in error
    assert ("truth.tum and " in error) == (content == OTHER_RUN)
