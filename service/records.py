"""What is written down about a job."""

from __future__ import annotations

from enum import StrEnum

from pydantic import BaseModel

from service.problems import Problem
from service.work import Delivery, Order


class State(StrEnum):
    QUEUED = "queued"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"

    @property
    def final(self) -> bool:
        return self in (State.DONE, State.FAILED, State.CANCELLED)


class Outcome(BaseModel):
    """Of a job that is done: what goes into the headers of its result."""

    sha256: str
    size: int
    points: int
    iterations: int
    model: str
    seconds: dict[str, float]

    @classmethod
    def of(cls, delivery: Delivery) -> Outcome:
        report = delivery.report
        return cls(
            sha256=delivery.sha256,
            size=delivery.size,
            points=report.points,
            iterations=report.iterations,
            model=report.model,
            seconds=delivery.seconds,
        )


class Record(BaseModel):
    """job.json. Times are seconds since 1970."""

    id: str
    state: State = State.QUEUED
    created: float
    started: float | None = None
    finished: float | None = None
    attempts: int = 0
    order: Order
    file_name: str | None = None
    small: bool = False
    owner: str | None = None
    request_id: str
    outcome: Outcome | None = None
    problem: Problem | None = None


class Progress(BaseModel):
    """progress.json, in units of points times iterations."""

    done: int
    total: int
    points: int
    seconds: float
    """Since the work began."""
