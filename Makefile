# `make babyai` and `make test` need only Python 3.11 or newer and make: they set up .venv
# once and reuse it. Each target installs what it needs, and no more.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: babyai test test-long test-other-end lint package docs lock clean

# The main job: train LEAP on a BabyAI level and report its success beside the paper's.
# More options: make babyai ARGS="--level all".
babyai: .venv/babyai
	$(BIN)/python -m experiments.babyai $(ARGS)

# Two files at a time, in the order of tests/conftest.py: most of a test is compilation, on one core.
test: .venv/test
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder $(ARGS)

# The files with tests that have a long form, in that form: docs/reliability.md.
test-long: .venv/test
	LEAPJAX_TEST_LONG=1 $(BIN)/python -m pytest -rA --durations=10 \
		$$(grep -lw 'only_long\|LONG' tests/test_*.py) $(ARGS)

# The core's tests with the newest versions of all dependencies where .venv has the lowest, and
# with the lowest where it has the newest: on a Python that this machine may have.
CORE := energy planners pure rollouts models transformer training pretrained published \
	storage gymnasium babyai atari observations
test-other-end: .venv/test
	tests/other_end.sh $(CORE:%=tests/test_%.py) $(ARGS)

lint: .venv/develop
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-logo

# Wheel and sdist in dist/, checked; the wheel, unpacked on its own, must do what the README says.
package: .venv/develop
	rm -rf dist
	$(BIN)/python -m build --no-isolation --outdir dist . > /dev/null
	$(BIN)/twine check --strict dist/*
	$(BIN)/python -m pip install --quiet --no-deps --target dist/site dist/*.whl
	cd dist && PYTHONPATH=site ../$(BIN)/python ../tests/wheel.py ../README.md site

# The site, in site/; a broken link, or a public name without documentation, fails.
docs: .venv/develop
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build

# Everything in a lock and nothing else, each file compared with its hash. pip compares no
# hashes of what is editable, so the project itself comes second, built with what is there.
.venv/%: requirements/%.txt pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --no-deps --require-hashes --requirement $<
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --editable .
	$(BIN)/python -m pip check
	touch $@

# Writes requirements/ from pyproject.toml, for every platform; versions in it are kept where they
# can be. Renew all of them: make lock ARGS=--upgrade. Every lock is a part of the last one.
# On Python 3.11 the lock has the lowest version of each dependency that we allow.
COMPILE = .venv-lock/bin/uv pip compile pyproject.toml --quiet --python-version 3.11
LOCK = $(COMPILE) --universal --generate-hashes --no-annotate --custom-compile-command 'make lock' \
	--constraint .venv-lock/lowest.txt $(ARGS)
DEVELOP := --extra babyai --extra atari --extra tensorboard \
	--group build --group test --group lint --group docs --group release

lock:
	$(PYTHON) -m venv .venv-lock
	.venv-lock/bin/python -m pip install --quiet uv
	$(COMPILE) --no-deps --resolution lowest-direct --all-extras --no-annotate --no-header \
		| sed "s/$$/ ; python_version < '3.12'/" > .venv-lock/lowest.txt
	$(LOCK) $(DEVELOP) --output-file requirements/develop.txt
	$(LOCK) --constraint requirements/develop.txt --extra babyai --group build \
		--output-file requirements/babyai.txt
	$(LOCK) --constraint requirements/develop.txt --extra babyai --extra atari --extra tensorboard \
		--group build --group test --output-file requirements/test.txt

clean:
	rm -rf .venv .venv-* dist site
