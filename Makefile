# Every target sets up what it needs (deploy/bootstrap.sh): a virtual environment in .venv with the locked packages.
# PYTHON=/path/to/python3.12 chooses the interpreter that .venv is made of.

BIN := .venv/bin
BOOTSTRAP := deploy/bootstrap.sh -e
PANGO := libpangoft2-1.0.so.0=libpangoft2-1.0-0

# Compiled kernels and font indexes stay in the tree, so that they are found again and no home directory is needed. Each
# state of the sources has its own: numba does not see that a function which it compiled into another one has changed.
COMPILED := $(sort $(shell grep -rl --include=*.py 'numerics.jit\|numerics import jit\|import numba' calibration))
KERNELS := .cache/numba/$(firstword $(shell cat $(COMPILED) | cksum))
export NUMBA_CACHE_DIR := $(CURDIR)/$(KERNELS)
# Where a rigcal that is not started by make has them (daemon/warm_up.py).
USERS := $(or $(XDG_CACHE_HOME),$(HOME)/.cache)/rigcal/numba
export MPLCONFIGDIR := $(CURDIR)/.cache/matplotlib

# The tests start a hundred processes: each would compile every module anew.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help environment setup demo docs deb debtest vmtest wheel sdist release check test long webtest lint style types imports quick blind bench soak fuzz lock check-deps clean

help: ## what there is to make
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "make %-10s %s\n", $$1, $$2}' Makefile

environment:
	@$(BOOTSTRAP) .venv requirements-dev.lock

setup: environment $(KERNELS)/warm ## the virtual environment, and kernels compiled ahead
	@$(if $(filter setup,$(MAKECMDGOALS)),echo "rigcal is set up in .venv; make demo shows a whole calibration on a simulated rig")

# Once for each state of the sources. A directory that cannot be written is said, and stops nothing.
$(KERNELS)/warm: | environment
	@echo "Compiling kernels ahead (half a minute, once)"
	@$(BIN)/python -m daemon.warm_up
	@touch $@ 2>/dev/null || true
	@mkdir -p "$(USERS)" 2>/dev/null && cp -R $(KERNELS)/. "$(USERS)" 2>/dev/null || true

demo: setup ## a simulated rig, from bus traffic to a calibrated model and a report
	@$(BIN)/rigcal demo

# Pictures first: what a browser is needed for is left out where there is none.
docs: setup ## the documentation as a site, with its pictures, in build/site
	$(BIN)/python -m docs.pictures build/pictures
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet

wheel: environment ## the wheel of the last commit, in dist/; the same commit gives the same bytes
	@$(BIN)/python -m deploy.release wheel

sdist: environment ## its sdist, which gives the same wheel
	@$(BIN)/python -m deploy.release sdist

deb: environment ## Debian packages of the last commit, for Debian 12 and 13, in dist/
	@$(BIN)/python -m deploy.release deb

# Refused before anything is built, where the last commit may not be a release. `make docs` leaves its pages in build/site.
release: environment ## a release of the last commit: wheel, sdist, packages, bills of materials, docs, SHA256SUMS, in dist/
	@$(BIN)/python -m deploy.release check
	@SOURCE_DATE_EPOCH=$$(git log -1 --format=%ct) $(MAKE) --no-print-directory docs
	@$(BIN)/python -m deploy.release release --docs build/site

debtest: environment ## the packages in fresh Debian 12 and 13 roots without a network; root, ten minutes
	@$(BIN)/python -m tests.deploy.packages

vmtest: environment ## the package on an emulated Debian, if what it tests has changed since it passed; root (VM="--only session")
	$(BIN)/python -m tests.vm $(VM)

# The deployment tests ask systemd's own tools about the files in deploy/, and reports are printed with Pango. What reads devices and what keeps their data
# must be reached by its own tests almost line by line: GATES=yes counts that, as CI does, and takes a third longer.
GATED := --gates --cov=drivers --cov=daemon.store --cov=calibration --cov-report=term-missing:skip-covered
test: ## the test suite; needs no hardware (GATES=yes: with the gates of its coverage)
	@$(BOOTSTRAP) -t systemd-analyze=systemd -t udevadm=udev -t $(PANGO) .venv requirements-dev.lock
	$(BIN)/python -m pytest -m "not long and not browser" -n auto --dist loadfile --no-loadscope-reorder $(if $(GATES),$(GATED))

long: setup ## tests that take over four seconds, if what they test has changed since they passed; half an hour
	$(BIN)/python -m tests.long

lint: style types imports ## style, types and import floors

style: environment
	$(BIN)/ruff check
	$(BIN)/ruff format --check

# What no test runs to its end: a benchmark that cannot start is found here.
PROGRAMS := deploy tests.bench tests.deploy tests.fuzz tests.soak tests.vm

types: environment
	$(BIN)/mypy
	$(BIN)/mypy --cache-dir .mypy_cache/programs --follow-imports=silent --ignore-missing-imports $(addprefix -p ,$(PROGRAMS))

imports: environment
	$(BIN)/lint-imports

# Some of every room, and nothing that starts a daemon. Where memory can hold files, no test waits for the disk.
QUICK := tests/drivers tests/daemon/store tests/daemon/alarms tests/daemon/config tests/daemon/cli/lines \
	tests/daemon/jobs/test_scheduler.py tests/daemon/web/test_access.py tests/daemon/report/calibration/test_timing.py \
	tests/calibration/numerics tests/calibration/rig tests/calibration/identification/test_start.py \
	tests/calibration/gap/projected tests/simulators/devices
IN_MEMORY := $(if $(wildcard /dev/shm),--basetemp /dev/shm/rigcal-quick-$(shell id -u))

quick: environment
	$(BIN)/python -m pytest -q -n $(shell echo $$(($$(nproc) + 1))) --dist loadfile -m "not slow and not long" $(IN_MEMORY) $(QUICK)

check: ## lint and a quick part of the tests, in a minute: before each commit
	@$(MAKE) --no-print-directory -j2 --output-sync=target types quick imports style

webtest: setup ## the operator's page in headless Chromium, if what it tests has changed since it passed; five minutes
	$(BIN)/python -m tests.web

blind: setup ## a few blind cases of every kind for the gap workflow; two minutes on two cores
	$(BIN)/rigcal bench gap --short

BENCHES := acquisition socketcan store_growth year_store store_queries kernels refinement evolution peers far_starts design ur10 table4 zhou2022 prediction many_rows gate promotion drift residual gap gap_cases

bench: setup ## speed and accuracy beside the peers', as ratios; an hour on two cores
	@for name in $(BENCHES); do echo "== $$name"; $(BIN)/python -m tests.bench.$$name || exit 1; done
	$(BIN)/python -m tests.calibration.simulated_sessions
	$(BIN)/python -m tests.calibration.interval_coverage
	$(BIN)/python -m tests.calibration.held_out_coverage
	$(BIN)/rigcal bench gap

soak: setup ## the daemon on a simulated rig at 4x with every fault at random; 30 minutes (SOAK="--seed 7 --minutes 5")
	$(BIN)/python -m tests.soak $(SOAK)

# One target after the other, each at most an hour; FUZZ="dbc eds --seconds 60" chooses. Inputs that find faults:
# fuzz-faults/. What was measured in the present state of a target's sources is in tests/fuzz/measured.json.
fuzz: setup ## a million hostile inputs for every decoder, file reader and socket command; hours
	nice $(BIN)/python -m tests.fuzz $(FUZZ)

# The rig gets requirements.lock, with the build backend that installs the project itself; requirements-dev.lock holds
# the same versions and the tools besides. Versions stay as they are unless pyproject.toml forces a change;
# `make lock UPGRADE=--upgrade` takes the newest.
COMPILE := $(BIN)/uv pip compile --no-config --quiet --universal --python-version 3.11 --generate-hashes \
	--custom-compile-command "make lock" $(UPGRADE)

lock: environment ## write the lock files anew from pyproject.toml
	echo 'setuptools>=77' | $(COMPILE) pyproject.toml - --output-file requirements.lock
	$(COMPILE) pyproject.toml --extra dev --extra bench --constraints requirements.lock --output-file requirements-dev.lock

check-deps: environment ## known vulnerabilities of the locked packages, where advisories can be reached
	@$(BIN)/python -m tests.dependencies

clean: ## remove everything that make has made
	rm -rf .venv .cache build dist rigcal-demo rigcal-sim fuzz-faults htmlcov .coverage* *.egg-info
	rm -rf .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
