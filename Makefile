# `make babyai` and `make test` need only Python 3.11 or newer and make: they set up .venv
# once and reuse it.
PYTHON ?= python3
BIN := .venv/bin
READY := .venv/ready

.PHONY: babyai test test-long lint package docs lock clean

# The main job: train LEAP on a BabyAI level and report its success beside the paper's.
# More options: make babyai ARGS="--level all".
babyai: $(READY)
	$(BIN)/python -m experiments.babyai $(ARGS)

# Two files at a time, in the order of tests/conftest.py: most of a test is compilation, on one core.
test: $(READY)
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder $(ARGS)

# The files with tests that have a long form, in that form: docs/reliability.md.
test-long: $(READY)
	LEAPJAX_TEST_LONG=1 $(BIN)/python -m pytest -rA --durations=10 \
		$$(grep -lw 'only_long\|LONG' tests/test_*.py) $(ARGS)

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# Wheel and sdist in dist/, checked; the wheel, unpacked on its own, must do what the README says.
package: $(READY)
	rm -rf dist
	$(BIN)/python -m build --no-isolation --outdir dist . > /dev/null
	$(BIN)/twine check --strict dist/*
	$(BIN)/python -m pip install --quiet --no-deps --target dist/site dist/*.whl
	cd dist && PYTHONPATH=site ../$(BIN)/python ../tests/wheel.py ../README.md site

# The site, in site/; a broken link, or a public name without documentation, fails.
docs: $(READY)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build

# Everything in the lock and nothing else, each file compared with its hash. pip compares no
# hashes of what is editable, so the project itself comes second, built with what is there.
$(READY): pyproject.toml requirements.lock
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --no-deps --require-hashes --requirement requirements.lock
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --editable .
	$(BIN)/python -m pip check
	touch $(READY)

# Writes requirements.lock from pyproject.toml, for every platform; versions in it are kept where
# they can be. Renew all of them: make lock ARGS=--upgrade.
lock:
	$(PYTHON) -m venv .venv-lock
	.venv-lock/bin/python -m pip install --quiet uv
	.venv-lock/bin/uv pip compile --quiet --universal --generate-hashes --no-annotate \
		--custom-compile-command 'make lock' --python-version 3.11 \
		--extra test --extra docs --extra release pyproject.toml --output-file requirements.lock $(ARGS)

clean:
	rm -rf .venv .venv-lock dist site
