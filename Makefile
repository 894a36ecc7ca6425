# Two commands do all the set-up: `make run` and `make test`. `make help` lists the rest.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALL := $(BIN)/pip install --quiet --disable-pip-version-check
LOCKED := $(INSTALL) --require-hashes --no-deps --only-binary :all:
OURSELVES := $(INSTALL) --no-deps --no-build-isolation --editable .
locks = $(patsubst %,requirements/%.txt,$(1))
SCENARIO ?= scenarios/paper.yaml
PYTEST_ARGS ?=

SOAK_ARGS = $(if $(ROW),--row $(ROW)) $(if $(SEED),--seed $(SEED)) $(if $(SHORT),--short)

.PHONY: help run test soak golden check format figures experiments schema docs build lock sbom \
  licences audit clean

help:
	@echo "make run      install, run $(SCENARIO), print where the log and the figures are"
	@echo "make test     install what the tests need and run them all"
	@echo "make soak     prove what docs/reliability.md says, in under two hours; ROW=5 one row of it"
	@echo "make golden   write this machine's golden hashes into tests/golden.json"
	@echo "make check    format, lint and type checks"
	@echo "make format   format and fix what can be fixed"
	@echo "make figures  draw the pictures of the README and docs anew"
	@echo "make experiments  tune, compare and audit all that docs/findings.md quotes; long"
	@echo "make schema   write scenarios/scenario.schema.json anew"
	@echo "make docs     build the documentation site; open site/index.html"
	@echo "make build    build wheel and sdist into dist/"
	@echo "make lock     requirements/ anew, after a change of constraints.txt or pyproject.toml"
	@echo "make sbom     a bill of materials of all that is installed, dist/sbom.json"
	@echo "make licences check the licence of all that is installed"
	@echo "make audit    ask for known vulnerabilities of all that is locked"
	@echo "make clean    remove the environment and all caches"

run: $(VENV)/.installed-run
	$(BIN)/dnnmso run $(SCENARIO)

test: $(VENV)/.installed-check
	$(BIN)/python -m pytest --numprocesses logical --dist loadfile --no-loadscope-reorder \
	  $(PYTEST_ARGS)

soak: $(VENV)/.installed-check
	PYTHONPATH=tests $(BIN)/python -m soak $(SOAK_ARGS)

golden: $(VENV)/.installed-test
	PYTHONPATH=tests $(BIN)/python -m soak.golden

check: $(VENV)/.installed-check
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

format: $(VENV)/.installed-check
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

figures: $(VENV)/.installed-test
	$(BIN)/python docs/make_figures.py

experiments: $(VENV)/.installed-test
	$(BIN)/python docs/experiments.py

schema: $(VENV)/.installed-run
	$(BIN)/dnnmso schema > $(VENV)/schema.json
	mv $(VENV)/schema.json scenarios/scenario.schema.json

docs: $(VENV)/.installed-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet
	@echo "site/index.html; with its search: $(BIN)/python -m http.server --directory site --bind 127.0.0.1"

build: $(VENV)/.installed-test
	$(BIN)/python -m build --no-isolation

lock: $(VENV)/.installed-check
	PYTHONPATH=tests $(BIN)/python -m supply.lock

sbom: $(VENV)/.installed-test
	PYTHONPATH=tests $(BIN)/python -m supply.sbom dist/sbom.json

licences: $(VENV)/.installed-test
	PYTHONPATH=tests $(BIN)/python -m supply.licences

audit: $(VENV)/.installed-test
	PYTHONPATH=tests $(BIN)/python -m supply.audit

clean:
	rm -rf $(VENV) dist site .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(VENV)/bin/pip:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "dnnmso_mj needs Python 3.11 or newer; try: make PYTHON=python3.12" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)

$(VENV)/.installed-run: pyproject.toml $(call locks,run) | $(VENV)/bin/pip
	$(LOCKED) $(patsubst %,--requirement %,$(call locks,run))
	$(OURSELVES)
	@touch $@

$(VENV)/.installed-docs: pyproject.toml $(call locks,run docs) | $(VENV)/bin/pip
	$(LOCKED) $(patsubst %,--requirement %,$(call locks,run docs))
	$(OURSELVES)
	@touch $@ $(VENV)/.installed-run

# torch alone is not locked: a machine may serve a build of its own, in constraints.txt's version.
$(VENV)/.installed-test: pyproject.toml constraints.txt $(call locks,run docs test) | $(VENV)/bin/pip
	$(LOCKED) $(patsubst %,--requirement %,$(call locks,run docs test))
	$(INSTALL) --constraint constraints.txt torch
	$(OURSELVES)
	@touch $@ $(VENV)/.installed-run $(VENV)/.installed-docs

$(VENV)/.installed-check: $(call locks,check) | $(VENV)/.installed-test
	$(LOCKED) $(patsubst %,--requirement %,$(call locks,check))
	@touch $@
