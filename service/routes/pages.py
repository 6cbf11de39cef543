"""What people look at: the drop page, the documentation of the API, the pages behind problem types."""

from __future__ import annotations

import base64
import hashlib
import re
from html import escape
from pathlib import Path

from fastapi import APIRouter, Request
from fastapi.openapi.docs import get_swagger_ui_html
from starlette.exceptions import HTTPException
from starlette.responses import HTMLResponse

from service.problem_types import TYPES
from service.problems import answers

router = APIRouter(tags=["pages"])

PAGE = Path(__file__).parent.parent / "page.html"
_NOTHING_ELSE = "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
_SWAGGER = "https://cdn.jsdelivr.net"  # where FastAPI's page gets Swagger UI from


def _allowed(page: str, tag: str) -> str:
    """CSP sources for the inline scripts or styles of a page: their hashes, and so nothing that is slipped in."""
    parts = re.findall(rf"<{tag}>(.*?)</{tag}>", page, re.DOTALL)
    digests = [base64.b64encode(hashlib.sha256(part.encode()).digest()).decode() for part in parts]
    return " ".join(f"'sha256-{digest}'" for digest in digests) or "'none'"


def _policy(page: str) -> str:
    return (
        f"default-src 'none'; script-src {_allowed(page, 'script')}; style-src {_allowed(page, 'style')}; "
        f"connect-src 'self'; img-src data:; {_NOTHING_ELSE}"
    )


_PAGE = PAGE.read_text(encoding="utf-8")
_PAGE_HEADERS = {"Content-Security-Policy": _policy(_PAGE)}
_STYLE = "body{font:1rem/1.5 system-ui,sans-serif;max-width:40rem;margin:3rem auto;padding:0 1rem}"
_PROBLEM = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>{title}</title><link rel="icon" href="data:,"><style>{style}</style></head>
<body><main><h1>{title}</h1><p><code>{code}</code>, HTTP status {status}</p><p>{meaning}</p>
<h2>What to do</h2><p>{remedy}</p></main></body></html>
"""


@router.get(
    "/", summary="Filter a file in the browser", response_class=HTMLResponse, responses=answers("internal-error")
)
async def page() -> HTMLResponse:
    return HTMLResponse(_PAGE, headers=_PAGE_HEADERS)


@router.get(
    "/problems/{code}",
    summary="What a kind of problem means",
    response_class=HTMLResponse,
    responses=answers("not-found", "internal-error"),
)
async def problem(code: str) -> HTMLResponse:
    kind = TYPES.get(code)
    if kind is None:
        raise HTTPException(404)
    texts = {name: escape(str(getattr(kind, name))) for name in ("title", "status", "meaning", "remedy")}
    html = _PROBLEM.format(code=escape(code), style=_STYLE, **texts)
    return HTMLResponse(html, headers={"Content-Security-Policy": _policy(html)})


@router.get("/docs", include_in_schema=False)
async def docs(request: Request) -> HTMLResponse:
    """Swagger UI. FastAPI's page fetches it from a content network, so a browser without one needs /openapi.json."""
    root = request.scope.get("root_path", "")
    page = get_swagger_ui_html(openapi_url=f"{root}/openapi.json", title="Pointfilter", swagger_favicon_url="data:,")
    html = bytes(page.body).decode()
    script = _allowed(html, "script")
    policy = (
        f"default-src 'none'; script-src {_SWAGGER} {script}; style-src {_SWAGGER} 'unsafe-inline'; "
        f"connect-src 'self'; img-src data:; {_NOTHING_ELSE}"
    )
    return HTMLResponse(html, headers={"Content-Security-Policy": policy})
