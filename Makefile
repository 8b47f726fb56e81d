# Short names for the habits. Everything lives in .venv; nothing outside the repository is needed.
PYTHON ?= python3
BIN := .venv/bin
READY := .venv/.ready
TOOLS := .venv/.tools
SITE := .venv/.site

# byte code is kept in any case: where the environment forbids it, every process compiles what it imports anew
export PYTHONDONTWRITEBYTECODE =

.PHONY: help setup demo cohort test test-shared lint types imports kernels format check bench evidence golden golden-record fuzz fuzz-few faults sanitize lock audit sample paper docs site pictures clean

help:
	@echo "make demo         set up and run the whole chain on the sample study, into demo/"
	@echo "make cohort       12 simulated ears with a planted law, and the truth beside what was found"
	@echo "make test         set up and run the tests"
	@echo "make test-shared  also the tests on data that may not be copied into the repository"
	@echo "make check        lint, types, import rules, compiler warnings of the kernels"
	@echo "make bench        the slower evidence, with its tables"
	@echo "make evidence     tables of docs/ by the commands below them: ARGS=fitting_beam; all of them take hours"
	@echo "make golden       every number of the commands on many scenes against what was recorded"
	@echo "make faults       kills, full disks, limits, unreadable and changing inputs, two runs at once"
	@echo "make sanitize     the kernels under the address, undefined behaviour and thread sanitizers"
	@echo "make fuzz         damaged files for every reader: one minute, or MINUTES=240 SEED=7"
	@echo "make paper        the paper, recomputed: demo/paper.html"
	@echo "make docs         the pages that are made from the sources"
	@echo "make site         the documentation as a website, in site/"
	@echo "make lock         locks/: versions and hashes of all packages anew; make audit: known vulnerabilities"
	@echo "make sample       make the sample study anew"

setup: $(TOOLS)

$(READY): pyproject.toml locks/run.txt tools/setup.sh hatch_build.py $(wildcard legacy/*/native/*.[ch] legacy/*/kernels/*.[ch])
	@PYTHON="$(PYTHON)" sh tools/setup.sh
	@touch $(READY)

# what tests and checks need beyond the package; their byte code comes with their first import
$(TOOLS): $(READY) locks/dev.txt
	@$(BIN)/python -m pip install --no-compile --quiet --disable-pip-version-check --prefer-binary --require-hashes -r locks/dev.txt
	@touch $(TOOLS)

$(SITE): $(READY) locks/docs.txt
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --prefer-binary --require-hashes -r locks/docs.txt
	@touch $(SITE)

demo: $(READY)
	$(BIN)/scan2kd sample_volumes/study.toml --out demo
	$(BIN)/python -m legacy.fitting.examples.paper_page demo/paper.html --force
	@echo "Open demo/report.html"

cohort: $(READY)
	$(BIN)/python -m sample_volumes.make_cohort demo/cohort
	$(BIN)/scan2kd demo/cohort/ears/*/study.toml --out demo/cohort/out --jobs 2 --export all
	$(BIN)/python -m sample_volumes.make_cohort demo/cohort --compare
	@echo "Open demo/cohort/out/cohort.html"

# One thread of linear algebra per process: two processes share two cores. Memory that is freed stays with the process
# (glibc): a scan in a long process otherwise has all its pages cleared anew for each array.
test: export OPENBLAS_NUM_THREADS = 1
test: export MALLOC_MMAP_THRESHOLD_ = 268435456
test: export MALLOC_TRIM_THRESHOLD_ = 1073741824
test: $(TOOLS)
	$(BIN)/python -m pytest -n 2 --dist worksteal

test-shared: export OPENBLAS_NUM_THREADS = 1
test-shared: $(TOOLS)
	$(BIN)/python -m pytest -n 2 -m "shared or not shared"

lint: $(TOOLS)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(TOOLS)
	$(BIN)/mypy

imports: $(TOOLS)
	$(BIN)/lint-imports

# compiled anew, every warning a fault
kernels: $(TOOLS)
	$(BIN)/python hatch_build.py --strict

format: $(TOOLS)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

check: lint types imports kernels

docs: $(READY)
	$(BIN)/python -m legacy.stapeskit.warnings > docs/warnings.md
	$(BIN)/python -m legacy.pipeline.options_page > docs/options.md
	$(BIN)/python -m tools.doc_tables

# the same pages as a website, in site/
site: docs $(SITE)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

pictures: demo
	$(BIN)/python tools/draw_experiment.py
	$(BIN)/python tools/draw_conventions.py
	$(BIN)/python tools/draw_overview.py demo

sample: $(READY)
	$(BIN)/python -m sample_volumes.make_sample

paper: $(READY)
	mkdir -p demo
	$(BIN)/python -m legacy.fitting.examples.paper_page demo/paper.html --force

bench: $(TOOLS)
	@for script in benchmarks/[a-z]*.py; do name=$$(basename $$script .py); echo "== $$name"; $(BIN)/python -m benchmarks.$$name || exit 1; done

evidence: $(TOOLS)
	$(BIN)/python -m tools.evidence $(ARGS)

# ARGS="--room ct", ARGS="--only kd_", ARGS="-j 2": tests/golden/__main__.py says more
golden: $(TOOLS)
	$(BIN)/python -m tests.golden $(ARGS)

golden-record: $(TOOLS)
	$(BIN)/python -m tests.golden --record $(ARGS)

# ARGS="--only kill --times 500": tests/faults/__main__.py says more
faults: export OPENBLAS_NUM_THREADS = 1
faults: $(TOOLS)
	$(BIN)/python -m tests.faults $(ARGS)

sanitize: $(TOOLS)
	$(BIN)/python tools/sanitize.py $(ARGS)

# ARGS="--only scans", ARGS="--replay PLACE": tests/fuzz/__main__.py says more
fuzz fuzz-few: export OPENBLAS_NUM_THREADS = 1
fuzz: MINUTES ?= 1
fuzz: SEED ?= 1
fuzz: $(TOOLS)
	$(BIN)/python -m tests.fuzz --minutes $(MINUTES) --seed $(SEED) $(ARGS)

# the same cases every time, for .ci/run: a minute at most
fuzz-few: $(TOOLS)
	$(BIN)/python -m tests.fuzz --minutes 1 --blocks 15

lock:
	PYTHON="$(PYTHON)" sh tools/lock.sh

audit: $(READY)
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --group lock
	$(BIN)/python -m pip_audit --strict --require-hashes --disable-pip -r locks/dev.txt

clean:
	rm -rf .venv demo site
