#!/bin/sh
# Install rtee from this bundle, without a network: sudo ./install.sh [FOLDER]
# FOLDER is the environment that is made, /opt/rtee unless given. PYTHON names the interpreter.
set -eu
cd "$(dirname "$0")"
folder=${1:-/opt/rtee}
python=${PYTHON:-python@PYTHON@}

fail() {
    echo "install.sh: $1" >&2
    exit 1
}

[ "$(uname -m)" = "@MACHINE@" ] || fail "this bundle is for @MACHINE@, this computer is $(uname -m)"
command -v "$python" >/dev/null || fail "there is no $python; name one of Python @PYTHON@: PYTHON=…"
version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
[ "$version" = "@PYTHON@" ] || fail "this bundle is for Python @PYTHON@, $python is $version"
"$python" -c 'import ensurepip, venv' 2>/dev/null \
    || fail "$python makes no environments; on Debian and Ubuntu install python@PYTHON@-venv"
sha256sum --check --strict --quiet SHA256SUMS || fail "the bundle is damaged; copy it again"
[ -x "$folder/bin/python" ] || "$python" -m venv "$folder"
# pip checks the checksum of every wheel again, and asks no index.
"$folder/bin/python" -m pip install --quiet --disable-pip-version-check --no-input \
    --no-index --find-links wheels --require-hashes --requirement requirements.txt
"$folder/bin/rtee" --version
echo "in $folder; next: sudo $folder/bin/rtee deploy install HAND"
