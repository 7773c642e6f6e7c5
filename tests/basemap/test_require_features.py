"""Learned features that cannot be used: ``auto`` goes without them and says so once, ``learned`` refuses."""

import json
import logging
import shutil
import warnings

import numpy as np
import pytest

from coview_stream.basemap.basemap import BaseMap
from coview_stream.config import LocalizerConfig
from coview_stream.descriptors import network
from coview_stream.descriptors.feature_map import weights_sha256
from coview_stream.descriptors.network import CARD, VIEW_NAMES, Network, file_sha256
from coview_stream.doctor.map_checks import map_findings, node_memory
from coview_stream.errors import ConfigError, CoViewError, CoViewWarning, InputError, TransportError
from coview_stream.localization.localizer import Localizer
from coview_stream.localization.search.recognizers import SearchIndex
from coview_stream.stream.node import serve
from coview_stream.stream.node.engines import SearchEngine, TrackEngine
from coview_stream.stream.transport.keys import robot_keys

RELEARN = "build it again"


def forget():
    network.network.cache_clear()
    weights_sha256.cache_clear()


@pytest.fixture
def weights(tmp_path, monkeypatch):
    """A folder of weights that the package takes for its own; nothing of before is remembered."""
    for file in network.weights_directory().iterdir():
        shutil.copy(file, tmp_path)
    monkeypatch.setattr(network, "weights_directory", lambda: tmp_path)
    forget()
    yield tmp_path
    forget()


def without_ground(folder, patch):
    (folder / "ground.npz").unlink()


def without_any(folder, patch):
    for view in VIEW_NAMES:
        (folder / f"{view}.npz").unlink()


def other_ground(folder, patch):
    (folder / "ground.npz").write_bytes((folder / "ground.npz").read_bytes() + b"\0")


def drawn_otherwise(folder, patch):
    patch.setattr("coview_stream.descriptors.feature_map.BIRDS_EYE_VIEW_VERSION", 0)


def not_of_the_card(folder, patch):
    card = json.loads((folder / CARD).read_text())
    (folder / CARD).write_text(json.dumps(card | {"sha256": dict.fromkeys(card["sha256"], "0" * 64)}))


SPOILT = [
    (without_ground, "no weights of the ground network; install the package again"),
    (without_any, "no weights of the aerial network; install the package again"),
    (other_ground, RELEARN),
    (drawn_otherwise, RELEARN),
    (not_of_the_card, "not the weights that card.json beside it names; install"),
]


def judged(base_map, text):
    """Every way to hear of features that cannot be used."""
    said = base_map.require_features("auto")
    assert said.startswith("going without learned features: ")
    assert text in said
    assert base_map.require_features("coview") is None
    with pytest.raises(CoViewError) as caught:
        base_map.require_features("learned")
    assert text in str(caught.value)
    with pytest.raises(type(caught.value)):
        Localizer(base_map, LocalizerConfig(reloc="learned"))
    with pytest.warns(CoViewWarning, match="going without") as warned:
        known = SearchIndex.of(base_map, LocalizerConfig())
    assert len(warned) == 1
    assert known.learned is None
    assert known.retrieval is not None
    findings = {f.what: f for f in map_findings(base_map, int(1e6), None)}
    assert findings["map features"].verdict == "warn"
    assert findings["map features"].remedy == said.partition("; ")[2]
    assert findings["map features"].remedy
    assert findings["map memory"].verdict == "ok"


@pytest.mark.parametrize(("spoil", "text"), SPOILT)
def test_missing_or_wrong_weights_disable_learned_features(learned_map, weights, monkeypatch, spoil, text):
    spoil(weights, monkeypatch)
    judged(learned_map, text)


def test_damaged_features_disable_learned_features(learned_map, weights):
    arrays = {n: v for n, v in learned_map.arrays.items() if n != "learned.sigma"}
    judged(BaseMap(arrays, learned_map.parameters), RELEARN)


def test_usable_features_give_no_warning(learned_map, world_map, weights):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert SearchIndex.of(learned_map, LocalizerConfig()).learned is not None
        assert SearchIndex.of(learned_map, LocalizerConfig(reloc="coview")).learned is None
        assert SearchIndex.of(world_map, LocalizerConfig()).learned is None
    for base_map, text in ((learned_map, "of the installed networks"), (world_map, "none")):
        assert base_map.require_features("auto") is None
        (finding,) = [f for f in map_findings(base_map, int(1e6), None) if f.what == "map features"]
        assert finding.verdict == "ok"
        assert text in finding.found


def test_track_engine_loads_no_network(learned_map, weights):
    engine = TrackEngine(learned_map)
    assert engine._index.learned is not None
    assert network.network.cache_info().currsize == 0
    _ = SearchEngine(learned_map)
    assert network.network.cache_info().currsize == 1


def test_serve_warns_once_and_runs_without_learned_features(learned_map, tmp_path, monkeypatch, caplog):
    parameters = {**learned_map.parameters, "learned": {**learned_map.parameters["learned"], "weights": "0" * 64}}
    BaseMap(learned_map.arrays, parameters).save(tmp_path / "old.coview")
    relocs = []

    class Recorded(serve.EngineProcess):
        def __init__(self, *given, **named):
            super().__init__(*given, **named)
            relocs.append(given[3].reloc)

        def start(self):
            raise TransportError("that is enough")

    monkeypatch.setattr(serve, "EngineProcess", Recorded)
    options = serve.ServeOptions(tmp_path / "old.coview", [robot_keys("native", "coview", "r1")])
    with caplog.at_level(logging.WARNING), pytest.raises(TransportError, match="that is enough"):
        serve.open_node(options)
    assert relocs == ["coview", "coview"]
    assert len(caplog.records) == 1
    assert RELEARN in caplog.text


def test_node_memory_counts_bounding_rectangle_of_features(learned_map, world_map):
    """Two tiles at the ends of a diagonal of 3 km."""
    arrays = dict(learned_map.arrays)
    arrays["learned.tiles"] = arrays["learned.tiles"].copy()
    arrays["learned.tiles"][-1] = arrays["learned.tiles"][0] + 100
    sparse = BaseMap(arrays, learned_map.parameters)
    near, far = node_memory(learned_map), node_memory(sparse)
    assert near > node_memory(world_map)
    assert far - near == pytest.approx(2.09e8, rel=0.05)  # 101 x 101 tiles of 1,024 m2, 20 bytes on each


def test_foreign_weights_are_refused(weights):
    (weights / CARD).unlink()
    file = weights / "ground.npz"
    with np.load(file) as opened:
        arrays = dict(opened)
    named = {name: array for name, array in arrays.items() if name != "down2.bias"}
    for wrong in (named, arrays | {"down2.bias": arrays["power"]}):
        np.savez(file, **wrong)
        with pytest.raises(InputError, match="cannot be loaded as weights"):
            Network("ground", weights)
    for junk in (b"", b"no archive", file.read_bytes()[:50_000]):
        file.write_bytes(junk)
        with pytest.raises(InputError, match="cannot be loaded as weights"):
            Network("ground", weights)
    np.savez(file, **(arrays | {"stem.weight": arrays["stem.weight"][:, :, :12]}))
    with pytest.raises(InputError, match=r"another version \(3 layers\)"):
        Network("ground", weights)


def test_card_hashes_distinguish_views(weights):
    hashes = {f"{view}.npz": file_sha256(weights / f"{view}.npz") for view in VIEW_NAMES}
    (weights / CARD).write_text(json.dumps({"sha256": hashes}))
    for view in VIEW_NAMES:
        Network(view, weights)
    shutil.copy(weights / "aerial.npz", weights / "ground.npz")
    with pytest.raises(InputError, match=r"ground\.npz: not the weights"):
        Network("ground", weights)


def test_maps_made_with_the_weights_as_onnx_files_stay_valid():
    """The hash that such maps name, of the files at commit 140d99ec."""
    assert weights_sha256() == "6140b640ef6cb4a48b9dfc62105161b80b79c23d90a7f5a6d520bfc0fe9ebe09"


def test_coview_threads_must_be_a_number(weights, monkeypatch):
    monkeypatch.setenv("COVIEW_THREADS", "two")
    with pytest.raises(ConfigError, match="COVIEW_THREADS is 'two'"):
        network.network("aerial")
