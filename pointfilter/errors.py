"""Everything that can go wrong, as one tree.

    PointfilterError
    ├── InputError                  the file or the cloud
    │   ├── MalformedFileError        malformed-file          not what its format promises; line or byte named
    │   ├── UnsupportedFormatError    unsupported-format      a format we do not read or write
    │   ├── LimitExceededError        limit-exceeded          larger than a limit; limit, value and knob named
    │   ├── MissingCoordinatesError   missing-coordinates     no usable x, y, z
    │   ├── TooFewPointsError         too-few-points          nothing to filter
    │   └── DegenerateCloudError      degenerate-cloud        no extent to take a radius from
    ├── ParameterError              parameter-out-of-range  radius, iterations, seed, ...
    ├── ModelError
    │   ├── ModelNotFoundError        model-not-found
    │   └── InvalidModelError         invalid-model           damaged, altered or of another version
    ├── ProviderUnavailableError    provider-unavailable    an execution provider that was asked for is not there
    └── FilteringCancelledError     cancelled               somebody asked to stop

Each class has a stable `code`; the service maps codes to HTTP answers in one table (service/problems.py), the command
line maps classes to exit codes in one table (pointfilter.cli). `hint`, where set, says what to do about it.
"""

from __future__ import annotations


class PointfilterError(Exception):
    """Base of all errors raised on purpose by this package."""

    code = "error"

    def __init__(
        self,
        message: str,
        *,
        limit: float | str | None = None,
        actual: float | str | None = None,
        hint: str | None = None,
    ) -> None:
        super().__init__(message)
        self.message = message
        self.limit = limit
        self.actual = actual
        self.hint = hint

    def __str__(self) -> str:
        return f"{self.message} ({self.hint})" if self.hint else self.message


class InputError(PointfilterError):
    code = "invalid-input"


class MalformedFileError(InputError):
    code = "malformed-file"


class UnsupportedFormatError(InputError):
    code = "unsupported-format"


class LimitExceededError(InputError):
    code = "limit-exceeded"


class MissingCoordinatesError(InputError):
    code = "missing-coordinates"


class TooFewPointsError(InputError):
    code = "too-few-points"


class DegenerateCloudError(InputError):
    code = "degenerate-cloud"


class ParameterError(PointfilterError):
    code = "parameter-out-of-range"


class ModelError(PointfilterError):
    code = "model-error"


class ModelNotFoundError(ModelError):
    code = "model-not-found"


class InvalidModelError(ModelError):
    code = "invalid-model"


class ProviderUnavailableError(PointfilterError):
    code = "provider-unavailable"


class FilteringCancelledError(PointfilterError):
    code = "cancelled"
