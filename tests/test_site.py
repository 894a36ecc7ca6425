"""The documentation site: built strictly, whole in itself, and as a reader's browser shows it."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urldefrag, urljoin

import pytest
import typer
from playwright.sync_api import Page, TimeoutError

import dnnmso_mj
from dnnmso_mj.cli import app
from dnnmso_mj.loading import scenario_schema
from tests.browser import chromium, needs_chromium, served

ROOT = Path(__file__).parents[1]
ASKED_FOR = {"script": "src", "img": "src", "iframe": "src", "link": "href", "source": "src"}


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet"]
    done = subprocess.run(
        [*command, "--site-dir", folder], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


class Html(HTMLParser):
    """A page's anchors, what it links to, and what it asks for by itself."""

    def __init__(self, file: Path) -> None:
        super().__init__()
        self.ids: set[str] = set()
        self.links: list[str] = []
        self.asks: list[str] = []
        self.feed(file.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value for name, value in attrs if value is not None}
        self.ids |= {given[name] for name in ("id", "name") if name in given}
        if tag == "a" and "href" in given:
            self.links.append(given["href"])
        if ASKED_FOR.get(tag, "") in given:
            self.asks.append(given[ASKED_FOR[tag]])


@pytest.fixture(scope="module")
def pages(site) -> dict[str, Html]:
    """Every page by its address in the site, but for the one of addresses that do not exist."""
    files = [file for file in site.rglob("*.html") if file.name != "404.html"]
    return {file.relative_to(site).as_posix(): Html(file) for file in files}


def test_every_page_of_the_docs_is_in_the_site(pages):
    for file in (ROOT / "docs").rglob("*.md"):
        name = file.relative_to(ROOT / "docs").with_suffix(".html").as_posix()
        assert name in pages
    for file in (ROOT / "notebooks").glob("*.ipynb"):
        assert f"notebooks/{file.stem}.html" in pages
    assert {"contributing.html", "changelog.html"} <= set(pages)


def test_every_link_and_anchor_leads_somewhere(site, pages):
    for name, page in pages.items():
        for link in [*page.links, *page.asks]:
            target, anchor = urldefrag(urljoin(name, unquote(link)))
            if "://" in link or link.startswith(("mailto:", "javascript:")):
                continue
            if target.endswith("/") or target == "":
                target += "index.html"
            assert (site / target).is_file(), (name, link)
            if anchor and target in pages and not anchor.startswith("__"):
                assert anchor in pages[target].ids, (name, link)


def test_no_page_asks_for_anything_outside(site, pages):
    for name, page in pages.items():
        assert not [link for link in page.asks if "//" in link], name
    for style in site.rglob("*.css"):
        text = style.read_text(encoding="utf-8")
        assert "url(http" not in text
        assert "@import" not in text


def test_the_scenario_reference_has_every_key(pages):
    schema = scenario_schema()
    models = {"scenario": schema} | schema["$defs"]
    keys = {
        f"{name.lower()}.{key}" for name, model in models.items() for key in model["properties"]
    }
    assert len(keys) > 200
    assert not keys - pages["reference/scenario.html"].ids


def test_the_command_line_reference_has_every_command(pages):
    commands = set(typer.main.get_command(app).commands)
    assert "run" in commands
    assert not commands - pages["reference/cli.html"].ids


def test_the_python_reference_has_every_public_name(pages):
    everywhere = set().union(*(page.ids for page in pages.values()))
    assert {"dnnmso_mj.simulation.simulate", "dnnmso_mj.theory.TrackingBounds"} <= everywhere
    ids = pages["reference/python/index.html"].ids
    names = [name for name in dnnmso_mj.__all__ if not name.startswith("_")]
    assert len(names) > 10
    assert not {f"dnnmso_mj.{name}" for name in names} - ids


# As a browser shows it.


@pytest.fixture(scope="module")
def address(site) -> Iterator[str]:
    with served(site) as url:
        yield url


@pytest.fixture(scope="module")
def browser():
    with chromium() as opened:
        yield opened


@pytest.fixture
def page(browser, address) -> Iterator[Page]:
    """A page of a reader who likes it light; it fails on errors and on requests to outside."""
    context = browser.new_context(color_scheme="light", viewport={"width": 1300, "height": 900})
    opened, wrong = context.new_page(), []
    opened.on("console", lambda said: wrong.append(said.text) if said.type == "error" else None)
    opened.on("pageerror", lambda error: wrong.append(str(error)))
    opened.on("request", lambda asked: None if address in asked.url else wrong.append(asked.url))
    yield opened
    context.close()
    assert not wrong


@needs_chromium
def test_every_page_and_all_its_pictures_load(page, address, pages):
    for name in pages:
        page.goto(f"{address}/{name}")
        missing = "[...document.images].filter(i => i.complete && !i.naturalWidth).map(i => i.src)"
        assert page.evaluate(missing) == [], name
        assert page.locator("h1").first.is_visible(), name


@needs_chromium
def test_the_tabs_lead_to_every_section(page, address):
    page.goto(address)
    tabs = page.locator(".md-tabs__link").all_inner_texts()
    assert tabs[:3] == ["Home", "Tutorial", "How to"]
    for tab in tabs:
        page.locator(".md-tabs__link", has_text=tab).click()
        page.locator(".md-tabs__item--active", has_text=tab).wait_for()
        assert page.locator("h1").first.is_visible()


@needs_chromium
def test_search_finds_a_key_of_the_scenario(page, address):
    page.goto(address)
    result = page.locator(".md-search-result__link", has_text="Imperfections").first
    for _ in range(20):  # the page may not listen yet when it has loaded
        page.locator("input.md-search__input").fill("")
        page.locator("input.md-search__input").fill("torque_limit")
        with suppress(TimeoutError):
            result.wait_for(timeout=2000)
            break
    result.click()
    page.locator("h1", has_text="Imperfections").wait_for()
    assert page.locator("code", has_text="torque_limit").count() > 0


@needs_chromium
def test_mathematics_is_drawn_in_its_own_font(page, address):
    page.goto(f"{address}/theory.html")
    page.evaluate("document.fonts.ready")
    sizes = page.eval_on_selector_all(
        "math", "all => all.map(m => m.getBoundingClientRect()).map(r => [r.width, r.height])"
    )
    assert len(sizes) > 100
    assert min(min(size) for size in sizes) > 4
    fonts = "[...document.fonts].filter(f => f.status == 'loaded').map(f => f.family)"
    assert "STIX Two Math" in str(page.evaluate(fonts))
    fraction = page.locator("math[display=block] mfrac").first
    above, below = (part.bounding_box() for part in fraction.locator("> *").all())
    assert above["y"] + above["height"] <= below["y"] + 1  # one over the other: no plain text


@needs_chromium
def test_it_is_light_or_dark_as_one_likes(page, address):
    page.goto(address)
    brightness = "getComputedStyle(document.body).backgroundColor.match(/\\d+/g).map(Number)"
    assert min(page.evaluate(brightness)) > 200
    page.locator("label[title='Switch to dark']").click()
    assert max(page.evaluate(brightness)) < 80
