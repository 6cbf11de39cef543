"""The app factory: puts the rooms together, holds no logic of its own."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi

import pointfilter
from service.handlers import install_handlers
from service.house import House
from service.middleware import ExchangeMiddleware
from service.problems import Problem
from service.routes import about, filter, health, jobs, look, pages  # noqa: A004 - named after what it routes
from service.settings import Settings
from service.tracing import tracing

DESCRIPTION = """Noisy point clouds in, clean ones out: sharp edges and every attribute kept.

Errors are RFC 9457 problem details (`application/problem+json`); their `type` is the address of a page that explains
them.
"""


def create_app(settings: Settings | None = None) -> FastAPI:
    """An app with its own models, queue and metrics. settings: by default from the environment."""
    settings = settings or Settings()
    house = House(settings)
    app = FastAPI(
        title="Pointfilter",
        version=pointfilter.__version__,
        description=DESCRIPTION,
        lifespan=_lifespan,
        docs_url=None,  # routes/pages.py has /docs, with a content security policy
        redoc_url=None,
        telemetry=tracing(settings),
    )
    app.state.house = house
    app.add_middleware(ExchangeMiddleware, house=house)
    install_handlers(app)
    for router in (filter.router, look.router, jobs.router, health.router, about.router, pages.router):
        app.include_router(router)
    app.openapi = lambda: _openapi(app)  # type: ignore[method-assign]
    return app


@asynccontextmanager
async def _lifespan(app: FastAPI) -> AsyncIterator[None]:
    house: House = app.state.house
    house.open()
    try:
        yield
    finally:
        await house.close()


def _openapi(app: FastAPI) -> dict[str, Any]:
    """FastAPI's document, with our problem schema, and without the 422 it promises where nothing can be invalid."""
    if app.openapi_schema is None:
        document = get_openapi(title=app.title, version=app.version, description=app.description, routes=app.routes)
        schemas = document["components"]["schemas"]
        schemas["Problem"] = Problem.model_json_schema()
        for name in ("HTTPValidationError", "ValidationError"):
            schemas.pop(name, None)
        for operations in document["paths"].values():
            for operation in operations.values():
                if "application/json" in operation["responses"].get("422", {}).get("content", {}):
                    del operation["responses"]["422"]
        app.openapi_schema = document
    return app.openapi_schema
