"""A real plot among real airborne tiles: no wrong place is believed, and the canopy's heights find the right one."""

import os
from pathlib import Path

import pytest

from bench.forest.plot import HEADINGS, measured, plot_table
from bench.forest.tables import false, recall
from coview_stream.descriptors.network import shipped, weights_name

pytestmark = pytest.mark.realdata

DATA = Path(os.environ.get("COVIEW_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))


def test_a_real_plot_is_not_mistaken_for_another_place():
    for name in ("forest_plot/MLS_Clip.laz", "forest_plot/ALS_Clip.laz", "forest_als/bcts_3.laz"):
        if not (DATA / name).is_file():
            pytest.skip(f"real scans {DATA / name} are not here; name their folder in COVIEW_DATA")
    if not (shipped() / weights_name("ground")).is_file():
        pytest.skip("the package has no weights here; train them with 'coview-stream train'")
    answers = measured(DATA, ("bcts_3.laz",))
    assert len(answers) == HEADINGS
    assert recall(answers, "canopy", 1) == 1.0
    assert not any(false(answer, "accepted") for answer in answers)
    assert "chance" in plot_table(answers)
