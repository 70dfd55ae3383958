#!/bin/sh
# Builds and runs the C unit tests with every compiler there is, under AddressSanitizer and UBSan.
# run.sh         the tests; also that the codecs compile without a warning at -O2, and that the benches compile
# run.sh bench   the codecs' throughput instead
set -eu
cd "$(dirname "$0")/../.."

relay=bridged/relay
native=tests/native
build=$native/build
sanitizers=-fsanitize=address,undefined
mkdir -p "$build"

# strict SOURCE: what ships must compile silently, conversions included.
strict() {
    "$cc" -std=c11 -O2 -Wall -Wextra -Wconversion -Werror -c "$relay/$1.c" -o "$build/$1-$cc.o"
}

# run_test NAME SOURCE...: builds test_NAME.c with these files of the relay, and runs it.
run_test() {
    name=test_$1
    shift
    sources=
    for source; do
        sources="$sources $relay/$source.c"
    done
    # shellcheck disable=SC2086 # names without spaces, to be split
    "$cc" -std=c11 -g -O1 -Wall -Wextra -Wno-missing-field-initializers -Werror $sanitizers -fno-sanitize-recover=all \
        $options "$native/$name.c" $sources -o "$build/$name-$cc"
    printf '%s (%s): ' "$name" "$cc"
    "$build/$name-$cc" || failed=1
}

bench() {
    "$cc" -std=c11 -O2 -Wall -Wextra -Werror "$native/bench_codec.c" "$relay"/codec_*.c \
        -o "$build/bench_codec-$cc"
    "$cc" -std=c11 -O2 -Wall -Wextra -Werror tests/bench/floor.c -o "$build/floor-$cc"
    "$cc" -std=c11 -O2 -Wall -Wextra -Werror tests/bench/load*.c -o "$build/load-$cc"
}

# The relay's files that know nothing of Python; a test that includes relay.c takes the parts only.
parts=$(find "$relay" -name '*.c' ! -name 'module*' ! -name relay.c | sed 's|.*/||; s|\.c$||')
options=
failed=0
compilers=0
for cc in gcc clang; do
    command -v "$cc" >/dev/null || continue
    compilers=$((compilers + 1))
    bench
    if [ "${1-}" = bench ]; then
        echo "$cc"
        "$build/bench_codec-$cc"
        continue
    fi
    for codec in codec_can232 codec_usb2can; do
        strict "$codec"
        run_test "$codec" "$codec"
        run_test "${codec}_streams" "$codec"
    done
    options="-D_GNU_SOURCE -pthread -Wl,--wrap=send,--wrap=sendmmsg"
    # shellcheck disable=SC2086 # names without spaces
    run_test relay_interface relay $parts
    options="-D_GNU_SOURCE -pthread -Wl,--wrap=write"
    # shellcheck disable=SC2086
    run_test relay_cut $parts
    options="-D_GNU_SOURCE -pthread"
    # shellcheck disable=SC2086
    run_test relay_lock $parts
    options=
done
if [ "$compilers" = 0 ]; then
    echo "run.sh: neither gcc nor clang found" >&2
    exit 1
fi
exit "$failed"
