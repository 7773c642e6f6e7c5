"""Trust in a map file: its signature, its signed hashes, and what tells that it has changed since."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from coview_stream.basemap.signature import SigningKey, VerifyKey
from coview_stream.errors import MapError


class FileIdentity(NamedTuple):
    """State of a file by which a change of it is noticed: one that is written to, or replaced, has another."""

    device: int
    inode: int
    size: int
    mtime_ns: int
    ctime_ns: int


class Trust(NamedTuple):
    """Demand that a file is signed.

    Attributes:
        key: public key of who may sign.
        verified: of a file whose arrays have been compared with their hashes already; they are not read again if it is
            still that. None compares them.
    """

    key: VerifyKey
    verified: FileIdentity | None = None


def identity(file: BinaryIO) -> FileIdentity:
    """Return that of an open file."""
    now = os.fstat(file.fileno())
    return FileIdentity(now.st_dev, now.st_ino, now.st_size, now.st_mtime_ns, now.st_ctime_ns)


def serialized(header: dict[str, Any]) -> bytes:
    """Return a header as it is written and, without its signature, as it is signed."""
    return json.dumps(header, separators=(",", ":")).encode()


def sign(header: dict[str, Any], sections: dict[str, str], key: SigningKey) -> None:
    """Put hashes of the arrays, by name, and a signature of all that into a header."""
    metadata = header["__metadata__"]
    metadata |= {"sections": json.dumps(sections), "signer": key.fingerprint}
    metadata["signature"] = key.sign(serialized(header)).hex()


def check_signature(path: Path, header: dict[str, Any], exact: bool, key: VerifyKey) -> None:
    """Verify a header.

    Args:
        path: the file, for messages.
        header: as it was read.
        exact: whether the file holds it byte for byte as we write it.
        key: has to have signed it.

    Raises:
        MapError: it is not signed, not by this key, or has been changed since.
    """
    metadata = header["__metadata__"]
    if "signature" not in metadata:
        raise MapError(
            f"{path}: the map is not signed, and a signature by {key.name} is asked for; build it with --sign and "
            f"the key that {key.name} belongs to"
        )
    signed = header | {"__metadata__": {name: value for name, value in metadata.items() if name != "signature"}}
    try:
        signature = bytes.fromhex(metadata["signature"])
    except (TypeError, ValueError):
        signature = b""
    exact = exact and signature.hex() == metadata["signature"]  # nor in capitals
    if exact and key.verifies(serialized(signed), signature):
        return
    by = str(metadata.get("signer"))[:32]
    if by != key.fingerprint:
        raise MapError(
            f"{path}: the map is signed with another key ({by}) than {key.name} ({key.fingerprint}); give the public "
            "key of who built it, or a map of theirs"
        )
    raise MapError(f"{path}: the map's header has been changed since it was signed; copy or build it again")


def check_sections(header: dict[str, Any], content: Callable[[str], Iterable[bytes]]) -> None:
    """Compare the content of each array with its signed hash.

    Raises:
        ValueError: one differs, or not all have one.
    """
    sections = json.loads(header["__metadata__"]["sections"])
    names = header.keys() - {"__metadata__"}
    if sections.keys() != names:
        raise ValueError("not every array has a signed hash")
    for name in sorted(names):
        if digest(content(name)) != sections[name]:
            raise ValueError(f"{name} has been changed since it was signed")


def digest(chunks: Iterable[bytes | memoryview]) -> str:
    """Return the sha256 of bytes that come in pieces."""
    total = hashlib.sha256()
    for chunk in chunks:
        total.update(chunk)
    return total.hexdigest()
