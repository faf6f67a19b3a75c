#!/usr/bin/env bash
# Runs the core's tests at the other end of what is supported: `requirements/` holds the lowest
# version of each dependency for Python 3.11, and the newest for later Pythons. So where .venv has
# Python 3.11, this runs the newest Python that it finds, and Python 3.11 elsewhere.
set -euo pipefail
cd "$(dirname "$0")/.."

if .venv/bin/python -c 'import sys; sys.exit(sys.version_info >= (3, 12))'; then
    wanted=(3.14 3.13 3.12)
else
    wanted=(3.11)
fi

# Prints a Python of a version: of the PATH, or one that pyenv has installed.
find_python() {
    local candidate
    for candidate in "python$1" "${PYENV_ROOT:-$HOME/.pyenv}"/versions/"$1".*/bin/python; do
        if "$candidate" -c 'import ensurepip, venv' 2> /dev/null; then
            echo "$candidate"
            return
        fi
    done
}

for version in "${wanted[@]}"; do
    python=$(find_python "$version")
    [ -z "$python" ] || break
done
if [ -z "$python" ]; then
    echo "skipped the other end: found no Python ${wanted[*]}"
    exit 0
fi

environment=.venv-$version
if [ ! "$environment/ready" -nt requirements/test.txt ]; then
    "$python" -m venv "$environment"
    "$environment/bin/python" -m pip install --quiet --no-deps --require-hashes \
        --requirement requirements/test.txt
    "$environment/bin/python" -m pip install --quiet --no-deps --no-build-isolation --editable .
    "$environment/bin/python" -m pip check
    touch "$environment/ready"
fi
"$environment/bin/python" --version
"$environment/bin/python" -m pip list 2> /dev/null | grep -E '^(jax|flax|numpy|optax|orbax-checkpoint|minari) '
"$environment/bin/python" -m pytest -n 2 --dist loadfile "$@"
