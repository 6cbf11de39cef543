"""Logging: one line a record, with the request's id. File names and file contents are never logged."""

from __future__ import annotations

import json
import logging
import logging.config
from datetime import UTC, datetime

from service.exchange import current_request_id
from service.settings import Settings

EXTRAS = ("method", "route", "status", "code", "seconds", "model", "points", "provider", "job", "attempt", "key")


class JsonFormatter(logging.Formatter):
    """One JSON object a line; a traceback, where there is one, is a string in it."""

    def format(self, record: logging.LogRecord) -> str:
        entry = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
            **_extras(record),
        }
        if record.exc_info:
            entry["exception"] = self.formatException(record.exc_info)
        return json.dumps(entry)


class TextFormatter(logging.Formatter):
    """For people."""

    def __init__(self) -> None:
        super().__init__("%(asctime)s %(levelname)s %(name)s: %(message)s")

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - logging's own name
        extras = " ".join(f"{name}={value}" for name, value in _extras(record).items())
        return super().formatMessage(record) + (f"  {extras}" if extras else "")


def _extras(record: logging.LogRecord) -> dict[str, object]:
    found: dict[str, object] = {}
    if (request_id := current_request_id.get()) is not None:
        found["request_id"] = request_id
    return found | {name: getattr(record, name) for name in EXTRAS if getattr(record, name, None) is not None}


def configure_logging(settings: Settings) -> None:
    """Everything, uvicorn's own lines too, goes to stderr in one format."""
    logging.config.dictConfig(
        {
            "version": 1,
            "disable_existing_loggers": False,
            "formatters": {"json": {"()": JsonFormatter}, "text": {"()": TextFormatter}},
            "handlers": {"stderr": {"class": "logging.StreamHandler", "formatter": settings.log_format}},
            "root": {"handlers": ["stderr"], "level": settings.log_level.upper()},
        }
    )
