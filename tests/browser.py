"""A real browser for tests of pages: Chromium, driven by ChromeDriver over its HTTP interface.

Needs nothing from Python but its standard library; `missing` says why there is no browser.
"""

from __future__ import annotations

import base64
import json
import os
import shutil
import socket
import subprocess
import tempfile
import time
import urllib.request
from pathlib import Path
from typing import Any

#: A phone, a tablet, a desk, in CSS pixels.
WIDTHS = (390, 800, 1400)

_FLAGS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--hide-scrollbars",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]

#: What a page must not have, told by the page itself.
_LOOK = """
const wide = document.documentElement.scrollWidth, room = document.documentElement.clientWidth;
const found = [];
if (wide > room + 1) {
  const over = [...document.body.querySelectorAll("*")]
    .filter((e) => e.getBoundingClientRect().right > room + 1 && !e.closest("[data-scrolls], pre"))
    .map((e) => e.tagName.toLowerCase() + (e.id ? "#" + e.id : ""));
  found.push(`is ${wide} px wide where there are ${room}: ${over.slice(0, 4).join(", ")}`);
}
for (const e of document.querySelectorAll("img, canvas, svg, iframe")) {
  const box = e.getBoundingClientRect(), style = getComputedStyle(e);
  if (style.display === "none" || style.visibility === "hidden" || e.closest("[hidden]")) continue;
  if (e.closest("details:not([open])") || e.closest("svg svg")) continue;
  const name = e.tagName.toLowerCase() + (e.id ? "#" + e.id : "");
  if (box.height < 1 || box.width < 1) found.push(`${name} is ${box.width} x ${box.height} px`);
  if (e.tagName === "IMG" && !(e.complete && e.naturalWidth)) found.push(`${name} does not load`);
}
return found;
"""


def missing() -> str | None:
    """Return why there is no browser here, or None."""
    for name in ("chromedriver", "chromium"):
        if _program(name) is None:
            return f"needs {name} (CHROME and CHROMEDRIVER name others)"
    return None


def _program(name: str) -> str | None:
    if name == "chromedriver":
        return os.environ.get("CHROMEDRIVER") or shutil.which("chromedriver")
    names = ("chromium", "chromium-browser", "google-chrome", "chrome")
    return os.environ.get("CHROME") or next(filter(None, map(shutil.which, names)), None)


class Browser:
    """A window without a screen.

    Examples
    --------
    >>> with Browser() as window:  # doctest: +SKIP
    ...     window.problems(Path("page.html"), 390)
    """

    def __enter__(self) -> Browser:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        self._profile = tempfile.TemporaryDirectory(prefix="chromium-", ignore_cleanup_errors=True)
        command = [str(_program("chromedriver")), f"--port={port}", "--log-level=OFF"]
        self._driver = subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
        )
        self._address = f"http://127.0.0.1:{port}"
        try:
            self._wait()
            flags = [*_FLAGS, f"--user-data-dir={self._profile.name}"]
            options = {"binary": _program("chromium"), "args": flags}
            wanted = {
                "browserName": "chrome",
                "goog:chromeOptions": options,
                "goog:loggingPrefs": {"browser": "ALL"},
            }
            made = self._ask("POST", "/session", {"capabilities": {"alwaysMatch": wanted}})
            self._address += f"/session/{made['sessionId']}"
        except BaseException:
            self._end()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self._ask("DELETE", "")
        finally:
            self._end()

    def _end(self) -> None:
        self._driver.terminate()
        self._driver.wait(10)
        self._profile.cleanup()

    def _wait(self) -> None:
        for _ in range(100):
            try:
                if self._ask("GET", "/status")["ready"]:
                    return
            except OSError:
                time.sleep(0.1)
        raise TimeoutError("ChromeDriver does not answer")

    def _ask(self, how: str, path: str, data: Any = None) -> Any:
        body = None if data is None else json.dumps(data).encode()
        asked = urllib.request.Request(
            self._address + path, body, {"Content-Type": "application/json"}, method=how
        )
        opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
        with opener.open(asked, timeout=60) as answer:
            return json.loads(answer.read())["value"]

    def command(self, name: str, **values: Any) -> Any:
        """Send a command of the DevTools protocol."""
        return self._ask("POST", "/goog/cdp/execute", {"cmd": name, "params": values})

    def run(self, script: str) -> Any:
        """Return what a script returns in the page."""
        return self._ask("POST", "/execute/sync", {"script": script, "args": []})

    def show(self, page: Path, width: int = 1400, height: int = 900, dark: bool = False) -> None:
        """Open a page in a window of this size."""
        self.command(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=width < 500,
        )
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.command("Emulation.setEmulatedMedia", features=[scheme])
        self._ask("POST", "/url", {"url": page.resolve().as_uri()})

    def messages(self) -> list[str]:
        """Return what the page has complained of since it was asked last."""
        rows = self._ask("POST", "/se/log", {"type": "browser"})
        return [row["message"] for row in rows if row["level"] in ("SEVERE", "WARNING")]

    def problems(self, page: Path, width: int, dark: bool = False) -> list[str]:
        """Return what is wrong with a page: too wide, pictures without height, errors."""
        self.messages()
        self.show(page, width, dark=dark)
        found: list[str] = self.run(_LOOK)
        return found + self.messages()

    def picture(self, path: Path, whole: bool = True) -> None:
        """Save what the window shows, or the whole page, as PNG."""
        options: dict[str, Any] = {"captureBeyondViewport": whole}
        if whole:
            size = self.command("Page.getLayoutMetrics")["cssContentSize"]
            options["clip"] = size | {"scale": 1}
        data = self.command("Page.captureScreenshot", **options)["data"]
        path.write_bytes(base64.b64decode(data))
