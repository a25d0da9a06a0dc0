"""Steps of structure from motion that fail, for a child process."""

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any


def crash(*_: Any) -> None:
    print("no memory", file=sys.stderr, flush=True)
    os.abort()


def leave(*_: Any) -> None:
    raise SystemExit(3)


def hang(pid: Path, *_: Any) -> None:
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
    pid.write_text(str(child.pid))
    time.sleep(600)


def modules(*_: Any) -> set[str]:
    return set(sys.modules)
