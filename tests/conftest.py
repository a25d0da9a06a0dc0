"""Programs compile quickly; workers, what they start and the next run share them."""

import os
from pathlib import Path

from tests.flags import QUICK

os.environ.setdefault("XLA_FLAGS", QUICK)
CACHE = Path(__file__).parents[1] / ".pytest_cache"
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(CACHE / "compiled"))
os.environ["XDG_CACHE_HOME"] = str(CACHE / "home")
