"""Signed maps: any changed byte is one MapError, whenever the file is changed; and the files of keys."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from coview_stream.basemap import file_format
from coview_stream.basemap.basemap import BaseMap
from coview_stream.basemap.signature import SigningKey, Trust, VerifyKey, file_identity, make_keys, read_verify_key
from coview_stream.errors import DependencyError, InputError, MapError
from coview_stream.stream.node.engines import open_engine
from tests.basemap.test_file_format import PARAMETERS, arrays


@pytest.fixture(scope="module")
def keys(tmp_path_factory):
    """Name without suffix of a pair of keys, and of another."""
    folder = tmp_path_factory.mktemp("keys")
    for name in ("ours", "theirs"):
        make_keys(folder / name)
    return folder / "ours", folder / "theirs"


@pytest.fixture(scope="module")
def key(keys):
    return read_verify_key(f"{keys[0]}.pub")


@pytest.fixture
def path(tmp_path, keys):
    path = tmp_path / "site.coview"
    file_format.save(path, arrays(), PARAMETERS, SigningKey(f"{keys[0]}.key"))
    return path


def opened(path, key, verified=None):
    return file_format.open_file(path, trust=Trust(key, verified))


def test_signed_map_opens_with_its_key_and_without(path, key):
    loaded = opened(path, key)
    assert loaded.parameters == PARAMETERS
    for name, array in arrays().items():
        np.testing.assert_array_equal(loaded.arrays[name], array)
    assert file_format.load(path)[2] == loaded.sha256
    assert file_format.signer(path) == key.fingerprint


def test_signature_does_not_change_the_hash_of_the_content(path, tmp_path):
    unsigned = tmp_path / "unsigned.coview"
    assert file_format.save(unsigned, arrays(), PARAMETERS) == file_format.load(path)[2]
    assert file_format.signer(unsigned) is None


@pytest.mark.slow
def test_every_flipped_byte_is_refused(path, key):
    """Of the header as well, of its padding and its signature: nothing in the file is unsigned."""
    whole = path.read_bytes()
    for place in range(len(whole)):
        for bit in (0x01, 0x20):  # the second makes capitals of small letters
            damaged = bytearray(whole)
            damaged[place] ^= bit
            path.write_bytes(damaged)
            with pytest.raises(MapError) as error:
                opened(path, key)
            assert str(path) in str(error.value)
            assert "\n" not in str(error.value)


def test_truncated_longer_and_unsigned_files_and_other_keys_are_refused(path, key, keys):
    theirs = read_verify_key(f"{keys[1]}.pub")
    with pytest.raises(MapError, match=f"signed with another key .*{theirs.fingerprint}"):
        opened(path, theirs)
    content = path.read_bytes()
    for length in (0, 7, 100, -1):
        path.write_bytes(content[:length])
        with pytest.raises(MapError):
            opened(path, key)
    path.write_bytes(content + b"x")
    with pytest.raises(MapError, match="are not signed"):
        opened(path, key)
    path.unlink()
    file_format.save(path, arrays(), PARAMETERS)
    with pytest.raises(MapError, match=r"not signed.*--sign"):
        opened(path, key)


def test_signature_of_another_map_does_not_fit(path, keys, key, tmp_path):
    """Content and checksum are changed as one, the signature is left: what a checksum alone lets through."""
    other = tmp_path / "other.coview"
    file_format.save(other, arrays(1), PARAMETERS, SigningKey(f"{keys[0]}.key"))
    text, wrong = (re.search(rb'"signature":"([0-9a-f]+)', file.read_bytes())[1] for file in (path, other))
    forged = other.read_bytes().replace(wrong, text)
    assert forged != other.read_bytes()
    other.write_bytes(forged)
    assert file_format.load(other)  # its checksum holds
    with pytest.raises(MapError, match="changed since it was signed"):
        opened(other, key)


def test_file_that_is_replaced_while_it_is_verified_is_not_mixed(path, key, keys, tmp_path):
    other = tmp_path / "other.coview"
    file_format.save(other, arrays(1), PARAMETERS, SigningKey(f"{keys[0]}.key"))

    class Replacing(VerifyKey):
        def verifies(self, message, signature):
            other.replace(path)
            return super().verifies(message, signature)

    with pytest.raises(MapError, match="while it was verified; open it again"):
        opened(path, Replacing(key.raw, key.name))
    np.testing.assert_array_equal(opened(path, key).arrays["points"], arrays(1)["points"])


def test_verified_file_is_not_read_again_and_a_changed_one_is(path, key):
    known = opened(path, key).identity
    damaged = bytearray(path.read_bytes())
    damaged[-1] ^= 1
    path.write_bytes(damaged)
    os.utime(path, ns=(known.mtime_ns, known.mtime_ns))  # the time can be set back, that of the change cannot
    with pytest.raises(MapError, match="changed since it was signed"):
        opened(path, key, known)
    with path.open("rb") as file:
        assert opened(path, key, file_identity(file))  # not compared


@pytest.fixture
def signed_world(world_map, keys, tmp_path):
    target = tmp_path / "world.coview"
    BaseMap(world_map.arrays, world_map.parameters).save(target, SigningKey(f"{keys[0]}.key"))
    return target


def test_engines_refuse_a_file_that_was_changed_after_the_node_verified_it(signed_world, key, tmp_path):
    """With the header, and so with the hash, of the one that was verified."""
    node = BaseMap.load(signed_world, verify_key=key)
    trust = Trust(key, node.identity)
    assert open_engine("track", signed_world, node.sha256, trust=trust)
    evil = tmp_path / "evil"
    shutil.copyfile(signed_world, evil)
    with evil.open("r+b") as file:
        file.seek(-100, os.SEEK_END)
        file.write(bytes(100))
    evil.replace(signed_world)
    assert open_engine("track", signed_world, node.sha256)  # without a key the node's check is believed
    with pytest.raises(MapError, match="changed since it was signed"):
        open_engine("track", signed_world, node.sha256, trust=trust)


def test_engines_refuse_another_map_of_the_same_key(signed_world, key, keys, world_map):
    node = BaseMap.load(signed_world, verify_key=key)
    other = BaseMap(world_map.arrays, world_map.parameters | {"crs": "another"})
    other.save(signed_world, SigningKey(f"{keys[0]}.key"))
    with pytest.raises(MapError, match="replaced by another map"):
        open_engine("track", signed_world, node.sha256, trust=Trust(key, node.identity))


def test_key_may_be_a_path(signed_world, keys):
    assert BaseMap.load(signed_world, verify_key=f"{keys[0]}.pub").sha256
    with pytest.raises(MapError, match="another key"):
        BaseMap.load(signed_world, verify_key=Path(f"{keys[1]}.pub"))


def test_keys_are_never_overwritten_and_private_ones_are_private(keys, tmp_path):
    private = Path(f"{keys[0]}.key")
    before = private.read_bytes()
    assert private.stat().st_mode & 0o077 == 0
    with pytest.raises(InputError, match="exists"):
        make_keys(keys[0])
    assert private.read_bytes() == before
    with pytest.raises(InputError, match="cannot be written"):
        make_keys(tmp_path / "none" / "key")


def test_files_that_are_no_keys_and_wrong_halves_of_pairs_are_refused(keys, tmp_path):
    path = tmp_path / "a.pub"
    for content in (b"", b"\xff" * 40, b"-----BEGIN PUBLIC KEY-----\n-----END PUBLIC KEY-----\n"):
        path.write_bytes(content)
        for read in (read_verify_key, SigningKey):
            with pytest.raises(InputError, match=r"a\.pub: holds no"):
                read(path)
    with pytest.raises(InputError, match="is a private key"):
        read_verify_key(f"{keys[0]}.key")
    with pytest.raises(InputError, match="holds no private key"):
        SigningKey(f"{keys[0]}.pub")
    with pytest.raises(InputError, match="cannot read the key"):
        read_verify_key("nowhere.pub")


@pytest.mark.skipif(shutil.which("openssl") is None, reason="no openssl")
def test_keys_of_openssl_are_read(tmp_path):
    """As docs/operate.md says."""
    private, public = tmp_path / "site.key", tmp_path / "site.pub"
    subprocess.run(["openssl", "genpkey", "-algorithm", "ed25519", "-out", private], check=True)
    subprocess.run(["openssl", "pkey", "-in", private, "-pubout", "-out", public], check=True)
    message, sign = b"text", SigningKey(private)
    key = read_verify_key(public)
    assert key.fingerprint == sign.fingerprint
    assert key.verifies(message, sign.sign(message))
    assert not key.verifies(message + b"s", sign.sign(message))
    rsa = tmp_path / "rsa.key"
    subprocess.run(["openssl", "genpkey", "-algorithm", "rsa", "-out", rsa], check=True, capture_output=True)
    with pytest.raises(InputError, match="not ed25519"):
        SigningKey(rsa)


def test_nothing_is_taken_as_signed_by_a_key_that_is_none():
    assert not VerifyKey(bytes(32), "zeros").verifies(b"", bytes(64)[:63])
    assert not VerifyKey(b"short", "short").verifies(b"", bytes(64))


def test_missing_library_is_one_line_with_the_remedy(path, key, monkeypatch):
    monkeypatch.setitem(sys.modules, "cryptography.exceptions", None)
    with pytest.raises(DependencyError, match=r"pip install 'cryptography>=42'"):
        opened(path, key)


def test_failed_writing_leaves_no_key(tmp_path):
    (tmp_path / "site.pub").symlink_to(tmp_path / "none" / "site.pub")
    with pytest.raises(InputError, match=r"site\.pub: exists; a key is never overwritten"):
        make_keys(tmp_path / "site")
    assert [path.name for path in tmp_path.iterdir()] == ["site.pub"]
