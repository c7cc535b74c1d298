"""A real browser without a screen and without the internet: Debian's chromium, steered by selenium."""

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
    # Whoever asks for another machine gets no answer, as where there is no internet.
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
)


def missing() -> str:
    """Return what is not installed, empty where all is."""
    lacking = [name for name in ("chromium", "chromedriver") if shutil.which(name) is None]
    return f"no {' and no '.join(lacking)} (apt-get install chromium chromium-driver)" if lacking else ""


@contextmanager
def chromium(width: int = 800, height: int = 600) -> Iterator[webdriver.Chrome]:
    """Start a browser with a window of so many pixels and end it."""
    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium")
    for setting in (*SETTINGS, f"--window-size={width},{height}"):
        options.add_argument(setting)
    options.set_capability("goog:loggingPrefs", {"performance": "ALL"})
    driver = webdriver.Chrome(options=options, service=Service(shutil.which("chromedriver")))
    try:
        yield driver
    finally:
        driver.quit()


def picture(
    driver: webdriver.Chrome, ready: Callable[[np.ndarray], bool], *, patience_s: float = 240.0
) -> tuple[bytes, np.ndarray]:
    """Return the first picture of the page that is ready, else the last: PNG and (height, width, 3) bytes.

    Drawn on the processor the page is slow: a picture of it may take longer than selenium waits.
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
    """Return the addresses that were asked for since the start, or the last call."""
    told = (json.loads(entry["message"])["message"] for entry in driver.get_log("performance"))
    asked = (
        each["params"]["request"]["url"] for each in told if each["method"] == "Network.requestWillBeSent"
    )
    return set(asked)


def share(picture: np.ndarray, rgb: tuple[int, int, int]) -> float:
    """The share of pixels that have a colour's hue, in light and shade, and are not grey."""
    bright = picture / np.maximum(picture.max(axis=-1, keepdims=True), 1)
    return float((np.abs(bright - np.array(rgb) / max(rgb)).max(axis=-1) < 0.12).mean())


def shows_a_snake(picture: np.ndarray) -> bool:
    """Say whether segments with pressure in either chamber are in a picture."""
    return share(picture, PLUS_RGB) > 0.002 and share(picture, MINUS_RGB) > 0.002
