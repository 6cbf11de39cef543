from __future__ import annotations

import subprocess
import sys

import pointfilter
from pointfilter import errors


def test_the_public_names_are_these() -> None:
    assert pointfilter.__all__ == [
        "Engine",
        "Filtered",
        "Look",
        "ModelBundle",
        "PointCloud",
        "PointfilterError",
        "Radius",
        "ReadLimits",
        "Report",
        "__version__",
        "available_models",
        "filter_cloud",
        "filter_points",
        "find_model",
        "load_bundle",
        "look",
    ]
    assert all(hasattr(pointfilter, name) for name in pointfilter.__all__)


def test_the_core_loads_no_torch_and_no_web() -> None:
    script = (
        "import sys, pointfilter, pointfilter.cli\n"
        "print([name for name in ('torch', 'onnx', 'fastapi', 'pydantic', 'training', 'export', 'service') "
        "if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def children(kind: type[errors.PointfilterError]) -> list[type[errors.PointfilterError]]:
    """Those of the core: the service adds classes of its own when its tests run in the same process."""
    return [child for child in kind.__subclasses__() if child.__module__ == errors.__name__]


def tree(kind: type[errors.PointfilterError]) -> list[type[errors.PointfilterError]]:
    return [kind, *(below for child in children(kind) for below in tree(child))]


def test_every_error_has_a_code_of_its_own_and_is_in_the_drawing() -> None:
    kinds = tree(errors.PointfilterError)
    codes = [kind.__dict__["code"] for kind in kinds]
    assert len(set(codes)) == len(kinds) > 10
    lines = (errors.__doc__ or "").splitlines()
    for kind in kinds:
        (line,) = [line for line in lines if kind.__name__ in line.replace("─", " ").split()]
        if not children(kind):
            assert kind.code in line.split()


def test_the_drawing_shows_who_descends_from_whom() -> None:
    """Indentation in the drawing is inheritance in the code."""
    parents: list[str] = []
    for line in (errors.__doc__ or "").splitlines():
        words = line.replace("│", " ").replace("├──", "   ").replace("└──", "   ")
        name = words.split()[0] if words.strip() else ""
        if not name.endswith("Error") or not hasattr(errors, name):
            continue
        depth = (len(words) - len(words.lstrip()) - 4) // 4
        parents[depth:] = [name]
        if depth:
            assert getattr(errors, name).__base__.__name__ == parents[depth - 1]
    assert parents


def test_an_error_says_what_to_do() -> None:
    error = errors.LimitExceededError("too much", limit=3, actual=4, hint="take less")
    assert str(error) == "too much (take less)"
    assert (error.message, error.limit, error.actual) == ("too much", 3, 4)
    assert str(errors.InputError("no")) == "no"
