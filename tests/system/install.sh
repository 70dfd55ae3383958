#!/bin/sh
# Does what the README's section Install says, in a directory of its own, and uses what came of it.
set -eu
top=$(cd "$(dirname "$0")/../.." && pwd)
work=$(mktemp -d "${TMPDIR:-/tmp}/can-bridge-install.XXXXXX")
trap 'rm -rf "$work"' EXIT
cp -r "$top/pyproject.toml" "$top/README.md" "$top/LICENSE" "$top/bridged" "$top/config" "$top/systemd" "$work/"
rm -f "$work"/bridged/*.so
cd "$work"
/usr/bin/python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check . msgpack  # which the example with udp_multicast needs
cd /
for file in can-bridge@.service can-bridge.sysusers 70-can-bridge.rules network.conf; do
    [ -s "$work/venv/share/can-bridge/systemd/$file" ] || { echo "not installed: $file" >&2; exit 1; }
done
for file in "$work"/venv/share/can-bridge/config/*.yaml; do "$work/venv/bin/can-bridge" check "$file"; done
"$work/venv/bin/can-bridge" demo --duration 3 | tail -n 1
