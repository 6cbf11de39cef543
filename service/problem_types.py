"""Every way a request can fail, in one table: the answer's status, what it means, what to do, how it is counted.

docs/problems.md is this table for readers of the repository; a test compares the two.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Outcome = Literal["ok", "invalid", "too_large", "rejected", "timeout", "cancelled", "error"]


@dataclass(frozen=True)
class ProblemType:
    """One row. `private`: the exception's own words are for the log, the answer says `meaning` instead."""

    status: int
    title: str
    outcome: Outcome
    meaning: str
    remedy: str
    private: bool = False


TYPES: dict[str, ProblemType] = {
    "malformed-request": ProblemType(
        400, "The request does not hold one file", "invalid",
        "The body is empty, or it is a multipart form that is broken or does not have exactly one part called `file`.",
        "Send the file as the raw body, or as the only part `file` of a multipart form.",
    ),
    "malformed-file": ProblemType(
        400, "The file is damaged", "invalid",
        "The file is not what its own header promises. The detail names the line or the byte.",
        "Save or download the file again; a file that ends early was cut short on its way.",
    ),
    "invalid-input": ProblemType(
        400, "The file cannot be used", "invalid",
        "The file was read and cannot be filtered. The detail says why.",
        "Check the file with `pointfilter info`.",
    ),
    "unauthorized": ProblemType(
        401, "No valid API key", "invalid",
        "The service asks for an API key, and the request has none, or one that the service does not know.",
        "Send `Authorization: Bearer KEY`; whoever runs the service makes keys with `python -m service key NAME`.",
    ),
    "not-found": ProblemType(
        404, "There is nothing here", "invalid",
        "The address is not one of this service's.",
        "GET /docs lists the addresses.",
    ),
    "model-not-found": ProblemType(
        404, "No such model", "invalid",
        "The service has no model of the name asked for.",
        "GET /models lists the names; leave `model` out for the default.",
    ),
    "job-not-found": ProblemType(
        404, "No such job", "invalid",
        "The job does not exist, was removed, has expired, or belongs to another API key.",
        "Send the file again; POINTFILTER_JOB_TTL_SECONDS says how long a finished job is kept.",
    ),
    "method-not-allowed": ProblemType(
        405, "The method does not fit the address", "invalid",
        "The address exists and does not take this HTTP method.",
        "The Allow header lists the methods it takes.",
    ),
    "slow-transfer": ProblemType(
        408, "The transfer took too long", "timeout",
        "The file did not arrive within the time the service gives an upload. A result not fetched in that time is "
        "cut off, too; the log and the metrics count it here.",
        "Try a faster connection or a smaller file, or raise POINTFILTER_TRANSFER_SECONDS.",
    ),
    "job-not-finished": ProblemType(
        409, "The job is not finished", "invalid",
        "The result was asked for before it was there.",
        "Ask GET /jobs/{id}?wait=60, or follow GET /jobs/{id}/events.",
    ),
    "job-cancelled": ProblemType(
        410, "The job was cancelled", "invalid",
        "Somebody cancelled the job, so there is no result and never will be.",
        "Send the file again if it should be done after all.",
    ),
    "limit-exceeded": ProblemType(
        413, "The file is too large", "too_large",
        "The file has more bytes, more points or a longer header than the service takes. `limit` and `actual` hold the "
        "numbers.",
        "Split or thin the cloud, or raise the knob that the hint names.",
    ),
    "unsupported-format": ProblemType(
        415, "Not a format this service reads", "invalid",
        "The file is not PLY: its first line is not `ply`.",
        "Convert the scan to PLY first.",
    ),
    "unsupported-coding": ProblemType(
        415, "Compressed bodies are not taken", "invalid",
        "The request has a Content-Encoding, and a compressed body can hide one that is any size.",
        "Send the file as it is.",
    ),
    "missing-coordinates": ProblemType(
        422, "The points have no coordinates", "invalid",
        "The file has no vertex element, or its vertices have no usable x, y and z.",
        "Export the cloud with float or double properties x, y and z.",
    ),
    "too-few-points": ProblemType(
        422, "Too few points", "invalid",
        "Not enough points have finite coordinates to say anything about a surface.",
        "Check the export: rows of NaN or Inf do not count.",
    ),
    "degenerate-cloud": ProblemType(
        422, "The cloud has no extent", "invalid",
        "All points are at one place, or so far apart that squared distances exceed double precision.",
        "Check the coordinates: remove stray points, or pass `radius` as a length in the unit of the file.",
    ),
    "parameter-out-of-range": ProblemType(
        422, "A parameter is out of range", "invalid",
        "A query parameter has a value that the service does not take.",
        "The detail names the parameter and the values it takes.",
    ),
    "queue-full": ProblemType(
        429, "The queue is full", "rejected",
        "As many requests are being worked on or waiting as the service takes.",
        "Try again after the seconds in Retry-After; the number comes from the measured rate.",
    ),
    "jobs-full": ProblemType(
        429, "Too many jobs", "rejected",
        "As many jobs wait as the service keeps, or as it keeps for one API key.",
        "Try again after the seconds in Retry-After, or cancel jobs that are no longer wanted.",
    ),
    "client-closed": ProblemType(
        499, "The client went away", "cancelled",
        "The connection closed before the answer; the work was stopped. Seen in logs and metrics, never by the client.",
        "Nothing to do; if it was you, check the timeout of your client or proxy.",
    ),
    "cancelled": ProblemType(
        499, "The work was stopped", "cancelled",
        "Somebody asked for the work to stop.",
        "Send the request again if it should be done after all.",
    ),
    "internal-error": ProblemType(
        500, "Something went wrong here", "error",
        "The service met something it did not expect. The log has it under the request id.",
        "Report it with the request id; trying again may help.", private=True,
    ),
    "error": ProblemType(
        500, "The filter failed", "error",
        "The filter failed in a way that has no name of its own. The log has it under the request id.",
        "Report it with the request id.", private=True,
    ),
    "model-error": ProblemType(
        500, "The model failed", "error",
        "The model could not be used. The log has the reason under the request id.",
        "Try another model, and tell whoever runs the service.", private=True,
    ),
    "invalid-model": ProblemType(
        500, "The model is damaged", "error",
        "The model's files do not fit together, or not this version. The log has the reason under the request id.",
        "Try another model, and tell whoever runs the service.", private=True,
    ),
    "not-ready": ProblemType(
        503, "Not ready yet", "rejected",
        "The default model has not answered its first inference yet, or it failed to load.",
        "Try again after the seconds in Retry-After.",
    ),
    "draining": ProblemType(
        503, "Shutting down", "rejected",
        "The process is finishing its last requests and takes no new ones.",
        "Try again after the seconds in Retry-After; another process should answer.",
    ),
    "provider-unavailable": ProblemType(
        503, "The device is not available", "error",
        "The device that the service was told to use is not there. The log has the reason under the request id.",
        "Tell whoever runs the service; POINTFILTER_DEVICE=auto takes what there is.", private=True,
    ),
    "worker-died": ProblemType(
        503, "The work kept failing", "error",
        "The process that did the work died, and so did the ones that tried again: the cloud may need more memory than "
        "there is. The service itself goes on.",
        "Send a smaller cloud, or give the service more memory; trying again may help if the machine was short of it.",
    ),
    "storage-full": ProblemType(
        503, "No room for files", "error",
        "The disk that holds uploads and results is full.",
        "Try again after the seconds in Retry-After, or give POINTFILTER_TEMP_DIR and POINTFILTER_DATA_DIR more room.",
    ),
    "deadline-exceeded": ProblemType(
        504, "The work took too long", "timeout",
        "The result was not there within the time the service gives a request, and the work was stopped.",
        "Send a smaller cloud, fewer iterations or a smaller radius, or raise POINTFILTER_TIMEOUT_SECONDS.",
    ),
}  # fmt: skip
