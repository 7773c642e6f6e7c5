"""A headless Chromium, driven by chromedriver over WebDriver's HTTP."""

import json
import shutil
import socket
import subprocess
import urllib.request

import pytest
from sockets import until

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
OPTIONS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-dev-shm-usage",
    "--disable-component-update", "--no-first-run", "--window-size=1280,800",
)  # fmt: skip


class Browser:
    """One window; skips the test where there is no Chromium."""

    def __init__(self, folder):
        driver = shutil.which("chromedriver")
        binary = next(filter(None, map(shutil.which, BROWSERS)), None)
        if driver is None or binary is None:
            pytest.skip("no chromium and chromedriver here (Debian: apt-get install chromium chromium-driver)")
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        self.process = subprocess.Popen(
            [driver, f"--port={self.port}"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        self.session = ""
        try:
            until(self._ready, 20.0)
            chrome = {"binary": binary, "args": [*OPTIONS, f"--user-data-dir={folder}"]}
            wanted = {"goog:chromeOptions": chrome, "goog:loggingPrefs": {"browser": "ALL"}}
            found = self._call("POST", "/session", {"capabilities": {"alwaysMatch": wanted}})
            self.session = f"/session/{found['sessionId']}"
        except BaseException:
            self.close()
            raise

    def open(self, url):
        self._call("POST", f"{self.session}/url", {"url": url})

    def run(self, script, *arguments):
        return self._call("POST", f"{self.session}/execute/sync", {"script": script, "args": list(arguments)})

    def complaints(self):
        """Messages of the console, such as refused resources and errors of scripts."""
        return [entry["message"] for entry in self._call("POST", f"{self.session}/se/log", {"type": "browser"})]

    def close(self):
        if self.session:
            self._call("DELETE", self.session)
        self.process.terminate()
        self.process.wait(10.0)

    def _ready(self):
        try:
            return self._call("GET", "/status")["ready"]
        except OSError:
            return False

    def _call(self, method, path, data=None):
        body = None if data is None else json.dumps(data).encode()
        request = urllib.request.Request(f"http://127.0.0.1:{self.port}{path}", body, method=method)
        with urllib.request.urlopen(request, timeout=60) as answer:
            return json.load(answer)["value"]
