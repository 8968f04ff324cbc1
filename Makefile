# Every target works from a bare clone: it creates .venv with what requirements/ pins, and runs.
# Where ROS 2 Jazzy is sourced, that ROS 2 is used.
#   PYTHON=python3.12      the interpreter to create .venv with
#   ARGS='--seed 3'        further arguments for demo, test or bench

PYTHON ?= python3
ARGS ?=

# Nothing that is started here speaks to other machines unless the caller says so.
ROS_AUTOMATIC_DISCOVERY_RANGE ?= LOCALHOST
# The matrices are tiny: threads of the linear algebra would only disturb the loop.
OMP_NUM_THREADS ?= 1
export ROS_AUTOMATIC_DISCOVERY_RANGE OMP_NUM_THREADS

# Set by the ROS 2 wheels of another environment; inherited, they break those of .venv.
ifdef _ROS_WHEELS_BOOTSTRAP_COMPLETE
unexport _ROS_WHEELS_BOOTSTRAP_COMPLETE LD_LIBRARY_PATH
endif

RUN := .venv/bin/python
# A worker per processor and one more; tests of one file share what their fixtures have made.
# Those that wait first, in the order of the rooms, so that no worker waits for another at the end.
WORKERS := -n auto --dist loadfile --no-loadscope-reorder
# A Python that was not asked for by name leaves an existing .venv of another Python as it is.
KEEP := $(if $(filter file,$(origin PYTHON)),--keep-python)
# A sourced ROS 2 brings its own numpy, and each numpy has other types than the pinned one.
CHECK_TYPES := $(if $(ROS_DISTRO),echo 'lint: types are not checked with the libraries of a sourced ROS 2',$(RUN) -m mypy)
NEW_ENOUGH := import sys; sys.exit(sys.version_info < (3, 10))

.PHONY: help demo test bench accuracy lint docs clean run-environment dev-environment
.NOTPARALLEL:

help:
	@echo 'make demo    run the example for 10 s on real ROS 2 processes and write a report to results/latest'
	@echo 'make test    run ruff, mypy and all tests'
	@echo 'make bench   measure the controller step, the loop latency and the simulation speed'
	@echo 'make accuracy measure how right, honest and quick it is, against a reference: 20 min'
	@echo 'make lint    run ruff and mypy only'
	@echo 'make docs    regenerate the figures of the documents'
	@echo 'make clean   remove everything that make created, except results/'
	@echo "options: PYTHON=python3.12 (interpreter for .venv), ARGS='...' (passed on by demo, test, bench)"

demo: run-environment
	@$(RUN) -m backlash_ros.tools.bringup --duration 10 $(ARGS)

test: lint
	@$(RUN) -m pytest $(WORKERS) $(ARGS)

bench: dev-environment
	@$(RUN) benchmarks/run.py $(ARGS)

accuracy: dev-environment
	@$(RUN) benchmarks/accuracy.py $(ARGS)

lint: dev-environment
	@$(RUN) -m ruff check --quiet .
	@$(CHECK_TYPES)

docs: dev-environment
	@$(RUN) docs/made_by/figures.py
	@$(RUN) docs/made_by/film.py

clean:
	@rm -rf .venv build install log *.egg-info .hypothesis .mypy_cache .pytest_cache .ruff_cache
	@find . -name __pycache__ -type d -prune -exec rm -rf {} +

run-environment dev-environment:
	@command -v '$(PYTHON)' >/dev/null || { echo "backlash_ros: no '$(PYTHON)' here: install Python 3.10 to 3.13 or name one (make ... PYTHON=/path/to/python3)" >&2; exit 2; }
	@'$(PYTHON)' -c '$(NEW_ENOUGH)' || { echo "backlash_ros: '$(PYTHON)' is older than Python 3.10: install Python 3.10 to 3.13 or name one (make ... PYTHON=python3.12)" >&2; exit 2; }
	@'$(PYTHON)' scripts/environment.py $(@:-environment=) $(KEEP)
