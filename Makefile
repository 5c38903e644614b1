# `make demo` and `make test` need Python 3.11 to 3.13, pip, make and git; nothing else.
PYTHON ?= python3
VENV ?= .venv
# Two test processes: more gain little, because the simulator uses its own threads.
JOBS ?= 2

bin := $(VENV)/bin
demo_stamp := $(VENV)/.installed-demo
stamp := $(VENV)/.installed
# the table of figures comes last: it is made from what the others wrote
benchmarks = $(filter-out %/readme.py %/devices.py,$(sort $(wildcard benchmarks/*.py))) \
	benchmarks/readme.py

.PHONY: help demo test test-slow lint format bench docs venv clean
.DEFAULT_GOAL := help

help:
	@echo "make demo       turn a cube with each controller; table, out/demo.mp4, out/report.html"
	@echo "make test       the tests that take seconds each"
	@echo "make test-slow  the others"
	@echo "make lint       ruff and pyright"
	@echo "make format     ruff format, and the fixes that ruff can make"
	@echo "make bench      the measurements; results as JSON in benchmarks/"
	@echo "make docs       the documentation, in docs/_build/html"
	@echo "make clean      remove what the above made"

# Installed again when what is to be installed changes, so a second call costs nothing. The demo
# needs neither torch nor the tools of the tests, so it does not wait for them.
$(demo_stamp): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14))' || { echo \
	    "dexctl needs Python 3.11 to 3.13; choose one: make PYTHON=python3.11 $(MAKECMDGOALS)"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(bin)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[fast,viz]'
	@touch $@

$(stamp): $(demo_stamp)
	$(bin)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt \
	    -e '.[all,dev]'
	@touch $@

venv: $(stamp)

demo: $(demo_stamp)
	$(bin)/dexctl demo

# Bytecode first: where nobody may write any, every process that a test starts would compile all.
test: $(stamp)
	$(bin)/python -m compileall -q dexctl learning hardware
	$(bin)/python -m pytest -n $(JOBS)

test-slow: $(stamp)
	$(bin)/python -m pytest -n $(JOBS) -m slow

lint: $(stamp)
	$(bin)/ruff check .
	$(bin)/ruff format --check .
	$(bin)/pyright --pythonpath $(bin)/python

format: $(stamp)
	$(bin)/ruff check --fix .
	$(bin)/ruff format .

bench: $(stamp)
	@for script in $(benchmarks); do echo "$$script"; $(bin)/python $$script || exit 1; done

docs: $(stamp)
	$(bin)/python -m sphinx -W --keep-going -q -b html docs docs/_build/html
	@echo "docs/_build/html/index.html"

clean:
	rm -rf .venv .ci-venv out docs/_build build dist .pytest_cache .ruff_cache .hypothesis *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
