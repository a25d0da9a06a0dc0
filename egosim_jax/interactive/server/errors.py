"""Errors of requests: HTTP status, code, and a message of four parts."""

from __future__ import annotations

import errno
import os
from typing import Any

from egosim_jax.runtime.failures import system_error
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
        body = {"status": self.status, "code": self.code, "message": str(self)}
        return body if self.retry_after_s is None else body | {"retry_after_s": self.retry_after_s}


def as_request_error(error: Exception) -> RequestError:
    """Convert an error for the client; an internal error reveals no details."""
    if isinstance(error, RequestError):
        return error
    if isinstance(error, InputError):
        return RequestError(422, "invalid", str(error))
    if (failure := system_error(error)) is not None and failure[0] in STORAGE:
        return RequestError(
            507,
            "storage",
            f"{os.strerror(failure[0])} on the disk of the server's sessions, so the request was "
            "not done and the session is as before. Send it again when the disk has space and can "
            "be written to.",
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
