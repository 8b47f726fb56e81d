# Short names for the habits. Everything lives in .venv; nothing outside the repository is needed.
PYTHON ?= python3
BIN := .venv/bin
READY := .venv/.ready
SITE := .venv/.site
# byte code is kept in any case: where the environment forbids it, every process compiles what it imports anew
export PYTHONDONTWRITEBYTECODE =
# two processes share two cores
test test-shared coverage: export OPENBLAS_NUM_THREADS = 1
# a test that follows another one takes its memory over: given back to the system in between, it costs a seventh
# of the processor time to have its pages cleared again
test test-shared coverage: export MALLOC_MMAP_THRESHOLD_ = 128000000
test test-shared coverage: export MALLOC_TRIM_THRESHOLD_ = 512000000

.PHONY: help setup demo cohort test test-shared coverage browser octave lint types imports check format bench evidence docs site sample lock clean

help:
	@echo "make demo      set up and run the whole chain on the sample study, into demo/"
	@echo "make test      set up and run the tests; make test-shared: also on data that may not be copied"
	@echo "make check     lint, types, import rules; make browser, make octave: in Chromium, in Octave"
	@echo "make coverage  statements that the tests reach, file by file"
	@echo "make cohort    twelve simulated ears with a planted law, and the truth beside what was found"
	@echo "make bench     the slower evidence; make evidence: its tables into docs/ (ARGS=fitting_estimators)"
	@echo "make docs      the pages that are made from the sources; make site: all pages as a website"
	@echo "make sample    make the sample study anew; make lock: versions and hashes of all packages anew"

setup: $(READY)
$(READY): pyproject.toml requirements.lock tools/setup.sh
	@PYTHON="$(PYTHON)" sh tools/setup.sh
	@touch $(READY)

demo: $(READY)
	$(BIN)/scan2kd sample_volumes/study.toml --out demo
	@echo "Open demo/report.html"
cohort: $(READY)
	$(BIN)/python -m sample_volumes.make_cohort demo/cohort
	$(BIN)/scan2kd demo/cohort/ears/*/study.toml --out demo/cohort/out --jobs 2
	@echo "Open demo/cohort/out/cohort.html"

test: $(READY)
	$(BIN)/python -m pytest -n 2 --dist worksteal
test-shared: $(READY)
	$(BIN)/python -m pytest -n 2 -m "not browser and not octave"
# the tracer of Python 3.12 and later costs nearly nothing, that of 3.11 an hour
coverage: $(READY)
	rm -f .coverage*
	$(BIN)/coverage run -m pytest -p tools.measured_children -n 2 --dist worksteal
	$(BIN)/coverage combine --quiet
	$(BIN)/coverage report --ignore-errors --skip-covered --sort=cover
browser: $(READY)
	$(BIN)/python -m pytest -m browser tests/app tests/study
octave: $(READY)
	$(BIN)/python -m pytest -m octave tests/study
lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
types: $(READY)
	$(BIN)/mypy
imports: $(READY)
	$(BIN)/lint-imports
check: lint types imports
format: $(READY)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(READY)
	@for script in benchmarks/[a-z]*.py; do echo "== $$script"; $(BIN)/python $$script || exit 1; done
evidence: $(READY)
	$(BIN)/python tools/evidence.py $(ARGS)
docs: $(READY)
	$(BIN)/python -m stapeskit.warnings > docs/warnings.md
	$(BIN)/python -m pipeline.options_page > docs/options.md
	$(BIN)/python tools/evidence.py --pages
	$(BIN)/python -m tools.doc_tables
site: docs
	$(BIN)/python -m pip install --quiet --group docs && NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
sample: $(READY)
	$(BIN)/python -m sample_volumes.make_sample
lock: $(READY)
	$(BIN)/uv pip compile --quiet --universal --generate-hashes --no-emit-index-url --no-header --no-annotate \
		--python-version 3.11.5 --all-extras --group dev pyproject.toml -o requirements.lock
clean:
	rm -rf .venv demo site
