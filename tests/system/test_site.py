"""The site of the documentation has an index for its search."""

import json
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("zensical") is None, reason="needs the extra docs")
def test_the_index_of_the_search_has_every_page():
    subprocess.run(["zensical", "build", "--strict"], cwd=ROOT, check=True)
    project = tomllib.loads((ROOT / "zensical.toml").read_text("utf-8"))["project"]
    items = json.loads((ROOT / project["site_dir"] / "search.json").read_text("utf-8"))["items"]
    found = {item["location"].partition("/")[0] for item in items}
    assert {path.stem for path in (ROOT / "docs").glob("*.md")} - {"index"} <= found
