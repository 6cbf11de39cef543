"""What can go wrong around the filter: a branch of the core's tree, so that one table answers for both.

PointfilterError
└── ServiceError
    ├── MalformedRequestError     malformed-request      the HTTP body is not one file
    ├── UnsupportedCodingError    unsupported-coding     Content-Encoding of the request
    ├── SlowTransferError         slow-transfer          the body did not arrive in time
    ├── QueueFullError            queue-full             more requests than places
    ├── NotReadyError             not-ready              the default model has not answered yet
    ├── DrainingError             draining               the process is about to end
    ├── StorageFullError          storage-full           no room for temporary files
    ├── DeadlineError             deadline-exceeded      the work took too long and was stopped
    └── ClientGoneError           client-closed          nobody waits for the answer any more
"""

from __future__ import annotations

from pointfilter.errors import PointfilterError


class ServiceError(PointfilterError):
    """Base of the service's own errors. retry_after: seconds after which trying again makes sense."""

    def __init__(
        self,
        message: str,
        *,
        limit: float | str | None = None,
        actual: float | str | None = None,
        hint: str | None = None,
        retry_after: int | None = None,
    ) -> None:
        super().__init__(message, limit=limit, actual=actual, hint=hint)
        self.retry_after = retry_after


class MalformedRequestError(ServiceError):
    code = "malformed-request"


class UnsupportedCodingError(ServiceError):
    code = "unsupported-coding"


class SlowTransferError(ServiceError):
    code = "slow-transfer"


class QueueFullError(ServiceError):
    code = "queue-full"


class NotReadyError(ServiceError):
    code = "not-ready"


class DrainingError(ServiceError):
    code = "draining"


class StorageFullError(ServiceError):
    code = "storage-full"


class DeadlineError(ServiceError):
    code = "deadline-exceeded"


class ClientGoneError(ServiceError):
    code = "client-closed"
