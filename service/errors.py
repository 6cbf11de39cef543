"""What can go wrong around the filter: a branch of the core's tree, so that one table answers for both.

PointfilterError
└── ServiceError
    ├── MalformedRequestError     malformed-request      the HTTP body is not one file
    ├── UnsupportedCodingError    unsupported-coding     Content-Encoding of the request
    ├── SlowTransferError         slow-transfer          the body did not arrive in time
    ├── QueueFullError            queue-full             more requests than places
    ├── JobsFullError             jobs-full              more jobs wait than are kept
    ├── NotReadyError             not-ready              the default model has not answered yet
    ├── DrainingError             draining               the process is about to end
    ├── StorageFullError          storage-full           no room for temporary files
    ├── DeadlineError             deadline-exceeded      the work took too long and was stopped
    ├── WorkerDiedError           worker-died            the process that did the work died, more than once
    ├── UnauthorizedError         unauthorized           no API key, or one that is not known
    ├── JobNotFoundError          job-not-found          unknown, expired, or somebody else's
    ├── JobNotFinishedError       job-not-finished       there is no result yet
    ├── JobCancelledError         job-cancelled          there will be no result
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


class JobsFullError(ServiceError):
    code = "jobs-full"


class NotReadyError(ServiceError):
    code = "not-ready"


class DrainingError(ServiceError):
    code = "draining"


class StorageFullError(ServiceError):
    code = "storage-full"


class DeadlineError(ServiceError):
    code = "deadline-exceeded"


class WorkerDiedError(ServiceError):
    code = "worker-died"


class UnauthorizedError(ServiceError):
    code = "unauthorized"


class JobNotFoundError(ServiceError):
    code = "job-not-found"


class JobNotFinishedError(ServiceError):
    code = "job-not-finished"


class JobCancelledError(ServiceError):
    code = "job-cancelled"


class ClientGoneError(ServiceError):
    code = "client-closed"
