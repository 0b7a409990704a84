#!/usr/bin/env bash
# The light tests with the base install alone: under the oldest Python that is promised with the oldest packages that
# pyproject.toml allows, and under the newest Python with the newest packages. Pythons are python3.X, or pyenv's; one
# that is not here is said and skipped. Environments are made once, in .venv-3.X.
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

oldest=("numpy==1.24.*" "onnxruntime==1.17.*" "onnx==1.15.*" "tokenizers==0.20.*" "pytest>=8")
newest=(numpy onnxruntime onnx tokenizers pytest)

for version in 3.10 3.13; do
    packages=("${newest[@]}")
    if [ "$version" = 3.10 ]; then
        packages=("${oldest[@]}")
    fi
    python=$(find_python "$version")
    if [ -z "$python" ]; then
        echo "other_pythons: no Python $version here: skipped" >&2
        continue
    fi
    environment=.venv-$version
    made="$environment/made-with-${packages[0]}"  # another numpy: made anew
    if [ ! -e "$made" ]; then
        "$python" -m venv --clear "$environment"
        if ! "$environment/bin/pip" install -q "${packages[@]}"; then
            echo "other_pythons: nothing can be installed for Python $version: skipped" >&2
            continue
        fi
        touch "$made"
    fi
    echo "other_pythons: $("$environment/bin/python" --version)"
    PYTHONPATH=.:export:plugins:examples "$environment/bin/python" -m pytest -q --noconftest -m "not slow" \
        -p no:cacheprovider "${light_tests[@]}"
done
