"""What a request asks for: its query parameters, checked before its upload is read."""

from __future__ import annotations

import asyncio
import re
from dataclasses import dataclass
from typing import Annotated, Literal

from fastapi import Depends, Query

from pointfilter.attributes import check_normals, parse_columns
from pointfilter.errors import ParameterError
from pointfilter.filter import default_passes
from pointfilter.models import AUTO, ModelBundle
from pointfilter.pipeline import Radius
from service.dependencies import CallerDep, ExchangeDep, HouseDep
from service.settings import variable
from service.work import LookOrder, Order


@dataclass(frozen=True)
class Chosen:
    """The model that is asked for: its name as the service knows it, and its bundle."""

    name: str
    bundle: ModelBundle


async def _chosen(
    house: HouseDep,
    exchange: ExchangeDep,
    _caller: CallerDep,
    model: Annotated[str | None, Query(description="A name from /models", max_length=100)] = None,
) -> Chosen:
    """Raises ModelError."""
    name = model or house.settings.model
    bundle = await asyncio.to_thread(house.engines.bundle, name)
    exchange.model = bundle.name
    return Chosen(name, bundle)


ChosenDep = Annotated[Chosen, Depends(_chosen)]
Seed = Annotated[int, Query(description="Of the choice of neighbours in dense patches", ge=0, lt=2**63)]


async def _order(
    house: HouseDep,
    chosen: ChosenDep,
    iterations: Annotated[
        str,
        Query(
            description="Most passes over the cloud: a number from 1 on, or auto for the model's own limit (default)",
            json_schema_extra={"pattern": "^(auto|[1-9][0-9]*)$"},
        ),
    ] = AUTO,
    radius: Annotated[
        str | None,
        Query(
            description="Radius of all balls: a length in the unit of the file (0.02), or a share of the bounding "
            "box's diagonal (5%, in an address 5%25); by default the network chooses one for each point",
            max_length=40,
        ),
    ] = None,
    seed: Seed = 0,
    format: Annotated[  # noqa: A002 - the parameter's public name
        Literal["same", "ascii", "binary_little_endian", "binary_big_endian"],
        Query(description="Encoding of the answer"),
    ] = "same",
    strength: Annotated[
        float,
        Query(description="Factor of each displacement, from 0 to 1", ge=0, le=1, allow_inf_nan=False),
    ] = 1,
    max_move: Annotated[
        float | None,
        Query(description="Longest displacement of a point, in the unit of the file", gt=0, allow_inf_nan=False),
    ] = None,
    paper: Annotated[
        bool, Query(description="The paper's mode: balls of 5 % of the bounding box's diagonal, two passes")
    ] = False,
    normals: Annotated[
        Literal["keep", "recompute", "drop"],
        Query(
            description="Columns nx, ny and nz: keep them as they are, write the network's normals of the filtered "
            "points, or leave the columns out"
        ),
    ] = "keep",
    columns: Annotated[
        str,
        Query(
            description="Columns to add, separated by commas: displacement (length of the move), uncertainty (expected "
            "distance to the surface), outlier (1 or 0); scalar_ stands before each name in the file",
            max_length=100,
        ),
    ] = "",
) -> Order:
    """Raises ParameterError, ModelError."""
    check_normals(normals, chosen.bundle, paper)
    usual, most = default_passes(None if paper else chosen.bundle.calibration), house.settings.max_iterations
    return Order(
        model=chosen.name,
        iterations=_iterations(iterations, usual, most),
        radius=None if radius is None else Radius.parse(radius),
        seed=seed,
        encoding=format,
        strength=strength,
        max_move=max_move,
        paper=paper,
        normals=normals,
        columns=parse_columns(columns),
    )


OrderDep = Annotated[Order, Depends(_order)]


async def _look_order(chosen: ChosenDep, seed: Seed = 0) -> LookOrder:
    """Raises ParameterError, ModelError."""
    return LookOrder(model=chosen.name, seed=seed)


LookOrderDep = Annotated[LookOrder, Depends(_look_order)]


def _iterations(text: str, usual: int, most: int) -> int | None:
    """The number in a request that may ask for at most so many; None for the usual one. Raises ParameterError."""
    if text == AUTO:
        return None if usual <= most else most
    number = int(text) if re.fullmatch(r"-?[0-9]{1,9}", text) else None
    if number is None or not 1 <= number <= most:
        raise ParameterError(
            f"iterations must be auto or a number from 1 to {most}, got {text[:40]}",
            limit=most,
            actual=text[:40] if number is None else number,
            hint=f"whoever runs the service can raise {variable('max_iterations')}",
        )
    return number
