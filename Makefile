# make demo: install, train Hopper and show the result         make test: install and run the tests
# make lint: ruff and mypy                                     make test-all: the same with the longest lists
# make docs: build the site in build/site                      make clean: remove what these made
#
# Another Python: make demo PYTHON=python3.12

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALL := $(BIN)/python -m pip install --disable-pip-version-check -c constraints.txt

.PHONY: demo docs test test-all test-room lint clean

demo: $(VENV)/installed-viz
	$(BIN)/lyceum-warp train hopper --iterations 80 --target-return 3000 --video \
		--out runs/demo-$$(date +%Y%m%d-%H%M%S) --require-return 1000

# Several processes, each with whole files, whose tests share environments. The folders with the longest files begin.
PYTEST := $(BIN)/python -m pytest --numprocesses auto --maxprocesses 8 --dist loadfile --no-loadscope-reorder

test: $(VENV)/installed-dev
	$(PYTEST)

test-all: $(VENV)/installed-dev
	$(PYTEST) -m "long or not long"

# make test-room ROOM=algos: one room of the package, by the tests that mirror it
test-room: $(VENV)/installed-dev
	$(PYTEST) $(or $(wildcard tests/$(ROOM) tests/test_$(ROOM).py),$(error tests/ has no room "$(ROOM)"))

lint: $(VENV)/installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# Every page is built again, because pages depend on the package; the notebooks take most of the time
docs: $(VENV)/installed-docs
	MUJOCO_GL=$${MUJOCO_GL:-egl} $(BIN)/python -m sphinx --fresh-env --fail-on-warning --keep-going --quiet \
		--conf-dir docs --doctree-dir build/doctrees . build/site
	@echo "the site: build/site/index.html"

clean:
	rm -rf $(VENV) build dist .pytest_cache .mypy_cache .ruff_cache

# The install is editable: it is repeated only when the list of dependencies changes. constraints.txt pins torch
# so that pip takes a local build of the tested version, where there is one, rather than the newest.
$(VENV)/installed-%: pyproject.toml constraints.txt | $(VENV)/bin/python
	$(INSTALL) -e '.[$*]'
	@touch $@

$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14))' || \
		{ echo "lyceum_warp needs Python 3.11 to 3.13: make $(MAKECMDGOALS) PYTHON=python3.12" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)
