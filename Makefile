# Copyright 2026 The ba_node Authors
# SPDX-License-Identifier: Apache-2.0

# The Python that .venv is made with; empty: the first of python3, python3.13 ... python3.10 that is 3.10 to 3.13.
PYTHON ?=
# More arguments for the command that runs, for example: make test ARGS="-k solver"
ARGS ?=

RUN := .venv/bin/python
# Three at a time for two cores, as tests/conftest.py groups them: one waits for DDS most of its time. What is compiled
# once is kept, whatever the environment says: each process that a test starts would compile all of it anew.
PYTEST := PYTHONDONTWRITEBYTECODE= OPENBLAS_NUM_THREADS=1 $(RUN) -m pytest -n 3 --dist loadgroup --no-loadscope-reorder
CHECKED := ba_node experiments tests tools setup.py $(wildcard launch/*.py)
STYLED := $(CHECKED) examples docs/conf.py
CPP = $(shell find ba_node examples experiments tests -name '*.[ch]pp')

.PHONY: help setup demo test test-all fuzz soak sanitize cross wheel bench thesis robustness consistency regress docs lint format clean

help: ## list the commands
	@sed -n 's/^\([a-z-]*\):.*## /\1\t/p' $(firstword $(MAKEFILE_LIST)) | expand -t 12

setup: ## make .venv with ROS 2 Jazzy, ba_msgs and ba_node; the commands below do it by themselves
	@PYTHON="$(PYTHON)" sh tools/setup.sh

demo: setup ## play a recording into the node over DDS, compare with ground truth, write out/demo/
	@$(RUN) -m ba_node.cli.main demo --out out/demo $(ARGS)

test: setup ## run the quick tests (about 6 minutes on two cores; ARGS="-k solver", ARGS="-m slow")
	@$(PYTEST) -m "not slow" $(ARGS)

test-all: setup ## run all tests, the slow ones too
	@$(PYTEST) $(ARGS)

fuzz: setup ## give readers and back-end 50 000 broken files and 200 000 broken messages (about 20 minutes)
	@$(RUN) -m tests.fuzz $(ARGS)

soak: setup ## run back-end and node for long, and see that nothing grows (about 20 minutes)
	@$(RUN) -m tests.soak $(ARGS)

sanitize: setup ## run the tests of the C++ kernels under Address-, UndefinedBehaviour- and ThreadSanitizer
	@sh tools/sanitize.sh $(ARGS)

cross: setup ## build the C++ kernels for aarch64 and run their tests in C++ under an emulator, where both are installed
	@sh tools/native_tests.sh aarch64

wheel: setup ## build a wheel into out/wheel/, and try it in a fresh environment without a compiler
	@sh tools/wheel.sh

bench: setup ## compare with the solvers that are installed, see docs/performance.md (ARGS="--quick": two windows)
	@$(RUN) -m experiments.benchmarks $(ARGS)

thesis: setup ## repeat experiments of the thesis (ARGS="3.8 5.1", ARGS="--all", ARGS="--list")
	@$(RUN) -m ba_node.cli.main thesis $(ARGS)

robustness: setup ## replay recordings gone wrong, and see that no harm is done (ARGS="--only camera_turned")
	@$(RUN) -m ba_node.cli.main robustness $(ARGS)

consistency: setup ## compare errors with covariances in 200 runs of each of 28 cases (about 20 minutes; ARGS="--only stereo")
	@OPENBLAS_NUM_THREADS=1 $(RUN) -m experiments.consistency $(ARGS)

regress: setup ## replay the shipped recordings and see that no figure is worse than in bags/regress.yaml
	@$(RUN) -m ba_node.cli.main regress bags/regress.yaml $(ARGS)

docs: setup ## build the documentation as a site into out/docs; any warning is an error (Python 3.11 or later)
	@$(RUN) -m sphinx -W --keep-going -q -b html docs out/docs $(ARGS)

lint: setup ## check style and types
	@$(RUN) -m ruff check $(STYLED)
	@$(RUN) -m ruff format --check $(STYLED)
	@.venv/bin/clang-format --dry-run -Werror $(CPP)
	@$(RUN) -m mypy $(CHECKED)

format: setup ## put all files of Python and C++ into the agreed style
	@$(RUN) -m ruff check --fix $(STYLED)
	@$(RUN) -m ruff format $(STYLED)
	@.venv/bin/clang-format -i $(CPP)

clean: ## remove .venv and everything else that commands have made
	@rm -rf .venv build install log out *.egg-info .hypothesis .mypy_cache .pytest_cache .ruff_cache
	@find ba_node experiments tests tools launch -name __pycache__ -prune -exec rm -rf {} +
