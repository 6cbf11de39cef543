"""What routes ask for, as annotated aliases."""

from __future__ import annotations

import tempfile
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Annotated

from fastapi import Depends, Request

from service.exchange import Exchange, exchange_of
from service.house import House


async def _house(request: Request) -> House:
    house: House = request.app.state.house
    return house


HouseDep = Annotated[House, Depends(_house)]


async def _exchange(request: Request) -> Exchange:
    return exchange_of(request.scope)


ExchangeDep = Annotated[Exchange, Depends(_exchange)]


async def _ready(house: HouseDep) -> None:
    house.check_ready()


Ready = Depends(_ready)
"""For `dependencies=`: refuses with 503 until the default model has answered, and again while draining."""


async def _caller(request: Request, house: HouseDep, exchange: ExchangeDep) -> str | None:
    exchange.key = house.keys.caller(request.headers.get("authorization"))
    return exchange.key


CallerDep = Annotated[str | None, Depends(_caller)]
"""The name of the caller's API key, None where nobody needs one, or a refusal with 401."""


async def _place(house: HouseDep, caller: CallerDep) -> AsyncIterator[None]:
    with house.admission.place(caller):
        yield


AdmittedPlace = Annotated[None, Depends(_place)]
"""A place in the house until the answer was sent, or a refusal with 429."""


async def _folder(house: HouseDep, _place: AdmittedPlace) -> AsyncIterator[Path]:
    """Ends after the answer was sent, however it ended."""
    with (
        tempfile.TemporaryDirectory(
            prefix="pointfilter-", dir=house.settings.temp_dir, ignore_cleanup_errors=True
        ) as name,
    ):
        yield Path(name)


AdmittedFolder = Annotated[Path, Depends(_folder)]
"""A place in the house and a private folder to work in, or a refusal with 429."""
