"""The evidence page in a real browser: from a file, without a network, with every picture, in print and in the dark."""

import io
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT
from matplotlib.image import imread
from playwright.sync_api import Browser, Page, sync_playwright
from pumpbench import bench
from pumpbench.evidence import page as evidence
from pumpbench.faults import drop

NOT_TO_BE_HAD = 125


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """The Chromium of tools/with_browser; it may be missing anywhere but in CI."""
    command = [ROOT / "tools" / "with_browser", "--", "sh", "-c", 'printf %s "$PUMPBENCH_BROWSER"']
    found = subprocess.run(command, capture_output=True, text=True, timeout=280, check=False)
    if found.returncode == NOT_TO_BE_HAD and not os.environ.get("CI"):
        pytest.skip(found.stderr.strip())
    assert found.returncode == 0, found.stderr
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=found.stdout, args=["--no-sandbox"])
        yield chromium
        chromium.close()


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A page of two runs."""
    place = tmp_path_factory.mktemp("evidence")
    bench.run(strategy="s2", hours=6, out=place / "clean")
    bench.run(strategy="s2", hours=6, faults=[drop("CGM_Reading", start="02:00", end="03:00")], out=place / "dropped")
    evidence.write(evidence.collect([place / "clean", place / "dropped"]), place / "report.html")
    return place / "report.html"


class Visit:
    """The page opened from its file, and what the browser had to say about it."""

    def __init__(self, browser: Browser, file: Path, **how: object) -> None:
        self.page: Page = browser.new_page(viewport={"width": 1280, "height": 900}, **how)  # type: ignore[arg-type]
        self.said: list[str] = []
        self.requests: list[str] = []
        self.refused: list[str | None] = []
        self.page.on("console", lambda message: self.said.append(message.text))
        self.page.on("pageerror", lambda error: self.said.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.on("requestfailed", lambda request: self.refused.append(request.failure))
        self.page.goto(file.as_uri())

    def pixels(self) -> np.ndarray:
        """What is seen, as RGB from 0 to 1."""
        return np.asarray(imread(io.BytesIO(self.page.screenshot()), format="png"))[..., :3]


def test_it_stands_alone(browser: Browser, file: Path) -> None:
    visit = Visit(browser, file)
    assert visit.page.evaluate("[...document.images].map(image => image.naturalWidth)") == [1600] * 3
    assert [url for url in visit.requests if not url.startswith("data:")] == [file.as_uri()]
    assert visit.said == []
    assert visit.page.locator("h2").all_text_contents()[:3] == ["Runs", "Compared", "Hazards"]
    assert visit.page.get_by_role("img", name="Close-up from d0 01:00").count() == 1
    assert visit.page.get_by_role("rowheader", name="Run 2").count() == 2
    visit.page.get_by_role("navigation").get_by_role("link", name="Run 2").click()
    assert visit.page.get_by_role("heading", name="Run 2:").bounding_box()["y"] < 100  # type: ignore[index]


def test_scripts_and_pictures_from_elsewhere_are_refused(browser: Browser, file: Path, tmp_path: Path) -> None:
    """What would get past the escaping still does nothing: the page forbids it."""
    evil = tmp_path / "evil.html"
    body = '<img src="https://example.invalid/x.png"><script>document.title = "taken"</script>'
    evil.write_text(file.read_text(encoding="utf-8").replace("<main>", f"<main>{body}"), encoding="utf-8")
    visit = Visit(browser, evil)
    assert visit.page.title().startswith("pumpbench evidence")
    assert visit.refused == ["csp"]
    assert len([text for text in visit.said if "Content Security Policy" in text]) == 2


def test_nothing_is_cut_off_on_a_narrow_screen(browser: Browser, file: Path) -> None:
    visit = Visit(browser, file)
    visit.page.set_viewport_size({"width": 420, "height": 900})
    assert visit.page.evaluate("document.documentElement.scrollWidth") == 420


@pytest.mark.parametrize(("scheme", "dark"), [("light", False), ("dark", True)])
def test_it_follows_the_colour_scheme(browser: Browser, file: Path, scheme: str, dark: bool) -> None:
    pixels = Visit(browser, file, color_scheme=scheme).pixels()
    ground = np.median(pixels.reshape(-1, 3), axis=0)
    assert (ground.max() < 0.2) == dark
    assert np.abs(pixels - ground).max() > 0.6  # there is something on it


def test_in_print_everything_is_unfolded_and_black_on_white(browser: Browser, file: Path, tmp_path: Path) -> None:
    folded = tmp_path / "folded.html"
    folded.write_text(file.read_text(encoding="utf-8").replace("<details open>", "<details>"), encoding="utf-8")
    visit = Visit(browser, folded, color_scheme="dark")
    event = visit.page.get_by_text("Drop CGM_Reading for 60 min", exact=True)
    assert not event.is_visible()
    visit.page.emulate_media(media="print")
    assert event.is_visible()
    assert np.median(visit.pixels()) > 0.95
