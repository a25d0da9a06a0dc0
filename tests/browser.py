"""Pages in headless Chromium by its DevTools protocol, and the page of `egosim play`."""

import base64
import io
import itertools
import json
import os
import signal
import subprocess
import sys
import time
import urllib.request
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from PIL import Image
from websockets.sync.client import connect

ROOT = Path(__file__).parents[1]
OPTIONS = ("--headless", "--no-sandbox", "--hide-scrollbars", "--no-first-run",
           "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
           "--remote-debugging-port=0")  # fmt: skip


class Page:
    """An open page."""

    def __init__(self, socket):
        self._socket, self._numbers = socket, itertools.count()

    def call(self, method, **parameters):
        """Call a method of the protocol; return its result."""
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while (reply := json.loads(self._socket.recv(timeout=60))).get("id") != number:
            pass
        assert "error" not in reply, reply
        return reply["result"]

    def run(self, code):
        """Return the value of an expression."""
        found = self.call("Runtime.evaluate", expression=code, returnByValue=True)
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def wait_for(self, code, timeout_s=120):
        """Wait until an expression is true."""
        end = time.monotonic() + timeout_s
        while not (value := self.run(code)):
            assert time.monotonic() < end, f"never true: {code}"
            time.sleep(0.1)
        return value

    def click(self, text):
        """Click the button with this text, when it can be clicked."""
        button = f"[...document.querySelectorAll('button')].find(b => b.innerText == {text!r})"
        self.wait_for(f"{button} && !{button}.disabled")
        self.run(f"{button}.click()")

    def wait_for_text(self, text):
        """Wait until the page has a text, which may be the value of a choice."""
        self.wait_for(f"""document.body?.innerText.includes({text!r})
            || [...document.querySelectorAll('input')].some(e => e.value.includes({text!r}))""")

    def screenshot(self, path=None, **clip):
        """Return an image of the page, or of the rectangle `x`, `y`, `width`, `height` of it."""
        given = {"clip": {**clip, "scale": 1}} if clip else {}
        data = base64.b64decode(self.call("Page.captureScreenshot", **given)["data"])
        if path is not None:
            path.write_bytes(data)
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))

    def boxes(self):
        """Return x, y, width and height of each image element that is shown, from the top down."""
        return self.run("""[...document.querySelectorAll('img')]
            .filter(e => e.src.startsWith('blob:'))
            .map(e => e.getBoundingClientRect()).map(r => [r.x, r.y, r.width, r.height])""")

    def images(self):
        """Return an image of each image element that is shown, from the top down."""
        names = ("x", "y", "width", "height")
        return [self.screenshot(**dict(zip(names, box, strict=True))) for box in self.boxes()]


@contextmanager
def browse(url, folder, *, size=(1400, 1250)):
    """Open a page in a new browser, whose profile is in a folder."""
    window = f"--window-size={size[0]},{size[1]}"
    profile = f"--user-data-dir={folder / 'profile'}"
    command = ["chromium", *OPTIONS, window, profile, url]
    browser = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        line = next(line for line in browser.stderr if "DevTools listening on " in line)
        port = line.split("127.0.0.1:")[1].split("/")[0]
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json/list") as reply:
            pages = json.load(reply)
        (socket,) = (p["webSocketDebuggerUrl"] for p in pages if p["type"] == "page")
        with connect(socket, max_size=None) as connection:
            yield Page(connection)
    finally:
        browser.terminate()
        browser.wait(10)
        browser.stderr.close()


@contextmanager
def playing(folder, *options):
    """Run `egosim play`, which records in a folder; yield the address of its page."""
    command = [sys.executable, "-m", "egosim_jax", "play", "--port", "0", "--out", folder, *options]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    program = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
    try:
        url = program.stdout.readline().strip()
        assert url.startswith("http://127.0.0.1:"), url
        yield url
    finally:
        program.send_signal(signal.SIGINT)
        code = program.wait(60)
        program.stdout.close()
    assert code == 0
