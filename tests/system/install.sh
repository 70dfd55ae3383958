#!/bin/sh
# Does what the README's section Install says, line by line, in a directory of its own, twice: as an upgrade too.
set -eu
top=$(cd "$(dirname "$0")/../.." && pwd)
work=$(mktemp -d "${TMPDIR:-/tmp}/can-bridge-install.XXXXXX")
trap 'rm -rf "$work"' EXIT
mkdir "$work/clone" "$work/bin"
cd "$work/clone"
cp -r "$top/pyproject.toml" "$top/README.md" "$top/LICENSE" "$top/bridged" "$top/config" "$top/systemd" .
rm -f bridged/*.so

# The first block of commands; where they install to, and what apt does, is this machine's.
# shellcheck disable=SC2016  # backquotes of Markdown
sed -n '/^## Install/,/^## /p' README.md | sed -n '/^```sh/,/^```/p' | sed -n '2,/^```/p' | grep -v '^```' | grep -v '^apt ' |
    sed -e "s|/opt/can-bridge|$work/venv|g" -e "s|/usr/local/bin|$work/bin|g" -e 's|^python3 |/usr/bin/python3 |' \
        -e 's|pip install|pip install -q --disable-pip-version-check|' > "$work/install"
grep -q 'pip install .* \.' "$work/install" || { echo "install: no commands found in the README" >&2; exit 1; }

touch bridged/zz_old.py # a module that the next version has no more
sh -eux "$work/install"
rm bridged/zz_old.py
sh -eux "$work/install"
stale=$(find "$work/venv" -name 'zz_old*')
[ -z "$stale" ] || { echo "install: an old version's module is still there: $stale" >&2; exit 1; }

cd /
for file in can-bridge@.service can-bridge.sysusers 70-can-bridge.rules network.conf; do
    [ -s "$work/venv/share/can-bridge/systemd/$file" ] || { echo "not installed: $file" >&2; exit 1; }
done
can_bridge=$work/bin/can-bridge
for file in "$work"/venv/share/can-bridge/config/*.yaml; do
    if ! said=$("$can_bridge" check "$file" 2>&1); then
        # One package is not for everybody: the check names the command, which must do.
        command=$(printf '%s\n' "$said" | sed -n 's/.*needs the package [^ ]*: //p')
        [ -n "$command" ] || { echo "$said" >&2; exit 1; }
        echo "install: $command"
        eval "$command -q --disable-pip-version-check"
        said=$("$can_bridge" check "$file" 2>&1)
    fi
    echo "$said"
done
"$can_bridge" demo --duration 3 | tail -n 2
