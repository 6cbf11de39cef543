"""What is written down about a job."""

from __future__ import annotations

from enum import StrEnum
from typing import Any

from pydantic import BaseModel, field_validator

from pointfilter.models import AUTO
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
    """Of a job that is done: what goes into the headers of its result.

    Records that earlier versions wrote do not have the fields with defaults.
    """

    sha256: str
    size: int
    points: int
    iterations: int
    model: str
    seconds: dict[str, float]
    moved: int | None = None
    radius: float | None = None
    """Median of the balls, in the unit of the file."""
    expected_error: float | None = None
    """None where the network does not tell it."""
    warnings: tuple[str, ...] = ()

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
            moved=report.moved,
            radius=report.radius,
            expected_error=report.expected_error,
            warnings=report.warnings,
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

    @field_validator("order", mode="before")
    @classmethod
    def _auto_is_none(cls, order: Any) -> Any:
        """Earlier versions wrote "auto" where this one writes null."""
        if isinstance(order, dict) and order.get("iterations") == AUTO:
            return {**order, "iterations": None}
        return order


class Progress(BaseModel):
    """progress.json, in units of points times iterations."""

    done: int
    total: int
    points: int
    seconds: float
    """Since the work began."""
