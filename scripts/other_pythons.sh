#!/usr/bin/env bash
# The light tests under the oldest and the newest Python that are promised, with the base install alone, where these are
# to be had: as python3.X, or from pyenv. Made once in .venv-3.X; a Python that is not here is said and skipped.
set -euo pipefail
cd "$(dirname "$0")/.."

light_tests=(tests/test_{base_install,tokenizer,text_features,choosing,nearest,formats_ply,formats_pcd,import_order}.py)

find_python() {
    local candidate
    for candidate in "python$1" "${PYENV_ROOT:-$HOME/.pyenv}/versions/$1".*/bin/python; do
        if "$candidate" -c 'import venv, ensurepip' 2>/dev/null; then
            echo "$candidate"
            return
        fi
    done
}

for version in 3.10 3.13; do
    python=$(find_python "$version")
    if [ -z "$python" ]; then
        echo "other_pythons: no Python $version here: skipped" >&2
        continue
    fi
    environment=.venv-$version
    if [ ! -e "$environment/made" ]; then
        "$python" -m venv --clear "$environment"
        if ! "$environment/bin/pip" install -q "numpy>=1.24" "onnxruntime>=1.17" "pytest>=8" "onnx>=1.15" "tokenizers>=0.20"; then
            echo "other_pythons: nothing can be installed for Python $version: skipped" >&2
            continue
        fi
        touch "$environment/made"
    fi
    echo "other_pythons: $("$environment/bin/python" --version)"
    PYTHONPATH=.:export:plugins:examples "$environment/bin/python" -m pytest -q --noconftest -m "not slow" \
        -p no:cacheprovider "${light_tests[@]}"
done
