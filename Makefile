# `make run` and `make test` are all a newcomer needs; both set up what they use, once. `make test` installs more.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
TESTS := $(VENV)/.tests

.PHONY: run test types bounds lint verify pages figures docs bench extra lock clean

run: $(READY)  ## Simulate the shipped city and print a summary
	$(BIN)/cosim run

test: $(TESTS)  ## The tests
	$(BIN)/python -m pytest -q -n 2 --dist worksteal

types: $(TESTS)  ## Check shapes and types of arrays while the tests of trust run
	$(BIN)/python -m pytest -q -n 2 --typecheck=trust tests/trust

bounds: $(TESTS)  ## Check index ranges of all kernels while the tests run; compiles everything again
	rm -rf build/bounds
	NUMBA_BOUNDSCHECK=1 NUMBA_CACHE_DIR=$(CURDIR)/build/bounds $(BIN)/python -m pytest -q -n 2 --dist worksteal

lint: $(TESTS)  ## Style and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check --quiet .
	$(BIN)/mypy

verify: $(TESTS) $(VENV)/.readers  ## All checks and tests, including the slow ones
	$(BIN)/ruff check .
	$(BIN)/ruff format --check --quiet .
	$(BIN)/mypy
	$(BIN)/python -m pytest -q -n 2 -m ""

pages: $(TESTS)  ## Run the commands of the pages that show output, and record anew what they print
	$(BIN)/python -m pytest -q -n 2 -m verify tests/cosim/docs/test_commands_run.py -k test_a_page --record-pages

figures: $(TESTS)  ## Make the figures of the pages anew, over night, and list what moved
	$(BIN)/python -m tests.verification.figures

docs: $(TESTS) $(VENV)/.docs  ## The documentation site, in build/site; warnings are errors
	$(BIN)/python -m cosim.docs.site build/site
	@echo "build/site/index.html"

bench: $(TESTS)  ## Measure speed, with other implementations in the same run
	$(BIN)/python -m tests.bench

EXTRAS = $(shell sed -n '/^.project.optional-dependencies/,/^$$/s/^\([a-z0-9]*\) = .*/\1/p' pyproject.toml)
extra: $(READY)  ## Install one of the extras of pyproject.toml: make extra NAME=open3d
	@case " $(EXTRAS) " in *" $(NAME) "*) ;; *) echo "no extra \"$(NAME)\". Say which: $(EXTRAS)"; exit 2;; esac
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable ".[$(NAME)]"

LOCK := echo "setuptools>=77" | uv pip compile -q pyproject.toml - --universal --python-version 3.11 --no-emit-index-url --no-header --generate-hashes

lock:  ## Pin the dependencies again (needs uv): of a run, of the tests, of the pages
	$(LOCK) -o requirements.lock
	$(LOCK) --extra dev -c requirements.lock -o tests/requirements.lock
	$(LOCK) --extra docs -c tests/requirements.lock -o cosim/docs/requirements.lock

clean:
	rm -rf $(VENV) build *.egg-info

$(READY): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit("cosim needs Python 3.11 or newer; say which with make PYTHON=...") if sys.version_info < (3, 11) else None'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	@touch $(READY)

$(TESTS): $(READY) tests/requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r tests/requirements.lock
	@touch $(TESTS)

$(VENV)/.docs: $(TESTS) cosim/docs/requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r cosim/docs/requirements.lock
	@touch $(VENV)/.docs

# The last two ask for NumPy 1, and for OpenCV with a screen, and need neither.
$(VENV)/.readers: $(TESTS) pyproject.toml
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-build-isolation --editable ".[readers]"
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps nuscenes-devkit==1.2.0 trackeval==1.3.0
	@touch $(VENV)/.readers
