"""Latency of a wearer's own hand on the page of `egosim play`, in headless Chromium.

    python -m tests.benchmarks.bench_own_hand [VIDEO]

Plays a video of a hand in place of a camera, by default a synthetic one, and prints the medians of
the page: from a camera's frame to the drawn hand, to the predicted objects, and to the first
painted frames of the part that ends with it. All are times at which the server sends them. It also
prints the load of the machine.
"""

import os
import re
import sys
import tempfile
from pathlib import Path

from tests.browser import browse, playing
from tests.own_hands import film_of_carry

SEED = 1


def main():
    """Print the latencies."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        video = Path(sys.argv[1]) if len(sys.argv) > 1 else folder / "hand.mp4"
        if len(sys.argv) == 1:
            film_of_carry(video, SEED)
        with (
            playing(folder / "runs", "--seed", str(SEED), "--camera", video) as url,
            browse(url, folder) as page,
        ):
            page.wait_for_text("Press follow")
            page.click("follow")
            page.wait_for_text("has ended")
            page.wait_for_text(", painted")
            text = page.run("document.body.innerText")
    print(re.search(r"Median time.*", text)[0])
    print("load of the machine, last minute and last five:", *os.getloadavg()[:2])


if __name__ == "__main__":
    main()
