# make setup [PYTHON=python3.12] [ROS_DISTRO=kilted], then make demo, test, bench, lint.
# make test TESTS='-m nodes' runs a part: what follows is handed to pytest. The whole is two runs:
# tests that start nodes have the machine to themselves. VERSIONS=oldest: with the oldest versions of
# the Python packages that starcal is tested on, in an environment of their own; no linters there.
ROS_DISTRO ?= jazzy
VERSIONS ?= newest
VENV := .venv$(filter-out -jazzy,-$(ROS_DISTRO))$(filter-out -newest,-$(VERSIONS))
# An environment keeps the interpreter it was made with unless another is asked for.
PYTHON ?= $(or $(wildcard $(VENV)/bin/python),python3)
RUN := $(VENV)/bin

.PHONY: setup demo test bench lint

setup:
	@$(PYTHON) tools/make_venv.py $(VENV) --ros $(ROS_DISTRO) --versions $(VERSIONS)

demo: setup
	$(RUN)/starcal demo

test: setup
ifdef TESTS
	$(RUN)/python -m pytest $(TESTS)
else
	@failed=0; \
	for part in "-m 'not nodes' --numprocesses 2" "-m nodes"; do \
		echo "$(RUN)/python -m pytest $$part"; \
		eval $(RUN)/python -m pytest $$part || failed=1; \
	done; \
	exit $$failed
endif

bench: setup
	@$(RUN)/python -m pip install --quiet --requirement requirements/bench.txt
	$(RUN)/python -m bench

lint: setup
	$(RUN)/ruff check
	$(RUN)/ruff format --check
	$(RUN)/mypy
	$(RUN)/lint-imports --no-logo
