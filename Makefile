# Everything that a clone needs; `make` lists it. What is installed goes into .venv, what is built into build.

VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check install --constraint constraints.txt

# The first Python that is new enough; `make PYTHON=python3.13 ...` chooses another.
PYTHON ?= $(firstword $(foreach name,python3 python3.14 python3.13 python3.12 python3.11,$(shell \
	$(name) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $(name))))
ifeq ($(origin CXX),default)
CXX := c++
endif
# Where the package's build looks for cmake, and cmake for ninja.
export PATH := $(CURDIR)/$(BIN):$(PATH)

CXX_FOLDERS := cpp mitsuba_ext tungsten_ext tests/cpp
CXX_SOURCES := $(shell find $(CXX_FOLDERS) -name '*.[ch]pp')
BUILD_FILES := pyproject.toml setup.py $(shell find CMakeLists.txt $(CXX_FOLDERS) -name CMakeLists.txt)

.DEFAULT_GOAL := help
MAKEFLAGS += --no-print-directory
.PHONY: help demo test stress fuzz sanitize lint format clean

help: ## list what can be made
	@sed -n 's/^\([a-z]*\):.*## \(.*\)/\1 \2/p' Makefile | while read -r goal does; do \
		printf '  make %-8s %s\n' "$$goal" "$$does"; done

demo: $(VENV)/installed ## render examples/cornell-box with little light, denoise it into demo/
	@mkdir -p demo
	$(BIN)/tungsten --dip-denoise --spp 8 --output-directory demo --dip-report demo/report.html \
		examples/cornell-box/scene.json

test: build/dev/build.ninja ## run every test, C++ and Python
	$(BIN)/cmake --build build/dev
	$(BIN)/ctest --test-dir build/dev --output-on-failure
	$(BIN)/python -m pytest

stress: $(VENV)/developing ## try hard cases, kills, full disks, hostile files; PAGE=docs/hard-cases.md writes the page
	PYTHONPATH=tests/python $(BIN)/python tests/stress $(if $(PAGE),--page $(PAGE))

sanitize: $(VENV)/developing ## run the C++ tests under the address, undefined and thread sanitizers
	for preset in asan tsan; do \
		$(BIN)/cmake --preset $$preset -DPython_EXECUTABLE="$(CURDIR)/$(BIN)/python" \
		&& $(BIN)/cmake --build --preset $$preset && $(BIN)/ctest --preset $$preset || exit 1; \
	done

fuzz: $(VENV)/developing ## let atheris search for files that break a reader; SECONDS_EACH=60 for every reader
	$(PIP) atheris
	PYTHONPATH=tests/python $(BIN)/python tests/fuzz --seconds $(or $(SECONDS_EACH),60)

lint: build/dev/build.ninja ## check style and types of all code
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/clang-format --dry-run --Werror $(CXX_SOURCES)
	$(BIN)/python $(BIN)/run-clang-tidy.py -quiet -clang-tidy-binary $(BIN)/clang-tidy -p build/dev

format: $(VENV)/developing ## bring all code into shape
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .
	$(BIN)/clang-format -i $(CXX_SOURCES)

clean: ## remove everything that was installed or built
	rm -rf $(VENV) build demo python/*.egg-info python/tungsten_dip/bin .mypy_cache .ruff_cache .pytest_cache .hypothesis
	find python tests -name __pycache__ -prune -exec rm -rf {} +
	find python -name '*.so' -exec rm {} +

# $(call missing,what,Debian's packages,Fedora's packages,the command on macOS): say so and stop.
missing = { printf '%s\n' 'This needs $(1). It comes with:' '  Debian, Ubuntu   apt install $(2)' \
	'  Fedora           dnf install $(3)' '  macOS            $(4)' >&2; exit 1; }

$(VENV)/created:
	@test -n "$(PYTHON)" \
		|| $(call missing,Python 3.11 or newer,python3 python3-venv python3-dev,python3 python3-devel,brew install python)
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null \
		|| $(call missing,the Python module venv,python3-venv,python3,brew install python)
	@$(PYTHON) -c 'import os, sysconfig; os.stat(sysconfig.get_path("include") + "/Python.h")' 2>/dev/null \
		|| $(call missing,the header files of Python,python3-dev,python3-devel,brew install python)
	@printf '#include <concepts>\n#include <span>\nint main() {}\n' | $(CXX) -std=c++20 -x c++ -fsyntax-only - \
		|| $(call missing,a compiler for C++20 (GCC 11 or Clang 14),g++,gcc-c++,xcode-select --install)
	@echo "Creating $(VENV) with $$($(PYTHON) --version)"
	$(PYTHON) -m venv $(VENV)
	@touch $@

# Built against the packages in .venv (the plugin needs the very Mitsuba that loads it), hence without isolation.
$(VENV)/installed: $(VENV)/created constraints.txt $(BUILD_FILES) $(CXX_SOURCES)
	@echo "Installing what it needs and building the C++ parts: some minutes the first time"
	$(BIN)/python -c 'import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["build-system"]["requires"], sep="\n")' \
		>$(VENV)/build-requirements.txt
	$(PIP) --requirement $(VENV)/build-requirements.txt
	$(PIP) --no-build-isolation --editable '.[mitsuba]'
	@touch $@

$(VENV)/developing: $(VENV)/installed
	$(PIP) --no-build-isolation --editable '.[dev]'
	@touch $@

build/dev/build.ninja: $(VENV)/developing CMakePresets.json
	$(BIN)/cmake --preset dev -DPython_EXECUTABLE="$(CURDIR)/$(BIN)/python"
	@touch $@
