# Each target sets up .venv/ by itself, once, and again when the pins change. Python 3.11 or newer and make are all it needs.
PYTHON ?= python3
VENV := .venv
PY := $(VENV)/bin/python
READY := $(VENV)/.ready
# There while pip works: an install that was cut off is made again from nothing.
CUT_OFF := $(VENV)/.installing
PIP := $(PY) -m pip --disable-pip-version-check --no-input install -qq -c constraints.txt

# What one process has compiled to bytecode the others read, where the environment says otherwise too.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: demo live paper test lint types docs FORCE
.DELETE_ON_ERROR:

demo: $(READY)
	@$(PY) -m hdev_jax.cli demo --out out/demo

live: $(READY)
	@$(PY) -m experiments.live $(ARGS)

paper: $(READY)
	@$(PY) -m experiments configs/paper.toml --out out/paper --workers 0 $(ARGS)

# One thread for each of the processes that run tests side by side: threads that wait for each other's cores take longer
# than the sums they share. NPROC is XLA's pool. What takes long is left out: make test ARGS="-m slow".
test: export OMP_NUM_THREADS := 1
test: export OPENBLAS_NUM_THREADS := 1
test: export NPROC := 1
test: export XLA_FLAGS := $(XLA_FLAGS) --xla_cpu_multi_thread_eigen=false
test: $(READY)
	@$(PY) -m pytest -n auto --maxprocesses 4 --dist worksteal -m "not slow" $(ARGS)

lint: $(READY)
	@$(PY) -m ruff check .
	@$(PY) -m ruff format --check .

# Then whether every public name has a type; its long list is shown only where one has none.
types: $(READY)
	@$(PY) -m pyright
	@found=$$(PATH="$(CURDIR)/$(VENV)/bin:$$PATH" PYTHONPATH=. \
	    $(PY) -m pyright --verifytypes hdev_jax --ignoreexternal) || { echo "$$found"; exit 1; }

# The site, into out/site: runs the notebooks, draws the effects, checks every link between its pages.
docs: export NO_MKDOCS_2_WARNING := 1
docs: export PYDEVD_DISABLE_FILE_VALIDATION := 1
docs: $(READY)
	@$(PIP) --no-build-isolation -e '.[docs]'
	@$(PY) -m mkdocs build --quiet
	@echo "the site is in out/site: open out/site/index.html"

$(READY): pyproject.toml constraints.txt $(if $(wildcard $(PY)),,FORCE)
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || \
	    { echo "hdev needs Python 3.11 or newer: $$($(PYTHON) --version 2>&1 | head -n 1). Try: make PYTHON=python3.12 $(MAKECMDGOALS)" >&2; exit 1; }
	@if [ -e $(CUT_OFF) ] || ! $(PY) -m pip --version >/dev/null 2>&1; then \
	    echo "setting up $(VENV)/ with $$($(PYTHON) --version)"; \
	    $(PYTHON) -m venv --clear $(VENV) || \
	    { echo "hdev needs Python's venv module (Debian, Ubuntu: apt install python3-venv)" >&2; exit 1; }; \
	fi
	@touch $(CUT_OFF)
	@echo "installing $$(grep -c == constraints.txt) pinned packages into $(VENV)/ (a few minutes the first time)"
	@$(PIP) hatchling editables
	@$(PIP) --no-build-isolation -e '.[test,dev,experiments,fleet,nuts,can]'
	@rm -f $(CUT_OFF)
	@touch $@
	@echo "$(VENV)/ is ready"

FORCE:
