"""Targets that take a whole thing, change it as the input's bytes draw, and use it as a node does.

A map or a site keeps its right checksums, which an attacker would have as well: bytes that were changed at random never
come that far. A web server answers in one of 25 wrong ways, and ghosts join a fleet. No bytes change nothing: such an
input must be accepted, and what the others need is compared with it.
"""

from __future__ import annotations

import contextlib
import functools
import json
import math
import random
import shutil
import socket
import threading
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt

from coview_stream.basemap import file_format
from coview_stream.basemap.basemap import BaseMap
from coview_stream.basemap.site import fetch
from coview_stream.basemap.site.convert import split
from coview_stream.basemap.site.layers import decode, encode
from coview_stream.basemap.site.manifest import Manifest
from coview_stream.basemap.site.store import TileStore, layer_path
from coview_stream.basemap.site.working_file import working_file
from coview_stream.clouds import fetch as web
from coview_stream.config import LocalizerConfig
from coview_stream.errors import CoViewError
from coview_stream.geometry.transforms import pose_from
from coview_stream.localization.localizer import Localizer
from coview_stream.messages.types import Sample
from coview_stream.stream.node.fleet import Fleet
from coview_stream.stream.node.last_place import LastPlace
from coview_stream.stream.transport.keys import NodeIdentity
from coview_stream.stream.transport.memory_transport import MemoryTransport

_ODD: dict[str, tuple[Any, ...]] = {
    "f": (math.nan, math.inf, -math.inf, 1e30, -1e7, 65504.0, 1e-40, 0.0, -1.0, 3000.0),
    "i": (0, -1, 1, 127, -128, 32767, -32768, 2**31 - 1, -(2**31), 2**40, -(2**63)),
    "u": (0, 1, 255, 65535),
}
_NUMBERS: tuple[Any, ...] = (  # of JSON
    0, -1, 1, 2, 3, 4096, 1 << 20, 1 << 31, 1 << 40, 0.001, 0.5, 1e9, 1e300, True, None, "x", "\ud800", [], {},
)  # fmt: skip


def _points() -> npt.NDArray[np.float32]:
    rng = np.random.default_rng(3)
    ground = np.c_[rng.uniform(-9, 9, (5000, 2)), rng.normal(0, 0.01, 5000)]
    walls = [
        np.c_[rng.uniform(-8, 8, 1000), np.full(1000, 6.0), rng.uniform(0, 5, 1000)],
        np.c_[np.full(1000, -6.0), rng.uniform(-8, 4, 1000), rng.uniform(0, 7, 1000)],
        np.c_[rng.uniform(2, 5, (600, 2)), np.full(600, 3.0)],
    ]
    return np.asarray(np.concatenate([ground, *walls]), dtype=np.float32)


@functools.cache
def _built() -> BaseMap:
    return BaseMap.build(_points(), learned=False)


def _use(base_map: BaseMap) -> object:
    """Use a map as a node does: summary, look-ups, a search, and two frames."""
    if base_map.learned is not None:
        base_map.learned.check()
    base_map.surveyed(np.zeros((1, 2)))
    _ = str(base_map.summary), base_map.station_grid, base_map.field, base_map.bounds
    localizer, seen = Localizer(base_map, LocalizerConfig(reloc="coview")), _points()[::2]
    for x in (0.0, 2.5):
        localizer.step(seen - np.array([x, 0.0, 1.7], np.float32), pose_from(np.eye(3), [x, 0.0, 0.0]), 100.0 + x)
    return base_map.crop(np.zeros(3), 5.0)


def _array(rng: random.Random, array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return an array with other values, rows or shape."""
    out = np.array(array)
    if not out.size:
        return np.zeros((3, *out.shape[1:]), out.dtype)
    kind = rng.randrange(9)
    flat = out.reshape(-1)
    rows = np.random.default_rng(rng.getrandbits(32))
    some = rows.integers(flat.size, size=rng.choice((1, 3, 50)))
    kinds, odd = out.dtype.kind, _ODD[out.dtype.kind]
    if kinds != "f":
        limits = np.iinfo(out.dtype)
        odd = tuple(value for value in odd if limits.min <= value <= limits.max)
    with np.errstate(all="ignore"):
        if kind == 0:
            flat[some] = rng.choice(odd)
        elif kind == 1:
            flat[:] = rng.choice(odd)
        elif kind == 2:
            flat[some] = flat[rows.integers(flat.size, size=len(some))]
        elif kind == 3:
            out = out[rows.integers(len(out), size=len(out))]
        elif kind == 4:
            out = out[: rng.randrange(len(out) + 1)]
        elif kind == 5:
            out = np.concatenate([out, out[: rng.randrange(len(out) + 1)]])
        elif kind == 6:
            flat[some] += np.asarray(rng.choice((1, 100, 3000))).astype(out.dtype)
        elif kind == 7:
            flat[:] = np.frombuffer(rng.randbytes(flat.nbytes), out.dtype)
        else:
            out = np.moveaxis(out, 0, -1) if out.ndim > 1 else out[::-1]
    return np.ascontiguousarray(out)


def _plain(rng: random.Random, data: Any) -> Any:
    """Return plain data with one value changed, at any depth."""
    if isinstance(data, dict | list) and data and rng.random() < 0.9:
        data = data.copy()
        at = rng.choice(list(data)) if isinstance(data, dict) else rng.randrange(len(data))
        data[at] = _plain(rng, data[at])
        return data
    if isinstance(data, int | float) and not isinstance(data, bool) and rng.random() < 0.5:
        return data * rng.choice((2, 4, 10, 100, 0.1, -1) if isinstance(data, float) else (2, 4, 16, 1000, -1))
    return rng.choice(_NUMBERS)


def arrays(folder: Path, data: bytes) -> object:
    """Change arrays and parameters of a map file."""
    built, rng, path = _built(), random.Random(data), folder / "wrong.coview"
    changed, parameters = dict(built.arrays), json.loads(json.dumps(built.parameters))
    for _ in range(rng.choice((1, 1, 2, 3)) if data else 0):
        name = rng.choice(sorted(changed))
        if rng.random() < 0.3:
            parameters = _plain(rng, parameters)
        elif rng.random() < 0.05:
            del changed[name]
        else:
            # rows of all arrays of the same length, so that they fit each other
            rows, again = len(changed[name]), rng.randbytes(8)
            together = rng.random() < 0.5
            for other in sorted(changed) if together else [name]:
                if len(changed[other]) == rows:
                    changed[other] = _array(random.Random(again) if together else rng, changed[other])
    try:
        file_format.save(path, changed, parameters)
    except (KeyError, ValueError):
        return None  # cannot be a file
    return _use(BaseMap.load(path))


@functools.cache
def _site(folder: Path) -> tuple[Path, Manifest]:
    built = _built()
    split(built.arrays, built.parameters, folder / "site")
    return folder / "site", Manifest.load(folder / "site")


def site(folder: Path, data: bytes) -> object:
    """Change a site's manifest, or layers with their hashes; make its working file, and use the map."""
    place, manifest = _site(folder)
    rng, store = random.Random(data), TileStore(place)
    plain = json.loads(manifest.to_bytes())
    for _ in range(rng.choice((1, 1, 2)) if data else 0):
        if rng.random() < 0.5:
            plain = _plain(rng, plain)
            continue
        with contextlib.suppress(TypeError, KeyError, IndexError, ValueError, CoViewError):
            tile = rng.choice(plain["tiles"])
            name = rng.choice(sorted(tile["layers"]))
            entry = tile["layers"][name]
            layer = decode(store.get(entry["sha256"], entry["bytes"]), "layer")
            part = rng.choice(sorted(layer))
            content = encode(dict(layer) | {part: _array(rng, layer[part])})
            tile["layers"][name] = {"sha256": store.put(content), "bytes": len(content)}
            if rng.random() < 0.5 and part in ("levels", "steps"):
                tile["points" if part == "levels" else "stations"] = rng.choice((0, 1, 1 << 20, 1 << 24))
    try:
        (place / "manifest.json").write_text(json.dumps(plain, sort_keys=True))
        made = working_file(place, progress=False)
        try:
            return _use(BaseMap.load(place))
        finally:
            made.unlink(missing_ok=True)
    finally:
        store.prune(manifest.hashes())


_OK, _TO = b"HTTP/1.1 200 OK\r\n", b"HTTP/1.1 302 Found\r\nContent-Length: 0\r\nLocation: "
_PLACES = (b"http://a..b/", b"http://[1/", b"file:///etc/passwd", b"http://127.0.0.1:x/", b"//", b"\x00")
_CHUNKED = _OK + b"Transfer-Encoding: chunked\r\n\r\n"


def _lies(right: bytes, rest: bytes, rng: random.Random) -> dict[str, bytes]:
    """Return answers in place of ``right``, by the way in which they are wrong; ``rest`` is any bytes."""
    head = _OK + b"Content-Length: %d\r\n\r\n" % len(right)
    spoilt = bytearray(right)
    for _ in range(3):
        spoilt[rng.randrange(len(spoilt))] = rng.randrange(256)
    return {
        "chunk breaks off": _CHUNKED + b"400\r\n" + rest,
        "chunk has no size": _CHUNKED + b"xyz\r\n" + rest,
        "chunk of any size": _CHUNKED + b"ffffffffffffffffffff\r\n" + right,
        "chunk of negative size": _CHUNKED + b"-5\r\n" + right,
        "body breaks off": head + right[: len(right) // 2],
        "length is none": _OK + "Content-Length: ²\r\n\r\n".encode("latin-1") + rest,
        "length is negative": _OK + b"Content-Length: -1\r\n\r\n" + rest,
        "length is huge": _OK + b"Content-Length: 99999999999999999999\r\n\r\n" + right,
        "two lengths": _OK + b"Content-Length: 5\r\nContent-Length: 9\r\n\r\n" + right,
        "nothing": b"",
        "no status": rest,
        "status of four digits": b"HTTP/1.1 2000 OK\r\n\r\n" + right,
        "endless information": b"HTTP/1.1 100 Continue\r\n\r\n" * 5000,
        "endless header": _OK + b"X: " + b"x" * 100_000 + b"\r\n\r\n",
        "many headers": _OK + b"X: y\r\n" * 5000 + b"\r\n" + right,
        "another place": _TO + rng.choice(_PLACES) + b"\r\n\r\n",
        "itself again": _TO + b"/manifest.json\r\n\r\n",
        "not changed": b"HTTP/1.1 304 Not Modified\r\n\r\n",
        "page": _OK + b"\r\n<html>maintenance</html>",
        "spoilt": _OK + b"Content-Length: %d\r\n\r\n" % len(right) + spoilt,
        "any bytes": _OK + b"\r\n" + rest,
        "any head": rest + b"\r\n\r\n" + right,
        "compressed": _OK + b"Content-Encoding: gzip\r\n\r\n" + rest,
        "too long": _OK + b"\r\n" + right + rest * 100,
        "drips": head[:-1],
    }


class _Liar:
    """A web server on this machine that sends the bytes it is told to anybody who asks."""

    def __init__(self) -> None:
        self.answer: Callable[[bytes], bytes] = lambda path: b""
        self._socket = socket.create_server(("127.0.0.1", 0))
        self.address = f"http://127.0.0.1:{self._socket.getsockname()[1]}"
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self) -> None:
        while True:
            connection, _ = self._socket.accept()
            with contextlib.suppress(OSError, IndexError), connection:
                connection.settimeout(1.0)
                connection.sendall(self.answer(connection.recv(65536).split()[1]))


@functools.cache
def _liar() -> _Liar:
    web._TIMEOUT, web._WAIT, fetch._WAIT, fetch._PATIENCE = 0.5, 0.0, 0.0, 0.5
    return _Liar()


def server(folder: Path, data: bytes) -> object:
    """Fetch a site of a server that lies about the manifest or a layer; the copy from before must be found whole."""
    place, manifest = _site(folder)
    liar, rng, right = _liar(), random.Random(data), TileStore(place)
    raw = {b"/manifest.json": manifest.to_bytes()}
    raw |= {f"/{layer_path(sha)}".encode(): right.path(sha).read_bytes() for sha in manifest.hashes()}
    wrong = rng.choice(sorted(raw)) if data else b""

    def answer(path: bytes) -> bytes:
        if path == wrong:
            lies = _lies(raw[path], data, rng)
            return rng.choice(list(lies.values()))
        return _OK + b"Content-Length: %d\r\n\r\n" % len(raw[path]) + raw[path]

    liar.answer = answer
    mirror = fetch.Mirror(fetch.WebSource(liar.address))
    shutil.rmtree(mirror.directory, ignore_errors=True)
    if rng.random() < 0.5 and data:
        shutil.copytree(place, mirror.directory)
    try:
        there = mirror.open()
    except CoViewError:
        if mirror.directory.exists() and (mirror.directory / "manifest.json").exists() and wrong != b"/manifest.json":
            raise AssertionError("a good copy is not used") from None
        raise
    if (found := Manifest.load(there)) != manifest and wrong != b"/manifest.json":
        raise AssertionError("another state is opened")
    if missing := [sha for sha in found.hashes() if not TileStore(there).path(sha).is_file()]:
        raise AssertionError(f"{len(missing)} layers are missing")
    return there


class _Endpoints(SimpleNamespace):
    """A robot's endpoints, as far as a fleet knows them."""

    def begin_serving(self) -> None:
        self.serving = True

    def end_serving(self) -> None:
        self.serving = False


def _endpoints() -> Any:
    session = SimpleNamespace(
        site_sha256="ab" * 32, offer=lambda place: True, reset=lambda forget: None,
        last_place=lambda: LastPlace("ab" * 32, T_map_odom=np.eye(4)),
    )  # fmt: skip
    return _Endpoints(session=session, serving=False)


def ghosts(folder: Path, data: bytes) -> object:
    """Let ghosts hold tokens and tell places beside two nodes of a fleet; all robots have one of the two afterwards."""
    rng, net, robots = random.Random(data), MemoryTransport(), [f"r{k}" for k in range(8)]
    fleets = [Fleet("coview/fleet/f", name, {robot: _endpoints() for robot in robots}, net) for name in ("a", "b")]
    names = [f"ghost{k}" for k in range(rng.choice((1, 3, 200)))] if data else []
    names += ["a ", "A", "\x1b[2J", "é" * 300, "\n"][: rng.randrange(6)] if data else []
    held: set[str] = set()

    def turn(real: bool = True) -> None:
        for fleet in fleets if real else ():
            fleet.tell()
            for robot in robots:
                if fleet._endpoints[robot].serving:
                    status = json.dumps({"node": NodeIdentity(fleet.node).to_json()}).encode()
                    net.publish(Sample(f"coview/{robot}/out/status", status, "application/json"))
        for fleet in fleets:
            fleet.look()

    for at in range(60):
        for name in [rng.choice(names) for _ in range(rng.randrange(4))] if names else []:
            key = f"coview/fleet/f/nodes/{name}"
            with contextlib.suppress(CoViewError):
                (net.withdraw if name in held else net.announce)(key)
                held ^= {name}
            place = LastPlace("ab" * 32, T_map_odom=np.eye(4)).to_message()
            told = _plain(rng, {rng.choice(robots): place}) if rng.random() < 0.5 else rng.choice((data, {}, [], None))
            payload = told if isinstance(told, bytes) else json.dumps(told).encode()
            with contextlib.suppress(CoViewError):
                net.publish(Sample(f"coview/fleet/f/places/{name}", payload, "application/json"))
        turn(at % 10 == 0)
    for name in held:
        net.withdraw(f"coview/fleet/f/nodes/{name}")
    for at in range(20):
        turn(at % 10 == 0)
    for robot in robots:
        if (number := sum(fleet._endpoints[robot].serving for fleet in fleets)) != 1:
            raise AssertionError(f"{robot} has {number} nodes")
    return held


TARGETS: dict[str, Callable[[Path, bytes], object]] = {
    "arrays": arrays, "site": site, "server": server, "ghosts": ghosts,
}  # fmt: skip
