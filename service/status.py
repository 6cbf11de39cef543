"""A job as its owner sees it."""

from __future__ import annotations

from datetime import UTC, datetime
from functools import partial

from pydantic import BaseModel, Field
from starlette.requests import Request

from service.problems import Problem
from service.records import Progress, Record, State


class JobProgress(BaseModel):
    """How far a job is. Every pass over the cloud filters all its points once."""

    points_done: int = Field(description="Of this pass")
    points: int = Field(description="Of the cloud, those with coordinates that are no numbers not counted")
    iteration: int = Field(description="The pass, from 1 on")
    iterations: int
    share: float = Field(description="Of the whole work, from 0 to 1")
    seconds_left: float | None = Field(description="At the pace so far")


class JobStatus(BaseModel):
    """A job as its owner sees it."""

    id: str
    state: State
    model: str
    created: datetime
    started: datetime | None
    finished: datetime | None
    expires: datetime | None = Field(description="When a job that ended, and its result, are removed")
    attempts: int = Field(description="More than one when a process died that worked on it")
    progress: JobProgress | None
    problem: Problem | None = Field(description="Why the job failed")
    href: str
    events: str
    result: str | None = Field(description="Where the filtered file is, once there is one")


def described(request: Request, record: Record, progress: Progress | None, kept: float | None) -> JobStatus:
    """kept: seconds that a job is kept after its end, where they are known."""
    href = f"{request.scope.get('root_path', '')}/jobs/{record.id}"
    when = partial(datetime.fromtimestamp, tz=UTC)
    return JobStatus(
        id=record.id,
        state=record.state,
        model=record.order.model,
        created=when(record.created),
        started=None if record.started is None else when(record.started),
        finished=None if record.finished is None else when(record.finished),
        expires=None if record.finished is None or kept is None else when(record.finished + kept),
        attempts=record.attempts,
        progress=_progress(record, progress),
        problem=record.problem,
        href=href,
        events=f"{href}/events",
        result=f"{href}/result" if record.outcome else None,
    )


def _progress(record: Record, progress: Progress | None) -> JobProgress | None:
    if progress is None or record.state not in (State.RUNNING, State.DONE) or progress.points < 1:
        return None
    done = progress.total if record.state is State.DONE else progress.done
    iterations = max(1, round(progress.total / progress.points))
    iteration = min(done // progress.points + 1, iterations)
    left = None
    if record.state is State.RUNNING and done:
        left = round(progress.seconds / done * (progress.total - done), 1)
    return JobProgress(
        points_done=done - (iteration - 1) * progress.points,
        points=progress.points,
        iteration=iteration,
        iterations=iterations,
        share=round(done / progress.total, 4) if progress.total else 1.0,
        seconds_left=left,
    )
