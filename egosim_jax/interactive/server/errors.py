"""Errors of requests: HTTP status, code, and a message of four parts."""

from __future__ import annotations

import errno
import os
from typing import Any

from egosim_jax.types import InputError

STORAGE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO, errno.EACCES)
"""System errors of a disk that takes no more data."""


class RequestError(InputError):
    """Error of a refused request: what happened, the rule, the value and the fix."""

    def __init__(self, status: int, code: str, message: str, *, retry_after_s: float | None = None):
        super().__init__(message)
        self.status, self.code, self.retry_after_s = status, code, retry_after_s

    def body(self) -> dict[str, Any]:
        """Return the fields that the client receives."""
        found = {"status": self.status, "code": self.code, "message": str(self)}
        if self.retry_after_s is not None:
            found["retry_after_s"] = self.retry_after_s
        return found


def storage_failure(error: BaseException) -> str | None:
    """Return the system's reason if an error or its cause is that files cannot be written.

    C++ libraries raise other errors, which have the system's reason in their text.
    """
    seen: BaseException | None = error
    while seen is not None:
        for code in STORAGE:
            reason = os.strerror(code)
            if (isinstance(seen, OSError) and seen.errno == code) or reason in str(seen):
                return reason
        seen = seen.__cause__ or seen.__context__
    return None


def as_request_error(error: Exception) -> RequestError:
    """Convert an error for the client; an internal error reveals no details."""
    if isinstance(error, RequestError):
        return error
    if isinstance(error, InputError):
        return RequestError(422, "invalid", str(error))
    if (reason := storage_failure(error)) is not None:
        return RequestError(
            507,
            "storage",
            f"{reason} on the disk of the server's sessions, so the request was not done and the "
            "session is as before. Send it again when the disk has space and can be written to.",
            retry_after_s=10.0,
        )
    if isinstance(error, FloatingPointError):
        return RequestError(
            500,
            "not_finite",
            "The clip is not finite (NaN): the step is not committed. Change its action.",
        )
    return RequestError(
        500, "internal", "The step failed inside the server, which logged the error. Try again."
    )
