"""Errors of requests: HTTP status, code, and a message of four parts."""

from __future__ import annotations

from typing import Any

from egosim_jax.types import InputError


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


def as_request_error(error: Exception) -> RequestError:
    """Convert an error for the client; an internal error reveals no details."""
    if isinstance(error, RequestError):
        return error
    if isinstance(error, InputError):
        return RequestError(422, "invalid", str(error))
    if isinstance(error, FloatingPointError):
        return RequestError(
            500,
            "not_finite",
            "The clip is not finite (NaN): the step is not committed. Change its action.",
        )
    return RequestError(
        500, "internal", "The step failed inside the server, which logged the error. Try again."
    )
