"""``keygen``, ``build --sign`` and ``--verify-key``: a map of somebody else is one line and exit code 2."""

import json

import pytest

from coview_stream.basemap.basemap import BaseMap
from coview_stream.basemap.signature import SigningKey, read_verify_key
from coview_stream.cli import main


@pytest.fixture(scope="module")
def site(tmp_path_factory, world_map, world_drive):
    """Folder with a signed map, the keys ``ours`` and ``theirs``, and an unsigned map."""
    folder = tmp_path_factory.mktemp("signed")
    for name in ("ours", "theirs"):
        assert main(["keygen", str(folder / name)]) == 0
    BaseMap(world_map.arrays, world_map.parameters).save(folder / "signed.coview", SigningKey(folder / "ours.key"))
    BaseMap(world_map.arrays, world_map.parameters).save(folder / "unsigned.coview")
    damaged = bytearray((folder / "signed.coview").read_bytes())
    damaged[-50] ^= 4
    (folder / "damaged.coview").write_bytes(damaged)
    (folder / "run").mkdir()
    return folder


def command(name, site, map_name, key):
    more = {
        "serve": ["--robot", "r1", "--no-state"],
        "locate": [str(site / "run"), "-o", str(site / "out")],
        "info": [],
    }[name]
    return [name, str(site / map_name), *more, "--verify-key", str(site / key)]


@pytest.mark.parametrize("name", ["info", "locate", pytest.param("serve", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("map_name", "key", "said"),
    [
        ("signed.coview", "theirs.pub", "another key"),
        ("unsigned.coview", "ours.pub", "not signed"),
        ("damaged.coview", "ours.pub", "changed since it was signed"),
        ("signed.coview", "ours.key", "is a private key"),
        ("signed.coview", "none.pub", "cannot read the key"),
    ],
)
def test_map_that_is_not_to_be_trusted_is_one_line_and_exit_code_2(site, refused, name, map_name, key, said):
    line = refused(*command(name, site, map_name, key))
    assert said in line
    assert str(site / (key if "key" in said and "another" not in said else map_name)) in line


@pytest.mark.slow
def test_build_signs_and_info_tells(map_cloud_file, site, capsys):
    target = site / "built.coview"
    options = ["--radius", "30", "--no-learned", "--sign", str(site / "ours.key")]
    assert main(["build", str(map_cloud_file), "-o", str(target), *options]) == 0
    fingerprint = read_verify_key(site / "ours.pub").fingerprint
    assert f"signed with {fingerprint}" in capsys.readouterr().out
    assert main(["info", str(target), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["signature"] == f"by {fingerprint}, it says; --verify-key verifies it"
    assert main(["info", str(target), "--json", "--verify-key", str(site / "ours.pub")]) == 0
    assert json.loads(capsys.readouterr().out)["signature"] == f"by {fingerprint}, verified"
    assert main(["info", str(site / "unsigned.coview"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["signature"] == "none"


def test_build_with_a_wrong_key_reads_no_cloud(site, refused):
    target, key = site / "none.coview", site / "ours.pub"
    assert "holds no private key" in refused("build", site / "not-even-looked-for.ply", "-o", target, "--sign", key)
    assert not target.exists()
