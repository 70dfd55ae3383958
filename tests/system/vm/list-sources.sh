#!/bin/sh
# Prints the apt sources files of this machine that serve the Debian suite $1, so that its own mirror is used.
# If there are none, mmdebstrap takes its default.
for file in /etc/apt/sources.list /etc/apt/sources.list.d/*.list /etc/apt/sources.list.d/*.sources; do
    [ -f "$file" ] || continue
    if grep -qE "^[^#]*[[:space:]]$1([[:space:]]|\$)" "$file" && grep -qE '^[^#]*[[:space:]]main([[:space:]]|$)' "$file"; then
        echo "$file"
    fi
done
