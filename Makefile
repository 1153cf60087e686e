PYTHON ?= python3
BIN := .venv/bin
BUILT := hatch_build.py $(wildcard src/pacesetter/learner/*.cc src/pacesetter/learner/*.h)

.PHONY: demo test test-slow torture torture-long check docs wheel bench-speed clean

.venv/installed: pyproject.toml $(BUILT)
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check --editable .
	touch $@

.venv/tested: .venv/installed
	$(BIN)/pip install --quiet --disable-pip-version-check --editable '.[dev]'
	touch $@

.venv/peers: .venv/tested
	$(BIN)/pip install --quiet --disable-pip-version-check torch==2.13.0 'rltools[mkl]'
	$(BIN)/pip install --quiet --disable-pip-version-check --editable '.[peers]'
	touch $@

demo: .venv/installed
	$(BIN)/python examples/demo.py

test: .venv/tested
	$(BIN)/pytest -m 'not slow' -n 2

test-slow: .venv/tested
	$(BIN)/pip install --quiet --disable-pip-version-check --editable '.[scale]'
	$(BIN)/pytest -m slow

torture: .venv/tested
	$(BIN)/python tests/torture/run.py

torture-long: .venv/tested
	$(BIN)/python tests/torture/run.py --long

check: .venv/tested
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

.venv/documented: .venv/installed
	$(BIN)/pip install --quiet --disable-pip-version-check --editable '.[docs]'
	touch $@

docs: .venv/documented
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet

wheel: .venv/installed
	$(BIN)/python scripts/try_wheel.py

bench-speed: .venv/peers
	$(BIN)/python benchmarks/speed.py
	$(BIN)/python benchmarks/race.py --rounds 1 --steps 1000
	NPROC=1 taskset -c 0 $(BIN)/python benchmarks/ceiling.py
	$(BIN)/python benchmarks/ceiling.py
	$(BIN)/python benchmarks/ceiling.py --members 2
	$(BIN)/python benchmarks/costs.py outside members precision norm checkpoint startup recompiles memory
	$(BIN)/python benchmarks/jobs.py
	$(BIN)/python benchmarks/models.py

clean:
	rm -rf .venv .pytest_cache .ruff_cache site
