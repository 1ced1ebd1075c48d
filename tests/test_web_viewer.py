"""A run watched in a browser while it is on: a real Chromium, without a display, at the recorder's page."""

import os
import subprocess
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
from conftest import ROOT
from live_bus import HALF, RUN, Bus, free_port
from matplotlib.image import imread
from playwright.sync_api import ConsoleMessage, Page, sync_playwright

from can_bus.hub import Hub

WITH_BROWSER = ROOT / "tools" / "with_browser"
NOT_TO_BE_HAD = 125
FLAGS = [
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-quic",
    "--disable-sync",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--no-first-run",
    "--use-angle=swiftshader",  # WebGL without a graphics card
]
SIZE = {"width": 1600, "height": 1000}

ELSEWHERE = {
    "api.github.com",  # is there a newer version?
    "app.rerun.io",  # examples
    "fifteen-thirtyeight.rerun.io",
    "fonts.googleapis.com",
    "tel.rerun.io",  # telemetry
}
"""Hosts that Rerun's page asks, and that the policy of ours keeps it from."""

VIEWS = (
    "Glucose [mg/dL]",
    "Insulin: commanded against delivered [U/h, U]",
    "Pramlintide: commanded against delivered [µg/h, µg]",
    "Alarms, injected faults, states",
    "What happened",
    "Frames, device's bus",
    "Frames per step",  # in a tab of its own
)

INK = {
    "CGM": ((180, 1050), (60, 270), (64, 156, 255)),
    "true glucose": ((180, 1050), (60, 270), (150, 150, 150)),
    "insulin commanded": ((200, 1050), (330, 450), (64, 156, 255)),
    "pramlintide commanded": ((200, 1050), (505, 625), (38, 178, 172)),
    "states": ((430, 1050), (700, 840), (125, 205, 130)),
    "what happened": ((1120, 1400), (98, 125), (88, 190, 96)),
}
"""Where in the picture which colour has to be: columns, rows, red, green and blue."""


@pytest.fixture(scope="module")
def browser() -> str:
    """Path of a Chromium; its absence is an error where everything must run."""
    found = subprocess.run(
        [WITH_BROWSER, "printenv", "PUMPBENCH_BROWSER"], capture_output=True, text=True, timeout=280, check=False
    )
    if found.returncode == NOT_TO_BE_HAD and not os.environ.get("CI"):
        pytest.skip(found.stderr.strip())
    assert found.returncode == 0, found.stderr
    return found.stdout.strip()


@pytest.fixture
def bus(runs: Path) -> Iterator[Bus]:
    with Hub(f"unix:{runs}/bus.sock") as hub, hub.local_link() as link:
        yield Bus(runs, hub, link)


class Errors:
    """What a page complains of, but for what it is kept from."""

    def __init__(self, page: Page, ports: tuple[int, int]) -> None:
        self.found: list[str] = []
        self.refused: set[str] = set()
        self.reached: set[str] = set()
        own = {f"127.0.0.1:{port}" for port in ports}
        page.on("console", self._console)
        page.on("pageerror", lambda error: self.found.append(str(error)))
        page.on("response", lambda answer: self.reached.add(urlsplit(answer.url).netloc))
        self.own = own

    def _console(self, message: ConsoleMessage) -> None:
        if message.type != "error":
            return
        hosts = {host for host in ELSEWHERE if f"https://{host}/" in message.text}
        if "Content Security Policy" in message.text and hosts:
            self.refused |= hosts
        elif not message.text.startswith("TypeError: Failed to fetch"):  # which is what the page makes of that
            self.found.append(message.text)


def ink(picture: Path) -> dict[str, int]:
    """How many pixels of each kind of ink are where they belong."""
    pixels = imread(picture)[..., :3] * 255
    count = {}
    for name, ((left, right), (top, bottom), colour) in INK.items():
        near = np.abs(pixels[top:bottom, left:right] - colour).max(axis=-1) < 24
        count[name] = int(near.sum())
    return count


def state(page: Page) -> str:
    """What Rerun's viewer says of itself: a message of protocol buffers, whose names can be read."""
    if not page.evaluate("typeof _handle !== 'undefined'"):
        return ""
    return bytes(page.evaluate("Array.from(_handle.viewer_state())")).decode(errors="replace")


def test_a_browser_shows_a_run_that_is_on(browser: str, bus: Bus, runs: Path) -> None:
    ports = free_port(), free_port()
    picture = runs / "web.png"
    with bus.recorder("--serve", str(ports[0]), "--web", str(ports[1])) as process, sync_playwright() as playwright:
        assert process.stdout is not None
        lines = [process.stdout.readline(), process.stdout.readline()]
        assert lines[0] == f"live: rerun --connect rerun+http://127.0.0.1:{ports[0]}/proxy\n"
        chromium = playwright.chromium.launch(executable_path=browser, args=FLAGS)
        page = chromium.new_page(viewport=SIZE)
        errors = Errors(page, ports)
        bus.say(HALF)
        page.goto(lines[1].removeprefix("live: ").strip())

        def drawn() -> bool:
            page.wait_for_timeout(250)
            if any(view not in state(page) for view in VIEWS):
                return False
            page.screenshot(path=picture)
            return min(ink(picture).values()) > 20

        bus.until(drawn, "the picture of the first half")
        before = ink(picture)["states"]
        assert "sim_time" in state(page)
        bus.say(RUN[len(HALF) : -200])

        def grown() -> bool:
            page.wait_for_timeout(250)
            page.screenshot(path=picture)
            return ink(picture)["states"] > 1.5 * before

        bus.until(grown, "the picture of more of the run")
        assert errors.found == []
        assert errors.reached == errors.own
        assert "tel.rerun.io" in errors.refused  # so the others would have been told as well
        chromium.close()
        process.terminate()
        assert bus.end(process)[0] == 0
