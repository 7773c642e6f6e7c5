"""Pictures of a localized run, from what the localizer answered."""

from __future__ import annotations

import pytest

from coview_stream.localization.offline import locate
from coview_stream.localization.result import Fix
from coview_stream.localization.state import State
from coview_stream.recordings import open_run
from coview_stream.report.plots import draw_run


@pytest.mark.slow
def test_run_draws_trajectory_and_descriptors_of_first_match(world_map, world_run, tmp_path):
    result = locate(world_map, open_run(world_run))
    draw_run(result, world_map, tmp_path)
    for name in ("trajectory.png", "descriptors.png"):
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_run_without_match_draws_trajectory_only(world_map, world_run, tmp_path):
    result = locate(world_map, open_run(world_run))
    result.fixes, result.winner = [Fix(0.0, State.SEARCHING)], None
    draw_run(result, world_map, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["trajectory.png"]
