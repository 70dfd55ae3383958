#!/bin/sh
# Does what the README's section Install says, in a directory of its own, and uses what came of it.
set -eu
top=$(cd "$(dirname "$0")/../.." && pwd)
work=$(mktemp -d "${TMPDIR:-/tmp}/can-bridge-install.XXXXXX")
trap 'rm -rf "$work"' EXIT
cp -r "$top/pyproject.toml" "$top/README.md" "$top/LICENSE" "$top/bridged" "$work/"
rm -f "$work"/bridged/*.so
cd "$work"
/usr/bin/python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check .
cd /
for file in "$top"/config/*.yaml; do "$work/venv/bin/can-bridge" check "$file"; done
"$work/venv/bin/can-bridge" demo --duration 3 | tail -n 1
