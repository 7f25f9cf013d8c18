# make demo | test | check | build | setup | peers | format | clean

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
PIP := $(BIN)/python -m pip --disable-pip-version-check
OUT ?= runs/demo
MEASUREMENTS ?=

.DEFAULT_GOAL := help
.PHONY: help setup peers demo test check static format build clean
.NOTPARALLEL:

help:
	@echo "make demo    the tour: ground a simulator, find a hidden effect; report in $(OUT)/report.html"
	@echo "             (MEASUREMENTS=FOLDER adds real recordings of a free pendulum)"
	@echo "make test    the tests"
	@echo "make check   format, lint, types, import contracts, tests"
	@echo "make build   the wheel, and a trial of it in a clean environment"
	@echo "make setup   only what the others need: $(VENV) with the locked dependencies"
	@echo "make peers   the libraries beside which adapters are tested and speed is measured"
	@echo "make format  put the code into its format"
	@echo "make clean   remove builds and caches, not $(VENV) and not runs"

setup: $(STAMP)

$(STAMP): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "make setup: Python 3.11 or newer is needed; name one: make setup PYTHON=python3.11" >&2; exit 1; }
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(PIP) install --quiet -r requirements.lock || $(MAKE) --no-print-directory install-without-locked-nightly
	$(PIP) install --quiet --no-deps --no-build-isolation --config-settings editable_mode=compat -e .
	@touch $@

# For the day when no build in the locked range of tfp-nightly is left in the registry.
.PHONY: install-without-locked-nightly
install-without-locked-nightly:
	@echo "make setup: the locked set did not install; trying it with another build of tfp-nightly" >&2
	grep -v '^tfp-nightly' requirements.lock > $(VENV)/without-nightly.txt
	$(PIP) install --quiet --no-deps -r $(VENV)/without-nightly.txt
	$(PIP) install --quiet --no-deps --pre tfp-nightly \
		|| $(PIP) install --quiet --no-deps 'tensorflow-probability>=0.26'
	@$(BIN)/python -W ignore -c 'import distrax' \
		|| { echo "make setup: distrax does not work with the build that was found" >&2; exit 1; }

peers: setup
	$(PIP) install --quiet -c requirements.lock -r requirements-peers.lock

demo: setup
	$(BIN)/garat demo --out $(OUT) --force $(if $(MEASUREMENTS),--measurements $(MEASUREMENTS))

test: setup
	@$(BIN)/python -m pytest --numprocesses auto --maxprocesses 4 --dist loadfile

check: static test

static: setup
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright
	$(BIN)/lint-imports --no-logo

format: setup
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

build: setup
	rm -rf build dist
	$(BIN)/python -m build --no-isolation
	$(PYTHON) -m venv build/trial
	build/trial/bin/python -m pip --disable-pip-version-check install --quiet -c requirements.lock dist/*.whl
	cd build/trial && bin/python -I -c 'import garat_jax, garat_jax.envs, pathlib; \
		assets = pathlib.Path(garat_jax.envs.__file__).parent / "assets"; \
		assert any(assets.glob("*.xml")), f"no MJCF in {assets}"; print(garat_jax.__version__, assets)'
	cd build/trial && bin/garat --help > /dev/null && bin/garat list

clean:
	rm -rf build dist *.egg-info .pytest_cache .ruff_cache .import_linter_cache .hypothesis
	find . -name __pycache__ -type d -not -path './$(VENV)/*' -prune -exec rm -rf {} +
