"""The site as built: search finds pages in a browser, and every page draws itself there without an error.

`make docs` builds it and runs this; SEAOPT_SITE names its folder. Nothing is downloaded.
"""

from __future__ import annotations

import functools
import html
import http.server
import os
import re
import shutil
import subprocess
import threading
from pathlib import Path
from urllib.parse import quote, unquote, urldefrag, urljoin

import pytest

SITE = Path(os.environ.get("SEAOPT_SITE", ""))
pytestmark = pytest.mark.skipif(
    "SEAOPT_SITE" not in os.environ, reason="no site is named by SEAOPT_SITE: run make docs"
)
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")


@pytest.fixture(scope="module")
def address():
    """Return the address of the site, served on loopback."""

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_args):
            pass

    handler = functools.partial(Quiet, directory=str(SITE))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()


@pytest.fixture(scope="module")
def browse(tmp_path_factory):
    """Return a function from an address to the page as a browser has it, and what its console said."""
    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    if program is None:
        pytest.skip(f"no browser on this machine: install one of {', '.join(BROWSERS)}")

    def visit(url):
        command = [
            program, "--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--dump-dom",
            "--virtual-time-budget=8000", f"--user-data-dir={tmp_path_factory.mktemp('browser')}", url,
        ]  # fmt: skip
        done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
        return done.stdout, re.findall(r"CONSOLE[^\"]*\"(.*?)\", source", done.stderr)

    return visit


@pytest.mark.parametrize(
    ("words", "page"),
    [
        ("noise gain", "theory/tuning"),
        ("tracking band", "reference/symbols"),
        ("let_stick", "reference/api/seaopt.plants.let_stick"),
        ("backlash", "theory/plants"),
    ],
)
def test_search_finds_the_page(address, browse, words, page):
    found, console = browse(f"{address}search.html?q={quote(words)}")
    results = re.findall(r'<a href="([^"#?]+)', found[found.index('id="search-results"') :])
    assert f"{page}.html" in [unquote(result) for result in results]
    assert not console


@pytest.mark.parametrize("page", ["index", "tutorial/ten_minutes", "theory/plants", "reference/api/seaopt.fit"])
def test_a_page_says_nothing_on_the_console(address, browse, page):
    _, console = browse(f"{address}{page}.html")
    assert not console


def test_every_link_and_image_of_every_page_is_there():
    """Sphinx checks what it resolves itself; this checks what was written."""
    anchors, missing = {}, []
    for path in SITE.rglob("*.html"):
        anchors[path.resolve()] = set(re.findall(r'\bid="([^"]+)"', path.read_text(encoding="utf-8")))
    for path in anchors:
        text = path.read_text(encoding="utf-8")
        for link in map(html.unescape, re.findall(r'<(?:a|img|link|script)\b[^>]*?\b(?:href|src)="([^"]+)"', text)):
            if re.match(r"[a-z]+:", link):
                continue
            target, anchor = urldefrag(urljoin(path.as_uri(), link))
            file = Path(unquote(target.removeprefix("file://").partition("?")[0]))
            if not file.exists() or (anchor and file.suffix == ".html" and unquote(anchor) not in anchors[file]):
                missing.append(f"{path.relative_to(SITE.resolve())}: {link}")
    assert not missing


def test_the_site_needs_no_network():
    """Scripts, styles, fonts and pictures are the site's own."""
    for path in SITE.rglob("*.html"):
        text = path.read_text(encoding="utf-8")
        loaded = re.findall(r'<(?:script|img|link rel="stylesheet")[^>]*\b(?:src|href)="(https?:[^"]+)"', text)
        assert not loaded, path
