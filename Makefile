# `make run` and `make test` are all a newcomer needs; both set up what they use, once.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready

.PHONY: run test types bounds lint verify docs bench lock clean

run: $(READY)  ## Drive the shipped city, and show what came of it
	$(BIN)/cosim run

test: $(READY)  ## The tests
	$(BIN)/python -m pytest -q -n 2

types: $(READY)  ## Shapes and types of arrays, checked while the tests of trust run
	$(BIN)/python -m pytest -q -n 2 --typecheck=trust tests/trust

bounds: $(READY)  ## Index ranges of all kernels, checked while the tests run; compiles everything anew
	rm -rf build/bounds
	NUMBA_BOUNDSCHECK=1 NUMBA_CACHE_DIR=$(CURDIR)/build/bounds $(BIN)/python -m pytest -q -n 2

lint: $(READY)  ## Style and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check --quiet .
	$(BIN)/mypy

verify: $(READY)  ## Everything, the slow verification included
	$(BIN)/ruff check .
	$(BIN)/ruff format --check --quiet .
	$(BIN)/mypy
	$(BIN)/python -m pytest -q -n 2 -m ""

docs: $(READY) $(VENV)/.docs  ## The documentation site, in build/site; warnings are errors
	$(BIN)/python -m cosim.docs.site build/site
	@echo "build/site/index.html"

bench: $(READY)  ## Speed, with peers in the same run
	$(BIN)/cosim bench

lock:  ## Pin the dependencies anew (needs uv)
	uv pip compile -q pyproject.toml --extra dev --extra build --universal --python-version 3.11 --no-emit-index-url --no-header --generate-hashes -o requirements.lock
	uv pip compile -q pyproject.toml --extra docs -c requirements.lock --universal --python-version 3.11 --no-emit-index-url --no-header --generate-hashes -o cosim/docs/requirements.lock

clean:
	rm -rf $(VENV) build *.egg-info

$(READY): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit("cosim needs Python 3.11 or newer; say which with make PYTHON=...") if sys.version_info < (3, 11) else None'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	@touch $(READY)

$(VENV)/.docs: $(READY) cosim/docs/requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r cosim/docs/requirements.lock
	@touch $(VENV)/.docs
