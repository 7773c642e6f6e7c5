"""Windows of COPC files, local and by HTTP ranges from a server on this machine."""

import contextlib
import threading
import urllib.request
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest

from coview_stream.cli import main
from coview_stream.clouds import read_cloud
from coview_stream.clouds.fetch import RangeFile, Window, _Redirects, download, fetch_cloud, is_copc
from coview_stream.errors import CloudError, ConfigError
from tests.clouds.copc_file import write_copc

pytestmark = pytest.mark.slow

WINDOW = Window((500_100.0, 5_600_050.0), (500_200.0, 5_600_150.0))


class Handler(SimpleHTTPRequestHandler):
    """Serves a folder, with ranges if ``ranges`` is set, and records the sizes it sent."""

    ranges = True
    sent = []  # noqa: RUF012
    busy = 0

    def log_message(self, *_):
        """Say nothing."""

    def do_GET(self):
        if type(self).busy:
            type(self).busy -= 1
            self.send_error(503)
            return
        path, asked = Path(self.translate_path(self.path)), self.headers.get("Range")
        if asked is None or not self.ranges or not path.is_file():
            super().do_GET()
            return
        begin, end = map(int, asked.removeprefix("bytes=").split("-"))
        raw = path.read_bytes()[begin : end + 1]
        type(self).sent.append(len(raw))
        self.send_response(206 if raw else 416)
        self.send_header("Content-Length", str(len(raw)))
        self.end_headers()
        self.wfile.write(raw)


@pytest.fixture(scope="module")
def points():
    """Return points (N, 3) of a site in UTM coordinates."""
    rng = np.random.default_rng(4)
    return rng.uniform([500_000.0, 5_600_000.0, 100.0], [500_400.0, 5_600_300.0, 130.0], (20_000, 3))


@pytest.fixture(scope="module")
def site(points, tmp_path_factory):
    path = tmp_path_factory.mktemp("copc") / "site.copc.laz"
    assert write_copc(path, points) > 10
    return path


@contextlib.contextmanager
def served_folder(folder):
    Handler.ranges, Handler.sent, Handler.busy = True, [], 0
    served = ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, directory=str(folder)))
    threading.Thread(target=served.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{served.server_address[1]}"
    finally:
        served.shutdown()
        served.server_close()


@pytest.fixture
def server(site):
    with served_folder(site.parent) as address:
        yield address


def inside(points):
    return points[((points[:, :2] >= WINDOW.low) & (points[:, :2] <= WINDOW.high)).all(axis=1)]


def test_window_of_a_file_has_the_points_in_it_and_the_reference_system(site, points, tmp_path):
    assert is_copc(site)
    path, fetched = fetch_cloud(site, tmp_path, WINDOW)
    cloud = read_cloud(path)
    assert fetched.points == len(cloud) == len(inside(points))
    np.testing.assert_allclose(
        np.sort(cloud.map_points(), axis=0), np.sort(inside(points), axis=0), atol=0.03
    )  # float32 near an origin
    assert cloud.crs is not None
    assert "32N" in cloud.crs
    assert len(read_cloud(site)) == len(points)  # the whole of it, as any LAZ file


def test_of_a_web_server_only_parts_are_fetched(server, site, points, tmp_path):
    Handler.busy = 1
    path, fetched = fetch_cloud(f"{server}/site.copc.laz", tmp_path, WINDOW)
    assert len(read_cloud(path)) == fetched.points == len(inside(points))
    assert fetched.received == sum(Handler.sent)
    assert fetched.requests == len(Handler.sent)


def test_small_window_takes_few_bytes(tmp_path):
    """In a file this small most bytes come from rounding requests up to a block; the bound allows for them."""
    rng = np.random.default_rng(5)
    write_copc(tmp_path / "wide.copc.laz", rng.uniform([0.0, 0.0, 0.0], [900.0, 900.0, 40.0], (60_000, 3)), levels=5)
    with served_folder(tmp_path) as address:
        fetch_cloud(f"{address}/wide.copc.laz", tmp_path, Window((10.0, 10.0), (20.0, 20.0)))
    beside = 65_536 * len(Handler.sent)
    assert sum(Handler.sent) - beside < 0.3 * (tmp_path / "wide.copc.laz").stat().st_size


def test_whole_files_are_downloaded(server, site, tmp_path):
    path, _ = fetch_cloud(f"{server}/site.copc.laz", tmp_path)
    assert path.read_bytes() == site.read_bytes()
    assert path.name == "site.copc.laz"
    other, _ = fetch_cloud(f"{server}/site.copc.laz", tmp_path)
    assert other != path


def test_servers_and_files_that_cannot_be_used_are_named(server, site, tmp_path, no_pauses):
    with pytest.raises(CloudError, match=r"none\.laz: the server answers 404"):
        fetch_cloud(f"{server}/none.laz", tmp_path)
    with pytest.raises(CloudError, match="cannot be reached"):
        RangeFile("http://127.0.0.1:1/x.laz").read(10)
    with pytest.raises(CloudError, match="not an http"):
        download("ftp://127.0.0.1/x.laz", tmp_path / "x")
    Handler.ranges = False
    with pytest.raises(CloudError, match="serves no parts"):
        fetch_cloud(f"{server}/site.copc.laz", tmp_path, WINDOW)
    np.save(tmp_path / "cloud.npy", np.zeros((3, 3)))
    with pytest.raises(CloudError, match="not a COPC file"):
        fetch_cloud(tmp_path / "cloud.npy", tmp_path, WINDOW)
    with pytest.raises(CloudError, match="the window is beside it"):
        fetch_cloud(site, tmp_path, Window((0.0, 0.0), (10.0, 10.0)))
    raw = bytearray(site.read_bytes())
    raw[len(raw) // 3 : len(raw) // 2] = b"\xff" * (len(raw) // 2 - len(raw) // 3)
    (tmp_path / "broken.copc.laz").write_bytes(raw)
    with pytest.raises(CloudError, match="broken"):
        fetch_cloud(tmp_path / "broken.copc.laz", tmp_path, WINDOW)
    assert not list(tmp_path.glob("*.las"))


@pytest.mark.parametrize(
    ("at", "to", "followed"),
    [
        ("https://a/x", "https://b/x", True), ("http://a/x", "https://a/x", True), ("http://a/x", "http://b/x", True),
        ("https://a/x", "http://a/x", False), ("http://a/x", "ftp://a/x", False), ("https://a/x", "file:///x", False),
        ("http://a/x", "http://169.254.169.254/", False), ("http://8.8.8.8/", "http://2852039166/x", False),
        ("http://a/x", "http://[::ffff:127.0.0.1]/", False), ("http://10.0.0.1/", "http://localhost:80/", False),
        ("http://8.8.8.8/", "http://10.0.0.1/", False), ("http://10.0.0.1/", "http://[fe80::1]/", False),
        ("http://127.0.0.1/", "http://localhost:80/", True), ("http://10.0.0.1/", "http://192.168.0.1/", True),
        ("http://169.254.1.1/", "http://8.8.8.8/", True), ("http://0.0.0.0/", "http://169.254.1.1/", True),
    ],
)  # fmt: skip
def test_server_leads_to_web_servers_that_are_as_far_and_never_out_of_https(at, to, followed):
    request = urllib.request.Request(at)
    with contextlib.nullcontext() if followed else pytest.raises(ValueError, match=r"after http|nearer"):
        assert _Redirects().redirect_request(request, None, 302, "Found", {}, to)


@pytest.mark.parametrize("text", ["1,2,3", "a,b,c,d", "5,5,1,1", "0,0,nan,1", "0,0,inf,1", ""])
def test_windows_without_area_are_refused(text):
    with pytest.raises(ConfigError, match="window"):
        Window.parse(text)


def test_build_takes_addresses_and_windows(server, tmp_path, capsys):
    output = tmp_path / "site.coview"
    args = ["build", f"{server}/site.copc.laz", "--window", str(WINDOW), "-o", str(output), "--no-learned"]
    assert main([*args, "--block-size", "10", "--radius", "20"]) == 0
    said = capsys.readouterr()
    assert "points in the window" in said.err
    assert "EPSG:32632" in said.out
    assert main(["build", f"{server}/nothing.laz", "-o", str(tmp_path / "b.coview")]) == 2
    assert "404" in capsys.readouterr().err
