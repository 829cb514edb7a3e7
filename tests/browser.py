"""A headless Chromium for tests of what a browser shows."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

CHROMIUM = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
"""WebGL without a graphics card."""
HARMLESS = ("THREE.Clock",)
"""What viser's own libraries warn of."""


@dataclass
class Visit:
    """A page that is open, and what it complained about."""

    page: Any
    complaints: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)
    """To anything but this machine."""

    def picture(self) -> np.ndarray:
        """What is on the screen, (h, w, 3) uint8."""
        import io

        from PIL import Image

        return np.asarray(Image.open(io.BytesIO(self.page.screenshot())).convert("RGB"))


@contextmanager
def browsing(url: str, *, width: int = 640, height: int = 480) -> Iterator[Visit]:
    """Open a page; the test is skipped where there is no browser."""
    driver = pytest.importorskip("playwright.sync_api", reason="needs playwright: pip install 'graspmatch[dev]'")
    found = next((path for name in CHROMIUM if (path := shutil.which(name))), None)
    if found is None:
        pytest.skip(f"needs a browser: none of {', '.join(CHROMIUM)} is installed")
    with driver.sync_playwright() as play:
        browser = play.chromium.launch(executable_path=found, args=FLAGS)
        page = browser.new_page(viewport={"width": width, "height": height})
        visit = Visit(page)
        page.on("console", lambda said: _note(visit, said.type, said.text))
        page.on("pageerror", lambda error: visit.complaints.append(str(error)))
        page.on("request", lambda request: _note_request(visit, request.url))
        page.goto(url)
        yield visit
        browser.close()


def _note(visit: Visit, kind: str, text: str) -> None:
    if kind in ("error", "warning") and not any(word in text for word in HARMLESS):
        visit.complaints.append(f"{kind}: {text}")


def _note_request(visit: Visit, url: str) -> None:
    if not url.startswith(("http://127.0.0.1", "ws://127.0.0.1", "file:", "data:", "blob:")):
        visit.requests.append(url)
