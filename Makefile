# `make serve` and `make test` do all the set-up themselves. `make help` lists the rest.
#
# Two environments: .venv holds what the service needs and no torch, .venv-dev everything else (training, tests, checks).

PORT ?= 8000
PYTHON ?= python3
PYTEST_ARGS ?=
PIP_INSTALL := -m pip install --quiet --disable-pip-version-check --constraint constraints.txt

export ORT_DISABLE_TELEMETRY := 1

BUILD_INPUTS := pyproject.toml setup.py constraints.txt pointfilter/_native.cpp

.PHONY: help serve test check format dev examples image upgrade clean

help:
	@echo "make serve     set up .venv and start the service on PORT ($(PORT))"
	@echo "make test      set up .venv-dev and run all tests (PYTEST_ARGS=... for some)"
	@echo "make check     ruff, mypy, import contracts"
	@echo "make format    let ruff rewrite what it can"
	@echo "make dev       set up .venv-dev: training, export, tests, checks"
	@echo "make examples  write examples/ anew"
	@echo "make image     build the container image pointfilter:latest"
	@echo "make upgrade   renew constraints.txt with the newest versions"
	@echo "make clean     remove the environments and what builds left"

serve: .venv/ready
	POINTFILTER_PORT=$(PORT) exec .venv/bin/python -m service

test: .venv-dev/ready
	.venv-dev/bin/python -m pytest $(PYTEST_ARGS)

check: .venv-dev/ready
	.venv-dev/bin/ruff check
	.venv-dev/bin/ruff format --check
	.venv-dev/bin/mypy
	.venv-dev/bin/lint-imports

format: .venv-dev/ready
	.venv-dev/bin/ruff check --fix
	.venv-dev/bin/ruff format

dev: .venv-dev/ready

examples: .venv-dev/ready
	.venv-dev/bin/python -m examples.make

image:
	docker build -t pointfilter:latest -f docker/Dockerfile .

.venv/ready: $(BUILD_INPUTS) | compiler
	$(PYTHON) -m venv .venv
	.venv/bin/python $(PIP_INSTALL) --editable '.[service]'
	touch $@

.venv-dev/ready: $(BUILD_INPUTS) | compiler
	$(PYTHON) -m venv .venv-dev
	.venv-dev/bin/python $(PIP_INSTALL) --editable '.[service,training,export,benchmarks,dev]'
	touch $@

.PHONY: compiler
compiler:
	@command -v c++ >/dev/null || command -v g++ >/dev/null || command -v clang++ >/dev/null || { \
	  echo "a C++17 compiler is needed to build pointfilter/_native.cpp (Debian: apt-get install g++)" >&2; exit 1; }
	@$(PYTHON) -c 'import os, sys, sysconfig as s; sys.exit(not os.path.exists(s.get_path("include") + "/Python.h"))' || { \
	  echo "Python.h is missing (Debian: apt-get install python3-dev)" >&2; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "Python 3.11 or newer is needed; say which with PYTHON=python3.12" >&2; exit 1; }

# Newest versions of everything but torch, then run the tests before committing the new constraints.txt.
upgrade:
	$(PYTHON) -m venv .venv-upgrade
	grep '^torch==' constraints.txt >.venv-upgrade/torch.txt
	.venv-upgrade/bin/python -m pip install --quiet --constraint .venv-upgrade/torch.txt \
	  --editable '.[service,training,export,benchmarks,dev]'
	{ grep '^#' constraints.txt; .venv-upgrade/bin/pip freeze --exclude-editable | sed 's/+cpu$$//'; } >.venv-upgrade/new.txt
	mv .venv-upgrade/new.txt constraints.txt

clean:
	rm -rf .venv .venv-dev .venv-upgrade build dist *.egg-info pointfilter/*.so
