"""Is it alive, may it get requests, and how is it doing."""

from __future__ import annotations

import time

from fastapi import APIRouter
from pydantic import BaseModel

from service.dependencies import HouseDep, Ready
from service.problems import answers

router = APIRouter(prefix="/health", tags=["health"])
_STARTED = time.monotonic()


class Alive(BaseModel):
    status: str = "ok"


class Health(Alive):
    """What a person wants to see at a glance."""

    model: str
    provider: str | None
    workers: int
    in_progress: int
    waiting: int
    places: int
    uptime_seconds: float


@router.get("", summary="Summary", dependencies=[Ready], responses=answers("internal-error", "not-ready", "draining"))
async def health(house: HouseDep) -> Health:
    """503 like /health/ready while there is nothing good to say."""
    admission = house.admission
    return Health(
        model=house.settings.model,
        provider=house.provider,
        workers=admission.workers,
        in_progress=admission.running,
        waiting=admission.waiting,
        places=admission.places,
        uptime_seconds=round(time.monotonic() - _STARTED, 3),
    )


@router.get("/live", summary="The process can do its work", responses=answers("internal-error", "not-ready"))
async def live(house: HouseDep) -> Alive:
    """503 when the workers are gone and cannot be replaced: start the process again."""
    house.check_alive()
    return Alive()


@router.get(
    "/ready",
    summary="The default model has answered; send requests",
    dependencies=[Ready],
    responses=answers("internal-error", "not-ready", "draining"),
)
async def ready() -> Alive:
    return Alive()


@router.get("/startup", summary="The default model has answered once", responses=answers("internal-error", "not-ready"))
async def startup(house: HouseDep) -> Alive:
    """Stays 200 while draining: the start is over."""
    house.check_started()
    return Alive()
