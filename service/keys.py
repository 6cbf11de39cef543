"""API keys: who may filter. The file holds their names and hashes, never the keys.

A line is `NAME SHA256`; empty lines and lines that begin with # count for nothing. A key is 32 random bytes, so a plain
hash tells nothing about it. Rotation: add a line with a new key, hand it out, remove the old line; requests see the
file's change within a second.
"""

from __future__ import annotations

import hashlib
import hmac
import logging
import re
import secrets
import time
from pathlib import Path

from service.errors import UnauthorizedError

log = logging.getLogger("service.keys")

LOOK_SECONDS = 1.0
_LINE = re.compile(r"(?P<name>[A-Za-z0-9][A-Za-z0-9._-]{0,63})\s+(?P<sha256>[0-9a-f]{64})")


class KeysError(ValueError):
    """The file is not one of keys."""


def new_key(name: str) -> tuple[str, str]:
    """A key and the line for it. Raises KeysError."""
    key = secrets.token_urlsafe(32)
    line = f"{name} {hashlib.sha256(key.encode()).hexdigest()}"
    if not _LINE.fullmatch(line):
        raise KeysError("a key's name is made of 1 to 64 letters, digits, '.', '_' and '-'")
    return key, line


def read_keys(path: Path) -> dict[bytes, str]:
    """Names by hash. Raises KeysError, OSError."""
    found: dict[bytes, str] = {}
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        text = line.strip()
        if text and not text.startswith("#"):
            match = _LINE.fullmatch(text)
            if not match:
                raise KeysError(f"line {number} is not a name and a sha256")
            found[bytes.fromhex(match["sha256"])] = match["name"]
    return found


class Keys:
    """The keys of a file, or none at all where there is no file: then everybody may filter. Raises as read_keys."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._known = read_keys(path) if path else {}
        self._looked = time.monotonic()
        self._stamp = self._stat()

    def caller(self, authorization: str | None) -> str | None:
        """The name of the key in an Authorization header; None where nobody needs one. Raises UnauthorizedError."""
        if self._path is None:
            return None
        self._refresh()
        scheme, _, key = (authorization or "").partition(" ")
        digest = hashlib.sha256(key.strip().encode("utf-8", "surrogateescape")).digest()
        names = [name for known, name in self._known.items() if hmac.compare_digest(known, digest)]  # looks at all
        if scheme.lower() != "bearer" or not names:
            raise UnauthorizedError(
                "this service wants an API key" if not authorization else "the API key is not known"
            )
        return names[0]

    def _refresh(self) -> None:
        """Keeps what it knows while the file is gone or damaged, and says so: that is somebody's half-done edit."""
        if time.monotonic() - self._looked < LOOK_SECONDS or self._path is None:
            return
        self._looked = time.monotonic()
        if (stamp := self._stat()) != self._stamp:
            self._stamp = stamp
            try:
                self._known = read_keys(self._path)
            except (OSError, ValueError) as error:
                why = str(error) if isinstance(error, KeysError) else "it cannot be read"
                log.error("the file of API keys is not taken over, the keys from before stay valid: %s", why)

    def _stat(self) -> tuple[int, int] | None:
        try:
            status = self._path.stat() if self._path else None
        except OSError:
            return None
        return (status.st_mtime_ns, status.st_size) if status else None
