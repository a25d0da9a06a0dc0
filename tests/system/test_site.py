"""The site of the documentation, whose search is tried in a real browser."""

import functools
import json
import shutil
import subprocess
import threading
import tomllib
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from tests.browser import browse

ROOT = Path(__file__).parents[2]


DIALOG = "document.activeElement?.shadowRoot"
"""Search dialog, once it is open."""
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(shutil.which("zensical") is None, reason="needs the extra docs"),
]


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *args):
        pass


@pytest.fixture(scope="module")
def site():
    subprocess.run(["zensical", "build", "--strict"], cwd=ROOT, check=True)
    project = tomllib.loads((ROOT / "zensical.toml").read_text("utf-8"))["project"]
    return ROOT / project["site_dir"]


def test_the_index_of_the_search_has_every_page(site):
    items = json.loads((site / "search.json").read_text("utf-8"))["items"]
    found = {item["location"].partition("/")[0] for item in items}
    assert {path.stem for path in (ROOT / "docs").glob("*.md")} - {"index"} <= found


def test_the_search_box_finds_a_word(site, tmp_path):
    server = ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=site))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    with browse(f"http://127.0.0.1:{server.server_port}/conventions/", tmp_path) as page:
        page.wait_for("[...document.querySelectorAll('div')].some(e => e.shadowRoot)")
        page.run("document.querySelector('.md-search__button').click()")
        page.wait_for(f"{DIALOG}?.activeElement?.tagName == 'INPUT'")
        page.call("Input.insertText", text="carve")
        page.wait_for(f"{DIALOG}.textContent.includes('How the state is updated')")
    server.shutdown()
    server.server_close()
