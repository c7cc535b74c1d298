"""Headless browser without internet access: Debian's chromium, controlled by selenium."""

from __future__ import annotations

import io
import json
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
from matplotlib.image import imread
from selenium import webdriver
from selenium.common.exceptions import TimeoutException
from selenium.webdriver.chrome.service import Service

from srs_twin.viewing.plots.style import MINUS_RGB, PLUS_RGB

SETTINGS = (
    "--headless=new",
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-background-networking",
    "--no-proxy-server",
    # Requests to other machines fail, as without internet access.
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
)


def missing() -> str:
    """Return a message about missing programs, or an empty text."""
    absent = [
        name for name in ("chromium", "chromedriver") if shutil.which(name) is None
    ]
    return (
        f"no {' and no '.join(absent)} (apt-get install chromium chromium-driver)"
        if absent
        else ""
    )


@contextmanager
def chromium(width: int = 800, height: int = 600) -> Iterator[webdriver.Chrome]:
    """Run a browser with a window of a size in pixels for a `with` block."""
    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium")
    for setting in (*SETTINGS, f"--window-size={width},{height}"):
        options.add_argument(setting)
    options.set_capability("goog:loggingPrefs", {"performance": "ALL"})
    driver = webdriver.Chrome(
        options=options, service=Service(shutil.which("chromedriver"))
    )
    try:
        yield driver
    finally:
        driver.quit()


def picture(
    driver: webdriver.Chrome,
    ready: Callable[[np.ndarray], bool],
    *,
    patience_s: float = 240.0,
) -> tuple[bytes, np.ndarray]:
    """Return a picture of the page when it is ready or time is up: PNG, and array (height, width, 3).

    Without a GPU the page is slow, and a screenshot may exceed the time limit of
    selenium.
    """
    deadline = time.monotonic() + patience_s
    while True:
        try:
            png = driver.get_screenshot_as_png()
        except TimeoutException:
            if time.monotonic() > deadline:
                raise
            continue
        shown = (imread(io.BytesIO(png))[..., :3] * 255).astype(np.uint8)
        if ready(shown) or time.monotonic() > deadline:
            return png, shown
        time.sleep(0.5)


def requested(driver: webdriver.Chrome) -> set[str]:
    """Return the URLs that were requested since the start or the last call."""
    messages = (
        json.loads(entry["message"])["message"]
        for entry in driver.get_log("performance")
    )
    requests = (
        entry for entry in messages if entry["method"] == "Network.requestWillBeSent"
    )
    return {entry["params"]["request"]["url"] for entry in requests}


def fraction(picture: np.ndarray, rgb: tuple[int, int, int]) -> float:
    """Return the fraction of pixels with the hue of a colour at any brightness."""
    bright = picture / np.maximum(picture.max(axis=-1, keepdims=True), 1)
    return float((np.abs(bright - np.array(rgb) / max(rgb)).max(axis=-1) < 0.12).mean())


def shows_a_snake(picture: np.ndarray) -> bool:
    """Return whether a picture shows segments with pressure in either chamber."""
    return fraction(picture, PLUS_RGB) > 0.002 and fraction(picture, MINUS_RGB) > 0.002
