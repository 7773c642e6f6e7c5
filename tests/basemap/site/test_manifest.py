"""Manifest of a site: written, read, signed; what does not belong there is refused by name."""

import json
import tracemalloc
from dataclasses import asdict, replace

import pytest

from coview_stream.basemap.signature import SigningKey, make_keys, read_verify_key
from coview_stream.basemap.site.manifest import LayerEntry, Manifest, TileEntry
from coview_stream.basemap.site.store import TileStore
from coview_stream.config import MapConfig
from coview_stream.errors import MapError

SHA = "ab" * 32
CONFIG = json.loads(json.dumps(asdict(MapConfig())))
TILE = TileEntry(-1, 2, 10, 3, 7, -1.5, 20.25, {name: LayerEntry(SHA, 99) for name in ("cloud", "stations")})
SITE = Manifest((500_000.0, 5_400_000.0, 100.0), 320.0, "EPSG:25832", {"config": CONFIG}, (TILE,))


def test_manifest_comes_back_with_the_same_hash(tmp_path):
    SITE.save(tmp_path)
    found = Manifest.load(tmp_path)
    assert found == SITE
    assert found.sha256 == SITE.sha256 != replace(SITE, crs=None).sha256
    assert (found.nbytes, found.hashes()) == (198, {SHA})


def test_manifest_of_the_version_before_keeps_its_hash(tmp_path):
    before = replace(SITE, version=1)
    before.save(tmp_path)
    found = Manifest.load(tmp_path)
    assert found == before
    assert found.sha256 == before.sha256 != SITE.sha256
    assert json.loads((tmp_path / "manifest.json").read_bytes())["version"] == 1


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("format",), "x"), (("version",), 3), (("origin",), [1, 2]), (("tile",), "a"), (("tile",), 0.1),
        (("tiles", 0, "column"), 1.5), (("tiles", 0, "row"), True), (("tiles", 0, "points"), -1),
        (("tiles", 0, "layers", "cloud", "sha256"), "../../etc/passwd"),
        (("tiles", 0, "layers", "cloud", "bytes"), 1 << 40), (("tiles", 0, "layers"), {}),
        (("tiles", 0, "layers", "other"), {"sha256": SHA, "bytes": 1}), (("tiles",), None), (("parameters",), []),
        (("tiles", 0, "low"), 1e300), (("crs",), 4), (("tile",), 300.0), (("parameters",), {}),
        (("parameters", "config"), {"block": 2.0}), (("parameters", "config", "block"), "2"),
        (("tiles", 0, "points"), 30_000_000), (("tiles", 0, "stations"), 30_000_000),
        (("parameters", "config", "descriptor", "rings"), 320),
        (("parameters", "config", "descriptor", "radius"), 900.0),
        (("tiles", 0, "stations"), 410_000), (("tiles", 0, "layers", "cloud", "bytes"), 1 << 25),
        (("tiles", 0, "points"), 400),
        (("crs",), "\ud800"), (("parameters", "sources"), {"\udfff": "a"}), (("parameters", "x"), float("nan")),
        (("parameters", "x"), float("-inf")),
    ],
)  # fmt: skip
def test_manifest_with_something_else_is_refused(path, value):
    plain = json.loads(SITE.to_bytes())
    at = plain
    for name in path[:-1]:
        at = at[name]
    at[path[-1]] = value
    with pytest.raises(MapError, match=r"site\.json"):
        Manifest.from_bytes(json.dumps(plain).encode(), "site.json")


@pytest.mark.parametrize("value", ["1e999", "[" * 700 + "]" * 700, '{"a":' * 300 + "1" + "}" * 300, "9" * 5000])
def test_manifest_that_could_not_be_written_again_is_refused(value):
    raw = SITE.to_bytes().replace(b'"parameters": {', b'"parameters": {"x": ' + value.encode() + b",")
    with pytest.raises(MapError, match=r"site\.json"):
        Manifest.from_bytes(raw, "site.json")


def test_manifest_names_a_tile_once():
    with pytest.raises(MapError, match="named twice"):
        Manifest.from_bytes(replace(SITE, tiles=(TILE, TILE)).to_bytes(), "site.json")


def test_signature_covers_the_hashes_of_the_layers(tmp_path):
    private, public, _ = make_keys(tmp_path / "mine")
    other = read_verify_key(make_keys(tmp_path / "other")[1])
    key = read_verify_key(public)
    signed = Manifest.from_bytes(SITE.signed(SigningKey(private)).to_bytes(), "a", key)
    assert signed.sha256 == SITE.sha256
    indented = json.dumps(json.loads(signed.to_bytes()), sort_keys=True, indent=1).encode()  # as earlier versions did
    assert Manifest.from_bytes(indented, "a", key) == signed
    with pytest.raises(MapError, match="not signed"):
        Manifest.from_bytes(SITE.to_bytes(), "a", key)
    swapped = replace(signed, tiles=(replace(TILE, layers=TILE.layers | {"cloud": LayerEntry("cd" * 32, 99)}),))
    for wrong, by in ((swapped, key), (signed, other)):
        with pytest.raises(MapError, match="is not signed with"):
            Manifest.from_bytes(wrong.to_bytes(), "a", by)


def test_nothing_is_parsed_before_the_signature_is_verified(tmp_path):
    private, public, _ = make_keys(tmp_path / "mine")
    raw = SITE.signed(SigningKey(private)).to_bytes()
    changed = raw.replace(b'"area": 7', b'"area": ]')  # which no parser takes
    assert changed != raw
    with pytest.raises(MapError, match="is not signed with"):
        Manifest.from_bytes(changed, "a", read_verify_key(public))


def test_manifest_of_many_tiles_is_read_tile_by_tile():
    many = replace(SITE, tiles=tuple(replace(TILE, column=k) for k in range(300)))
    raw = many.to_bytes()
    assert Manifest.from_bytes(raw, "site.json") == many
    third, fifth = (f'"area": 7, "column": {k},'.encode() for k in (3, 5))
    assert third in raw
    wrong = raw.replace(third, b'"area": -7, "column": 3,').replace(fifth, b"]")
    with pytest.raises(MapError, match=r"-7 is not a whole number"):  # checked before the text behind it is parsed
        Manifest.from_bytes(wrong, "site.json")
    for blanks, holds in ((1024, True), (2048, False)):  # the parser is given no more of a tile than 2 kB at once
        padded = raw.replace(third, third + b" " * blanks)
        if holds:
            assert Manifest.from_bytes(padded, "site.json") == many
        else:
            with pytest.raises(MapError, match=r"site\.json"):
                Manifest.from_bytes(padded, "site.json")


@pytest.mark.parametrize(
    "tiles", [b"{}," * 1000 + b"{}", b"[" * 4000, b'"' + b"x" * 4000 + b'"', b'{"a": ' + b"1, " * 4000 + b"}", b"1"]
)
def test_what_is_no_tile_is_refused_at_once(tiles):
    raw = SITE.to_bytes()
    begin = raw.index(b'"tiles": [') + len(b'"tiles": [')
    tracemalloc.start()
    with pytest.raises(MapError, match=r"site\.json"):
        Manifest.from_bytes(raw[:begin] + tiles * 500 + raw[raw.index(b"\n]", begin) :], "site.json")
    assert tracemalloc.get_traced_memory()[1] < 4 * len(tiles * 500) + 1_000_000
    tracemalloc.stop()


def test_manifest_larger_than_any_site_is_refused():
    with pytest.raises(MapError, match="more than 16 MB"):
        Manifest.from_bytes(SITE.to_bytes() + b" " * (1 << 24), "site.json")


def test_store_gives_back_only_what_its_name_says(tmp_path):
    store = TileStore(tmp_path)
    sha = store.put(b"hello")
    assert store.get(sha, 5) == b"hello"
    assert store.put(b"hello") == sha
    for content in (b"hellO", b"hell", b"hello!", None):
        if content is None:
            store.path(sha).unlink()
        else:
            store.path(sha).write_bytes(content)
        with pytest.raises(MapError, match=sha):
            store.get(sha, 5)
        assert not store.is_whole(sha, 5)
    with pytest.raises(MapError, match="is not a sha256"):
        store.path("../x")


def test_store_keeps_what_is_named(tmp_path):
    store = TileStore(tmp_path)
    kept, other = store.put(b"kept"), store.put(b"other")
    store.prune({kept})
    assert store.holds(kept, 4)
    assert not store.holds(other, 5)
