"""`python -m service`: the service, its settings from the environment (docs/configuration.md).

`python -m service key NAME` makes an API key: the key on stderr, the line for the keys file on stdout.

Exit codes: 0 after SIGTERM or Ctrl-C once the running requests are done; 1 when the default model cannot be used;
2 for settings that make no sense; 3 when the address cannot be listened on.
"""

from __future__ import annotations

import sys
from types import FrameType

import prometheus_client
import uvicorn
from pydantic import ValidationError

from service.app import create_app
from service.house import House
from service.keys import KeysError, new_key
from service.logs import configure_logging
from service.settings import Settings, variable


class _Server(uvicorn.Server):
    """Says that it drains before it does."""

    def __init__(self, config: uvicorn.Config, house: House) -> None:
        super().__init__(config)
        self._house = house
        house.on_failure = self._fail

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        self._house.drain()
        super().handle_exit(sig, frame)
        self._captured_signals.clear()  # a stop that was asked for ends with exit code 0

    def _fail(self) -> None:
        self.should_exit = True


def main(arguments: list[str]) -> int:
    if arguments:
        return _key(arguments)
    try:
        settings = Settings()
    except ValidationError as error:
        for problem in error.errors():
            name = str(problem["loc"][0]) if problem["loc"] else ""
            print(f"{variable(name)}: {problem['msg']}", file=sys.stderr)
        return 2
    configure_logging(settings)
    prometheus_client.disable_created_metrics()  # type: ignore[no-untyped-call]
    app = create_app(settings)
    house: House = app.state.house
    server = _Server(
        uvicorn.Config(
            app,
            host=settings.host,
            port=settings.port,
            log_config=None,
            access_log=False,  # service.requests logs each request, without what the client wrote
            server_header=False,
            timeout_graceful_shutdown=settings.drain_seconds,
            ws="none",
        ),
        house,
    )
    server.run()
    return 0 if server.started and house.failure is None else 1


def _key(arguments: list[str]) -> int:
    if len(arguments) != 2 or arguments[0] != "key":
        print("usage: python -m service [key NAME]", file=sys.stderr)
        return 2
    try:
        key, line = new_key(arguments[1])
    except KeysError as error:
        print(error, file=sys.stderr)
        return 2
    print(f"the key, shown this once: {key}", file=sys.stderr)
    print(line)
    return 0
