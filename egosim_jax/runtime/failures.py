"""Messages of errors that are no bugs: a full disk, little memory, a name that is not UTF-8."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator

from egosim_jax.runtime.terminal import not_utf8

MAX_TEXT = 160
"""Maximum length of the text around a name in a message, in characters."""


def undecoded_text(error: BaseException) -> str | None:
    """Return a message if an error, or its cause, is of a name of a file that is not UTF-8.

    Names of arguments, and of files that are listed, are refused before (`check_utf8`).
    """
    for seen in _causes(error):
        if isinstance(seen, UnicodeEncodeError) and seen.reason == "surrogates not allowed":
            start = max(0, seen.start - MAX_TEXT // 2)
            return not_utf8(seen.object[start : start + MAX_TEXT])
    return None


def system_error(error: BaseException) -> tuple[int, str] | None:
    """Return the code of a system error (disk, permissions) or of its cause, and where it was.

    C++ libraries raise other errors, which have the system's reason in their text.
    """
    for seen in _causes(error):
        text = str(seen).replace("\n", " ")
        for code in REFUSALS:
            reason = os.strerror(code)
            if (isinstance(seen, OSError) and seen.errno == code) or reason in text:
                name = getattr(seen, "filename", None)
                return code, f"{name}: {reason}" if name else text[:300]
    return None


def system_failure(error: BaseException) -> str | None:
    """Return a one-line message for a system error or for too little memory, or None."""
    if any(isinstance(seen, MemoryError) for seen in _causes(error)):
        return "not enough memory. Use smaller batches or a machine with more memory."
    failure = system_error(error)
    return None if failure is None else f"{failure[1]}. {REFUSALS[failure[0]]}"


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


_WRITABLE = "Choose a folder that can be written to. (--out)"
_RUN_AGAIN = "Free space and run the same command again; complete files are kept."
REFUSALS = {
    errno.ENOSPC: _RUN_AGAIN,
    errno.EDQUOT: _RUN_AGAIN,
    errno.EFBIG: _RUN_AGAIN,
    errno.EROFS: _WRITABLE,
    errno.EACCES: _WRITABLE,
    errno.EPERM: _WRITABLE,
    errno.ENOTDIR: "A file exists where a folder is needed: choose another path.",
    errno.EISDIR: "A folder exists where a file is needed: choose another path.",
    errno.EEXIST: "The path exists already: choose another path.",
    errno.ENAMETOOLONG: "Choose a shorter path.",
    errno.ELOOP: "Links are not followed here: give the real path.",
    errno.ENOENT: "Check the path.",
    errno.EMFILE: "Raise the limit on open files (ulimit -n).",
    errno.EBUSY: "A mount point cannot be replaced: choose a folder inside it.",
    errno.EIO: "Check the disk.",
}
"""System errors that a user can fix, and the fix."""
