"""The compiled part of the package. Everything else about the build is in pyproject.toml."""

import sys

from setuptools import Extension, setup

# -ffp-contract=off: the same arithmetic on every machine, so that results do not depend on where the wheel was built.
FLAGS = ["/O2", "/std:c++17"] if sys.platform == "win32" else ["-O3", "-std=c++17", "-ffp-contract=off"]

setup(
    ext_modules=[
        Extension(
            "pointfilter._native",
            ["pointfilter/_native.cpp"],
            define_macros=[("Py_LIMITED_API", "0x030B0000")],
            extra_compile_args=FLAGS,
            py_limited_api=True,
        )
    ],
    options={"bdist_wheel": {"py_limited_api": "cp311"}},
)
