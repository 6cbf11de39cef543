"""POST /look: what the filter would do to a cloud, without filtering it."""

from __future__ import annotations

from functools import partial

from fastapi import APIRouter, Request

from pointfilter.inspection import Look
from service.dependencies import AdmittedFolder, ExchangeDep, HouseDep, Ready
from service.intake import UPLOAD_CODES
from service.ordering import LookOrderDep
from service.problems import answers
from service.turn import WORK_CODES, in_turn
from service.upload import FILE_BODY, receive_upload

router = APIRouter()


@router.post(
    "/look",
    summary="How noisy a point cloud is, and what the filter would do",
    tags=["filter"],
    dependencies=[Ready],
    responses=answers(*UPLOAD_CODES, *WORK_CODES),
    openapi_extra=FILE_BODY,
)
async def look_at_file(
    request: Request, house: HouseDep, exchange: ExchangeDep, folder: AdmittedFolder, order: LookOrderDep
) -> Look:
    """Takes the file as POST /filter does, and answers in about the time in which the filter chooses its balls."""
    upload = await receive_upload(request, folder / "input.ply", house.settings)
    found, _ = await in_turn(
        request, house, upload, partial(house.crew.look, order, upload.path), "send a part of the cloud"
    )
    exchange.points = found.points
    return found
