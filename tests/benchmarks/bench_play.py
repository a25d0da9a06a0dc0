"""Time clips of `egosim play` at the browser, and record the page as a GIF.

    python -m tests.benchmarks.bench_play [--clips 5] [--configs tabletop_student tabletop]
        [--gif docs/play.gif]

Prints, for each clip, the seconds from the click to the first and the last frames that the browser
has received, and to the state's update; then their medians without the first clip, for each config.
The recording shows the page before one clip, with each of its frames, and after it.
"""

import argparse
import statistics
import tempfile
import time
from pathlib import Path

import numpy as np
from PIL import Image

from egosim_jax.io.video import read_video
from tests.browser import browse, playing

WATCH = """(() => {
  window.events = [];
  const note = what => window.events.push([performance.now() / 1000, what]);
  new MutationObserver(changes => {
    for (const change of changes)
      if (change.type == 'attributes' && change.target.tagName == 'IMG') note('image');
    const text = document.body.innerText;
    for (const part of ['Generating', 'Updating the state', 'state updated after'])
      if (text.includes(part) && window.last != part) { window.last = part; note(part); }
  }).observe(document.body, {subtree: true, childList: true, characterData: true,
                             attributes: true, attributeFilter: ['src']});
})()"""
"""Script that notes when images and the status change in the page."""
WIDTH = 880
"""Columns of the recording."""
EMPTY = 0.06
"""Share of the page, on the left, that the scene leaves empty and the recording lacks."""
DISMISS = "document.querySelectorAll('.mantine-Notification-closeButton').forEach(b => b.click())"
"""Script that closes notifications, such as the one about a browser without a GPU."""


def make_clip(page, button):
    """Make a clip; return the seconds to its first frames, last frames and update."""
    page.run("window.events = []; window.last = ''; window.clicked = performance.now() / 1000")
    page.click(button)
    page.wait_for("window.events.some(e => e[1] == 'state updated after')")
    clicked, events = page.run("window.clicked"), page.run("window.events")
    times = {what: seconds - clicked for seconds, what in reversed(events)}
    shown = [s - clicked for s, what in events if what == "image"]
    live = [seconds for seconds in shown if seconds <= times["Updating the state"] + 0.05]
    return live[0], live[-1], times["state updated after"]


def record(page, runs, path):
    """Record the page while a clip is made: shots before and after, and its images as played."""
    page.run(DISMISS)
    time.sleep(1)
    before, boxes = page.screenshot(), page.boxes()
    page.click("put it on the ring")
    page.wait_for_text("state updated after")
    time.sleep(5)  # until it has been played
    after = page.screenshot()
    page.click("save")
    page.wait_for_text("episode.zip")
    (video,) = runs.glob("*/episode.mp4")
    write_gif(path, before, after, boxes, read_video(video).frames)
    print(f"{path}: {path.stat().st_size / 1e6:.1f} MB")


def write_gif(path, before, after, boxes, frames):
    """Write a GIF: the page before a clip, then with each frame, then after it.

    `frames` have the generated and the true image side by side, `boxes` where the page has them.
    """
    shots = [Image.fromarray(before)]
    for frame in frames[:-1]:
        shot = Image.fromarray(before)
        for image, (x, y, width, height) in zip(np.split(frame, 2, axis=1), boxes, strict=True):
            size = round(width), round(height)
            large = Image.fromarray(image).resize(size, Image.Resampling.BICUBIC)
            shot.paste(large, (round(x), round(y)))
        shots.append(shot)
    shots.append(Image.fromarray(after))
    height, width = before.shape[:2]
    left = round(EMPTY * width)
    size = WIDTH, round(WIDTH * height / (width - left))
    small = [
        shot.crop((left, 0, width, height)).resize(size, Image.Resampling.LANCZOS) for shot in shots
    ]
    palette = small[len(small) // 2].quantize(256, method=Image.Quantize.MAXCOVERAGE, kmeans=3)
    images = [shot.quantize(palette=palette, dither=Image.Dither.NONE) for shot in small]
    durations = [800, *[125] * (len(images) - 2), 2500]
    images[0].save(
        path, save_all=True, append_images=images[1:], duration=durations, loop=0, optimize=True
    )


def main():
    """Time clips, then record one."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--clips", type=int, default=5)
    parser.add_argument("--configs", nargs="+", default=["tabletop_student"])
    parser.add_argument("--gif", type=Path)
    given = parser.parse_args()
    for config in given.configs:
        print(config)
        measure(config, given.clips, given.gif)


def measure(config, clips, gif):
    """Time the clips of a model, after one is recorded if a path is given."""
    with (
        tempfile.TemporaryDirectory() as name,
        playing(Path(name) / "runs", "--seed", "0", "--config", config) as url,
        browse(url, Path(name), size=(1180, 1210)) as page,
    ):
        page.wait_for_text("put it on the ring")
        time.sleep(3)
        if gif is not None:
            record(page, Path(name) / "runs", gif)
            page.click("undo")
            page.wait_for_text("0: The beginning")
        page.run(WATCH)
        times = []
        for number in range(clips):
            times.append(make_clip(page, "put it on the ring" if number % 2 else "lift it"))
            print("first {:.2f} s, last {:.2f} s, state {:.2f} s".format(*times[-1]), flush=True)
            time.sleep(4)  # until it has been played
        for column, name in enumerate(("first", "last", "state") if times else ()):
            values = [row[column] for row in times[1:] or times]
            print(f"median {name}: {statistics.median(values):.2f} s")


if __name__ == "__main__":
    main()
