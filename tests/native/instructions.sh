#!/bin/sh
# Counts the instructions that a frame costs, with valgrind, and compares with what was recorded in instructions.txt:
# a time depends on the machine and on what else it does, this does not. Only code outside the kernel is counted.
# instructions.sh          fails where a frame costs more than a tenth more; for the recorded compiler only
# instructions.sh record   writes instructions.txt anew: after a change that is worth its cost, or one that saves
set -eu
cd "$(dirname "$0")/../.."

relay=bridged/relay
native=tests/native
build=$native/build
recorded=$native/instructions.txt
limit=10 # percent
mkdir -p "$build"

for tool in gcc valgrind; do
    command -v "$tool" >/dev/null || { echo "instructions.sh: not checked, there is no $tool" >&2; exit 0; }
done
compiler="$(gcc --version | head -n 1) $(uname -m)"
program=$build/instructions
# shellcheck disable=SC2046 # names without spaces
gcc -std=c11 -O2 -g -Wall -Wextra -Wno-missing-field-initializers -Werror -D_GNU_SOURCE -pthread -Wl,--wrap=syscall \
    "$native/instructions.c" $(find "$relay" -name '*.c' ! -name 'module*') -o "$program"

# count NAME FUNCTION ARGUMENT…: prints "INSTRUCTIONS NAME", for one frame, of FUNCTION and what it calls.
count() {
    name=$1 function=$2
    shift 2
    frames=$(valgrind --tool=callgrind --callgrind-out-file=/dev/null --toggle-collect="$function" \
        --log-file="$build/instructions.log" "$program" "$@") || { cat "$build/instructions.log" >&2; exit 1; }
    awk -v frames="$frames" -v name="$name" '/Collected/ { printf "%.1f %s\n", $NF / frames, name }' "$build/instructions.log"
}

count_all() {
    for codec in can232 usb2can; do
        for kind in standard extended; do
            count "$codec, encode a frame, $kind" "${codec}_encode" "$codec" encode "$kind"
            count "$codec, decode a frame, $kind" "${codec}_decode" "$codec" decode "$kind"
        done
        count "$codec, relay to the bus, batches of 64" relay_turn "$codec" to-bus standard
        count "$codec, relay to the device, batches of 64" relay_turn "$codec" to-device standard
    done
}

counted=$build/instructions.counted
count_all > "$counted"
if [ "${1-}" = record ]; then
    { echo "# Instructions for one frame of 8 bytes, by instructions.sh record: $compiler"; cat "$counted"; } > "$recorded"
    cat "$recorded"
    exit 0
fi
if [ "$(head -n 1 "$recorded")" != "# Instructions for one frame of 8 bytes, by instructions.sh record: $compiler" ]; then
    echo "instructions.sh: only shown, they were recorded with another compiler: $compiler"
    cat "$counted"
    exit 0
fi
awk -v limit="$limit" '
    /^#/ { next }
    { cost = $1; sub(/^[^ ]+ /, "") }
    NR == FNR { before[$0] = cost; next }
    {
        if (!before[$0] || cost == 0) { print "FAILED not recorded, or no such function any more: " $0; failed++; delete before[$0]; next }
        more = 100 * (cost / before[$0] - 1)
        verdict = more > limit ? "FAILED" : more < -limit ? "better" : "ok"
        if (more > limit) failed++; else passed++
        printf "%-6s %8.1f instructions (%+.1f %%)  %s\n", verdict, cost, more, $0
        delete before[$0]
    }
    END {
        for (name in before) { print "FAILED not counted: " name; failed++ }
        if (failed)
            print "More than " limit " % more: find out why; if it is worth it, sh tests/native/instructions.sh record"
        printf "instructions: %d passed, %d failed\n", passed, failed
        exit failed > 0
    }' "$recorded" "$counted"
