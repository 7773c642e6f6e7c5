"""Signatures of map files: ed25519, with keys in PEM files, which ``openssl`` writes and reads too.

The signature covers the file's header with the hashes of all arrays. The header holds the signature, so a map and its
signature are copied and replaced together.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from coview_stream.errors import InputError, MapError, require_library

REQUIREMENT = "cryptography>=42"
_DOMAIN = b"coview-map ed25519 1\n"  # domain separation: no other use of a key signs such bytes
_PURPOSE = "signed maps"
_MAX_KEY = 1 << 14  # bytes of a key's file; an ed25519 PEM file has some 120


@dataclass(frozen=True)
class VerifyKey:
    """Public key that verifies maps.

    Attributes:
        raw: its 32 bytes.
        name: its file, for messages.
    """

    raw: bytes
    name: str

    @property
    def fingerprint(self) -> str:
        """First half of the sha256 of the key's bytes, hexadecimal."""
        return sha256_of([self.raw])[:32]

    def verifies(self, message: bytes, signature: bytes) -> bool:
        """Return whether the key's owner has signed the message."""
        library = _library("asymmetric.ed25519")
        invalid = require_library("cryptography.exceptions", REQUIREMENT, _PURPOSE).InvalidSignature
        try:
            library.Ed25519PublicKey.from_public_bytes(self.raw).verify(signature, _DOMAIN + message)
        except (invalid, ValueError):
            return False
        return True


class SigningKey:
    """Private key that signs maps, from an unencrypted PEM file.

    Attributes:
        fingerprint: fingerprint of its public key.

    Raises:
        InputError: the file cannot be read, or holds no private ed25519 key. DependencyError: no ``cryptography``.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        text = _read(path)
        kind = _library("asymmetric.ed25519").Ed25519PrivateKey
        try:
            key = _library("serialization").load_pem_private_key(text, password=None)
        except TypeError as error:
            raise InputError(
                f"{path}: the key is encrypted; decrypt it for the build (openssl pkey -in {path} -out plain.key)"
            ) from error
        except Exception as error:  # also of kinds of keys that the library does not know
            raise InputError(f"{path}: holds no private key (PEM); make one with 'coview-stream keygen'") from error
        if not isinstance(key, kind):
            raise InputError(f"{path}: the key is not ed25519; make one with 'coview-stream keygen'")
        self._key: Any = key
        self.fingerprint = VerifyKey(key.public_key().public_bytes_raw(), "").fingerprint

    def sign(self, message: bytes) -> bytes:
        """Return the signature of a message, 64 bytes."""
        return bytes(self._key.sign(_DOMAIN + message))


def read_verify_key(path: str | os.PathLike[str]) -> VerifyKey:
    """Read a public key.

    Raises:
        InputError: the file cannot be read, or holds no public ed25519 key (PEM). DependencyError: no ``cryptography``.
    """
    text = _read(path)
    kind = _library("asymmetric.ed25519").Ed25519PublicKey
    if b"PRIVATE KEY-----" in text:
        raise InputError(f"{path}: is a private key, which belongs where maps are built; give the public one (.pub)")
    try:
        key = _library("serialization").load_pem_public_key(text)
    except Exception as error:  # also of kinds of keys that the library does not know
        raise InputError(
            f"{path}: holds no public key (PEM); give the .pub file of 'coview-stream keygen', or that of "
            "'openssl pkey -pubout'"
        ) from error
    if not isinstance(key, kind):
        raise InputError(f"{path}: the key is not ed25519; give the .pub file of 'coview-stream keygen'")
    return VerifyKey(key.public_bytes_raw(), str(path))


def make_keys(name: str | os.PathLike[str]) -> tuple[Path, Path, str]:
    """Write a new pair of keys, ``NAME.key`` (readable only by its owner) and ``NAME.pub``.

    Returns:
        Both paths and the fingerprint.

    Raises:
        InputError: a file exists or cannot be written. DependencyError: no ``cryptography``.
    """
    private, public = Path(f"{os.fspath(name)}.key"), Path(f"{os.fspath(name)}.pub")
    form = _library("serialization")
    key = _library("asymmetric.ed25519").Ed25519PrivateKey.generate()
    secret = key.private_bytes(form.Encoding.PEM, form.PrivateFormat.PKCS8, form.NoEncryption())
    known = key.public_key().public_bytes(form.Encoding.PEM, form.PublicFormat.SubjectPublicKeyInfo)
    made: list[Path] = []
    for path, content, mode in ((private, secret, 0o600), (public, known, 0o644)):
        try:
            descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
            made.append(path)
            with os.fdopen(descriptor, "wb") as file:
                file.write(content)
        except OSError as error:
            for half in made:  # both or none
                half.unlink(missing_ok=True)
            if isinstance(error, FileExistsError):
                raise InputError(f"{path}: exists; a key is never overwritten: give another name") from error
            raise InputError(
                f"{path}: cannot be written ({error.strerror}); give a name in a writable place"
            ) from error
    return private, public, VerifyKey(key.public_key().public_bytes_raw(), "").fingerprint


def _library(module: str) -> Any:
    return require_library(f"cryptography.hazmat.primitives.{module}", REQUIREMENT, _PURPOSE)


def _read(path: str | os.PathLike[str]) -> bytes:
    try:
        with Path(path).open("rb") as file:
            text = file.read(_MAX_KEY + 1)
    except OSError as error:
        raise InputError(f"{path}: cannot read the key ({error.strerror}); check the path") from error
    if len(text) > _MAX_KEY:
        raise InputError(f"{path}: too large for a key; give a PEM file, such as 'coview-stream keygen' makes")
    return text


class FileIdentity(NamedTuple):
    """State of a file, which changes when the file is written or replaced."""

    device: int
    inode: int
    size: int
    mtime_ns: int
    ctime_ns: int


class Trust(NamedTuple):
    """Requirement that a file is signed.

    Attributes:
        key: public key of the signer.
        verified: identity of a file whose arrays have already been compared with their hashes; a file with this
            identity is not read again. None always compares.
    """

    key: VerifyKey
    verified: FileIdentity | None = None


def open_plain(path: Path) -> BinaryIO:
    """Open a file for reading; OSError also for a pipe, because opening one waits for a writer."""
    if path.is_fifo():
        raise OSError(errno.ESPIPE, "it is a pipe")
    return path.open("rb")


def file_identity(file: BinaryIO) -> FileIdentity:
    """Return the state of an open file."""
    now = os.fstat(file.fileno())
    return FileIdentity(now.st_dev, now.st_ino, now.st_size, now.st_mtime_ns, now.st_ctime_ns)


def serialized(header: dict[str, Any]) -> bytes:
    """Serialise a header for writing or, without its signature, for signing."""
    return json.dumps(header, separators=(",", ":")).encode()


def sign_header(header: dict[str, Any], sections: dict[str, str], key: SigningKey) -> None:
    """Add the arrays' hashes, by name, to a header, and sign it."""
    metadata = header["__metadata__"]
    metadata |= {"sections": json.dumps(sections), "signer": key.fingerprint}
    metadata["signature"] = key.sign(serialized(header)).hex()


def check_signature(path: Path, header: dict[str, Any], exact: bool, key: VerifyKey) -> None:
    """Verify a header that was read; ``exact``: the file holds the very bytes that we would write for it.

    Raises:
        MapError: it is unsigned, signed by another key, or changed since.
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
    exact = exact and signature.hex() == metadata["signature"]  # no capital digits either
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
    """Compare each array with its signed hash; ValueError if one differs or is missing."""
    sections = json.loads(header["__metadata__"]["sections"])
    names = header.keys() - {"__metadata__"}
    if sections.keys() != names:
        raise ValueError("not every array has a signed hash")
    for name in sorted(names):
        if sha256_of(content(name)) != sections[name]:
            raise ValueError(f"{name} has been changed since it was signed")


def sha256_of(chunks: Iterable[bytes | memoryview]) -> str:
    """Return the sha256 of bytes in chunks."""
    total = hashlib.sha256()
    for chunk in chunks:
        total.update(chunk)
    return total.hexdigest()
