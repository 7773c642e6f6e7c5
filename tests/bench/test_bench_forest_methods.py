"""All methods, asked one query on the map of a small drawn stand, agree with each other on what they say."""

import numpy as np
import pytest

from bench.forest.chains import BEST
from bench.forest.methods import BASELINES, METHODS, Methods
from bench.forest.tables import STEPS, recall, tables
from bench.forest.worlds import drawn
from coview_stream.basemap.basemap import BaseMap
from coview_stream.descriptors.network import shipped, weights_name
from coview_stream.training.recipe import Recipe

TINY = Recipe(
    built=0.0, size=(80.0, 80.0), sensors=("os64",), slope=(0.0, 5.0), stems=(200.0, 300.0), rays=20_000,
    pulses=(8.0, 8.0), travel=(4.0, 6.0), standing=0.0, leaf_off=0.0, mortality=(0.0, 0.0),
)  # fmt: skip


@pytest.fixture(scope="module")
def asked(tmp_path_factory):
    if not all((shipped() / weights_name(view)).is_file() for view in ("aerial", "ground")):
        pytest.skip("the package has no weights here; train them with 'coview-stream train'")
    place = drawn(tmp_path_factory.mktemp("forest"), 19_511, 2, TINY)
    methods = Methods(BaseMap.build(place.base, radius=30.0, learned=True, outlier_neighbours=0))
    return methods, [{"kind": place.kind, **methods.ask(drive)} for drive in place.drives]


def test_every_method_names_distinct_places_and_some_find_the_stand(asked):
    methods, answers = asked
    for answer in answers:
        assert tuple(sorted(answer["off"])) == tuple(sorted(METHODS))
        assert all(1 <= len(off) <= BEST for off in answer["off"].values())
    assert recall(answers, "canopy", 1) == 1.0
    assert recall(answers, "both", 1) == 1.0
    assert methods.chance == pytest.approx(np.pi * 100.0 / (4.0 * len(methods.base_map)))
    assert set(tables(answers)) == {"forest recall", "forest metric", "forest compared", "forest times"}


def test_every_methods_places_become_poses(asked):
    _, answers = asked
    for answer in answers:
        assert tuple(answer["chains"]) == BASELINES
        for method, chain in answer["chains"].items():
            assert chain["before"][0] == pytest.approx(answer["off"][method][0], abs=0.02)
            assert chain["passes"] or not chain["accepted"]
            assert chain["ms"] > 0
        # the right place, at the right heading: registration makes it exact
        for method in ("both", "canopy"):
            before, after = answer["chains"][method]["before"], answer["chains"][method]["after"]
            assert before[0] < 3.0
            assert before[1] < 12.0
            assert after[0] < 0.3
            assert after[1] < 1.0


def test_errors_and_places_tell_the_same(asked):
    _, answers = asked
    for answer in answers:
        assert answer["before"][0] == pytest.approx(answer["off"]["keypoints"][0], abs=0.02)
        assert answer["after"] is None or answer["after"][0] >= answer["off"]["verified"][0] - 0.02
        assert answer["passes"] or not answer["accepted"]
        assert set(answer["ms"]) == set(STEPS)
        assert min(answer["ms"].values()) > 0
