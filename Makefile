# Everything here works on a fresh machine with Python 3.11 or newer; uv is used where it is installed.
VENV := .venv
INSTALLED := $(VENV)/.installed
SHELL := /bin/bash
EXTRAS ?= dev

.PHONY: demo test check bench docs venv
.DEFAULT_GOAL := demo

demo: $(INSTALLED)
	$(VENV)/bin/graspmatch demo --folder demo

test: $(INSTALLED)
	$(VENV)/bin/python -m pytest

check: $(INSTALLED)
	$(VENV)/bin/ruff check --quiet
	$(VENV)/bin/ruff format --check --quiet
	$(VENV)/bin/pyright

bench: $(INSTALLED)
	$(VENV)/bin/python bench/run.py

docs: $(INSTALLED)
	$(VENV)/bin/mkdocs build --strict --quiet --site-dir build/site
	@echo "Open build/site/index.html"

venv: $(INSTALLED)

# Made again only when the dependencies may have changed.
$(INSTALLED): pyproject.toml
	@if command -v uv >/dev/null; then \
	    echo "Setting up $(VENV) with uv"; \
	    { test -x $(VENV)/bin/python || uv venv --quiet --python '>=3.11' $(VENV); } && \
	    uv pip install --quiet --python $(VENV)/bin/python --editable '.[$(EXTRAS)]'; \
	else \
	    $(MAKE) --no-print-directory venv-without-uv; \
	fi
	@touch $@

.PHONY: venv-without-uv
venv-without-uv:
	@for name in python3 python3.14 python3.13 python3.12 python3.11 python; do \
	    if $$name -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then python=$$name; break; fi; \
	done; \
	if test -z "$$python"; then echo "graspmatch needs Python 3.11 or newer on the PATH, or uv." >&2; exit 1; fi; \
	echo "Setting up $(VENV) with $$($$python --version)"; \
	{ test -x $(VENV)/bin/python || $$python -m venv $(VENV) || \
	  { rm -rf $(VENV); echo "$$python cannot make a virtual environment: install its venv module, or uv." >&2; exit 1; }; } && \
	$(VENV)/bin/python -m pip install -qq --disable-pip-version-check --editable '.[$(EXTRAS)]'
