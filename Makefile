# Short names for the habits. Everything lives in .venv; nothing outside the repository is needed.
PYTHON ?= python3
BIN := .venv/bin
READY := .venv/.ready

.PHONY: help setup demo test test-shared lint types imports kernels format check bench golden golden-record fuzz sample paper docs clean

help:
	@echo "make demo         set up and run the whole chain on the sample study, into demo/"
	@echo "make test         set up and run the tests"
	@echo "make test-shared  also the tests on data that may not be copied into the repository"
	@echo "make check        lint, types, import rules, compiler warnings of the kernels"
	@echo "make bench        the slower evidence, with its tables"
	@echo "make golden       every number of the commands on many scenes against what was recorded"
	@echo "make fuzz         damaged files for every reader: one minute, or MINUTES=240 SEED=7"
	@echo "make paper        the paper, recomputed: demo/paper.html"
	@echo "make docs         the pages that are made from the sources"
	@echo "make sample       make the sample study anew"

setup: $(READY)

$(READY): pyproject.toml constraints.txt tools/setup.sh hatch_build.py $(wildcard */native/*.[ch] */kernels/*.[ch])
	@PYTHON="$(PYTHON)" sh tools/setup.sh
	@touch $(READY)

demo: $(READY)
	$(BIN)/scan2kd sample_volumes/study.toml --out demo
	$(BIN)/python -m fitting.examples.paper_page demo/paper.html --force
	@echo "Open demo/report.html"

# one thread of linear algebra per process: two processes share two cores
test: export OPENBLAS_NUM_THREADS = 1
test: $(READY)
	$(BIN)/python -m pytest -n 2

test-shared: export OPENBLAS_NUM_THREADS = 1
test-shared: $(READY)
	$(BIN)/python -m pytest -n 2 -m "shared or not shared"

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(READY)
	$(BIN)/mypy

imports: $(READY)
	$(BIN)/lint-imports

# compiled anew, every warning a fault
kernels: $(READY)
	$(BIN)/python hatch_build.py --strict

format: $(READY)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

check: lint types imports kernels

docs: $(READY)
	$(BIN)/python -m stapeskit.warnings > docs/warnings.md
	$(BIN)/python -m pipeline.options_page > docs/options.md

sample: $(READY)
	$(BIN)/python -m sample_volumes.make_sample

paper: $(READY)
	mkdir -p demo
	$(BIN)/python -m fitting.examples.paper_page demo/paper.html --force

bench: $(READY)
	@for script in benchmarks/*.py; do case $$script in */_*) ;; *) echo "== $$script"; $(BIN)/python $$script || exit 1;; esac; done

# ARGS="--room ct", ARGS="--only kd_", ARGS="-j 2": tests/golden/__main__.py says more
golden: $(READY)
	$(BIN)/python -m tests.golden $(ARGS)

golden-record: $(READY)
	$(BIN)/python -m tests.golden --record $(ARGS)

# ARGS="--only scans", ARGS="--replay PLACE": tests/fuzz/__main__.py says more
fuzz: export OPENBLAS_NUM_THREADS = 1
fuzz: MINUTES ?= 1
fuzz: SEED ?= 1
fuzz: $(READY)
	$(BIN)/python -m tests.fuzz --minutes $(MINUTES) --seed $(SEED) $(ARGS)

clean:
	rm -rf .venv demo
