# `make` prints the targets. A fresh machine needs python3.12 (with venv) and make, nothing else.

PYTHON ?= python3.12
PYTEST_ARGS ?=
DURATION ?= 300
JOBS ?= 2

VENV := .venv
OLDEST := .venv-oldest
RUN := $(VENV)/bin/python
PIP_INSTALL := -m pip install --quiet --disable-pip-version-check --no-input --no-build-isolation --no-deps

# A sourced ROS installation must not leak into the virtual environments, which bring their own ROS.
unexport PYTHONPATH PYTHONHOME LD_LIBRARY_PATH AMENT_PREFIX_PATH _ROS_WHEELS_BOOTSTRAP_COMPLETE

.DEFAULT_GOAL := help
.PHONY: help venv demo test test-long test-tcp test-all test-blind test-oldest lint docs bench proof soak lock clean

help: ## print this list of targets
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/  make \1\t\2/p' $(MAKEFILE_LIST) | expand -t 22

venv: $(VENV)/.installed ## create .venv with everything the other targets need

demo: $(VENV)/.installed ## run the demonstration
	@$(RUN) -m rim_camera_ros.demo

QUICK = not slow and not long

test: $(VENV)/.installed ## run the tests, without those that take long
ifeq ($(PYTEST_ARGS),)
	@status=0; \
	$(RUN) -m pytest -m "$(QUICK)" -n $(JOBS) --dist loadfile --ignore=test/ros || status=1; \
	$(RUN) -m pytest -m "$(QUICK)" test/ros || status=1; \
	exit $$status
else
	@$(RUN) -m pytest -m "$(QUICK)" $(PYTEST_ARGS)
endif

test-long: $(VENV)/.installed ## run the tests of 7 seconds to some minutes
	@$(RUN) -m pytest -m "long and not slow" -n $(JOBS) --dist loadfile $(PYTEST_ARGS)

# Parameters, processes, launch files and documents are the same by any transport.
NOT_OF_TRANSPORT = documentation home_folder launch launch_several parameters process security unchanged_parameters
OF_TRANSPORT = $(filter-out $(NOT_OF_TRANSPORT:%=test/ros/test_%.py),$(wildcard test/ros/test_*.py))

test-tcp: $(VENV)/.installed ## run the ROS tests of messages with Fast DDS' LARGE_DATA in the place of the shipped profile
	@FASTDDS_BUILTIN_TRANSPORTS=LARGE_DATA $(RUN) -m pytest -m "not slow" $(PYTEST_ARGS) $(OF_TRANSPORT)

test-all: $(VENV)/.installed ## run all tests
	@$(RUN) -m pytest $(PYTEST_ARGS)

test-blind: $(VENV)/.installed ## diagnose forty blind cases and hold the rates against what is demanded (up to 35 minutes)
	@$(RUN) -m pytest -m slow -k forty_cases $(PYTEST_ARGS) test/blind/test_proof.py

test-oldest: $(OLDEST)/.installed ## run all tests with the oldest supported libraries, in .venv-oldest
	@$(OLDEST)/bin/python -m pytest $(PYTEST_ARGS)

lint: $(VENV)/.installed ## check style, format and types
	@$(VENV)/bin/ruff check .
	@$(VENV)/bin/ruff format --check .
	@$(RUN) -m mypy --strict rim_camera_ros

docs: $(VENV)/.installed ## write the pages that come from the program: effects, parameters of nodes, keys of files
	@$(RUN) docs/tools/effect_pages.py
	@$(RUN) docs/tools/node_parameters.py
	@$(RUN) docs/tools/file_reference.py

bench: $(VENV)/.installed ## measure the speed of the hot paths
	@$(RUN) -m test.bench

proof: $(VENV)/.installed ## run the blind benchmark of the diagnosis and write docs/proof.md (hours)
	@$(RUN) -m test.blind --out build/proof --docs docs --resume

soak: $(VENV)/.installed ## run the faults for DURATION seconds (300)
	@$(RUN) -m test.soak --duration $(DURATION)

lock: $(VENV)/.installed ## renew requirements/*.lock from requirements/*.in
	@$(RUN) requirements/lock.py default
	@$(RUN) requirements/lock.py oldest

clean: ## remove environments, caches and build results
	rm -rf $(VENV) $(OLDEST) build install log demo_output *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# The libraries. The stamp is written last: an interrupted installation starts anew.
$(VENV)/.libraries: requirements/default.lock
$(OLDEST)/.libraries: requirements/oldest.lock
%/.libraries:
	@$(PYTHON) -c '' 2>/dev/null || { \
	  echo "$(PYTHON) is missing or does not start: sudo apt install python3.12 python3.12-venv" >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { \
	  echo "$(PYTHON) cannot make virtual environments: sudo apt install python3.12-venv" >&2; exit 1; }
	@echo "Installing $< into $* (once; about 800 MB)"
	@$(PYTHON) -m venv --clear $* >$*.log 2>&1 && rm -f $*.log || { rm -rf $*; cat $*.log >&2; rm -f $*.log; \
	  echo "$(PYTHON) -m venv $* failed; if ensurepip is named above: sudo apt install python3.12-venv" >&2; exit 1; }
	@$*/bin/python $(PIP_INSTALL) $$(grep -E '^(setuptools|wheel)==' $<)
	@$*/bin/python $(PIP_INSTALL) -r $<
	@touch $@

# This package, editable.
%/.installed: %/.libraries setup.py setup.cfg pyproject.toml
	@$*/bin/python $(PIP_INSTALL) --editable .
	@touch $@
