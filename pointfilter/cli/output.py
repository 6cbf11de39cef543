"""Results as JSON or as a table of names and values, for stdout."""

from __future__ import annotations

import json
from typing import Any


def show(described: dict[str, Any], as_json: bool) -> None:
    if as_json:
        print(json.dumps(described))
        return
    width = max(map(len, described))
    for name, value in described.items():
        if isinstance(value, dict):
            for key, entry in value.items():
                text = f"{entry['count']} × {', '.join(entry['properties'])}" if isinstance(entry, dict) else entry
                print(f"{name.ljust(width)}  {_printable(key)}: {_printable(str(text))}")
        elif isinstance(value, list | tuple) and value and isinstance(value[0], str):
            print(f"{name.ljust(width)}  " + ("\n" + " " * (width + 2)).join(map(_printable, value)))
        else:
            print(f"{name.ljust(width)}  {value}")


def _printable(text: str) -> str:
    """Text out of a file, which must not talk to the terminal."""
    return "".join(sign if sign.isprintable() else ascii(sign)[1:-1] for sign in text)
