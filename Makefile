# dcam: `make venv`, `make demo`, `make test`, `make check`, `make bench`, `make clean`;
# as root `make install`, `make uninstall`; `make deb`.
# Each makes .venv here and installs what it needs; a second run finds it all in place.
# Another Python (3.11 or newer): make PYTHON=/path/to/python3 test

PYTHON ?= /usr/bin/python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.stamp-installed

.DELETE_ON_ERROR:
.PHONY: help venv demo test exhaustive check bench studies cf picture page-pictures docs clean install uninstall deb

help:
	@echo "make venv    make .venv with all that is needed, and do nothing else: .venv/bin/dcam-ctl"
	@echo "make demo    calibrate, measure 72 slots and more, and compare with the truth: out/demo"
	@echo "make test    run the tests"
	@echo "make exhaustive  the tests that try some of many cases, on every case: a quarter of an hour"
	@echo "make check   lint, types, import contracts"
	@echo "make bench   measure time and memory: docs/benchmarks.md"
	@echo "make studies repeat the studies of accuracy, an hour or so: docs/studies; a second run continues"
	@echo "make cf      have the CF checker look at a NetCDF export"
	@echo "make picture draw docs/images/architecture.svg from the code (needs graphviz)"
	@echo "make page-pictures take docs/images/page-*.png again, from the tests (needs chromium)"
	@echo "make docs    the documents as a site: out/docs/index.html"
	@echo "make install install or upgrade the service, as root: /opt/dcam; make uninstall keeps data"
	@echo "make deb     build a Debian package: dist/"
	@echo "make clean   remove .venv and everything made here"

venv: $(INSTALLED)
	@echo "dcam: .venv is ready: .venv/bin/dcam-ctl --help"

demo: $(INSTALLED)
	$(BIN)/dcam-ctl demo --output out/demo

# Three processes more than cores: much of the time a test waits, for a slot, a camera, a disk.
test: $(INSTALLED)
	@sh .ci/system-packages $(PYTHON) tests
	$(BIN)/python -m pytest --numprocesses $$(($$(nproc) + 3)) --dist loadfile --no-loadscope-reorder

# Each system call, operation on the disk, bit of a header, man page and simulated site, where `make test` takes some.
exhaustive: $(INSTALLED)
	@sh .ci/system-packages $(PYTHON) tests
	DCAM_EXHAUSTIVE=1 $(BIN)/python -m pytest $$(grep -rl tests.exhaustive tests --include='test_*.py') tests/crash

check: $(INSTALLED)
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports --no-logo

bench: $(INSTALLED)
	$(BIN)/python -m benchmarks --output docs/benchmarks.md

studies: $(INSTALLED)
	@sh .ci/system-packages $(PYTHON) studies
	$(BIN)/python -m studies

# The checker brings much that nothing else here needs: it has an environment of its own.
cf: $(INSTALLED)
	[ -x out/cf/bin/compliance-checker ] || { $(PYTHON) -m venv out/cf && \
	  out/cf/bin/python -m pip install --quiet "compliance-checker>=6.1,<7"; }
	$(BIN)/python -m benchmarks.cf out/cf/bin/compliance-checker

picture: $(INSTALLED)
	$(BIN)/python docs/draw_architecture.py

docs: $(INSTALLED)
	$(BIN)/python -m pip install --quiet --group docs
	$(BIN)/python docs/site/build.py out/docs

# What the tests see of the page, as docs/images/page-*.png (needs Debian's chromium).
page-pictures: $(INSTALLED)
	DCAM_PICTURES=$(CURDIR)/docs/images $(BIN)/python -m pytest -q tests/daemon/web -k pictures

# Neither works in this folder's environment: each makes one of its own, with its pip.
install: $(VENV)/.stamp-venv
	@sh .ci/system-packages $(PYTHON) manual
	@PYTHON=$(PYTHON) deploy/install $(BIN)/python

uninstall:
	@deploy/uninstall

deb: $(VENV)/.stamp-venv
	@sh .ci/system-packages $(PYTHON) package
	@PYTHON=$(PYTHON) deploy/make-deb $(BIN)/python dist

clean:
	rm -rf $(VENV) out dist build node_modules daemon/web/static/vendor .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache

# Debian's own Python packages must be seen: the camera library (Aravis) comes with python3-gi only.
$(VENV)/.stamp-venv:
	@sh .ci/system-packages $(PYTHON)
	$(PYTHON) -m venv --system-site-packages $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade "pip>=25.1"
	@touch $@

# The `aravis` extra is for other systems: here PyGObject is Debian's, which pip would not accept
# without compiling pycairo.
$(INSTALLED): pyproject.toml package-lock.json $(VENV)/.stamp-venv
	$(BIN)/python -m pip install --quiet --editable ".[plot,alarm]" --group dev
	@[ -f daemon/web/static/vendor/uPlot.iife.min.js ] || echo "dcam: npm's registry was not reached: the page" \
	  "draws no figures, and its tests fail, until: touch package-lock.json && make venv" >&2
	@touch $@
