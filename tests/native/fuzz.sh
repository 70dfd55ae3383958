#!/bin/sh
# Fuzzes the codecs with libFuzzer, ASan and UBSan: fuzz.sh [RUNS [CODEC…]], 10,000,000 of each by default.
# Starts from corpus/CODEC; what it finds new goes to build/corpus. An input that fails is build/crash-…: once the
# bug is fixed, it moves to corpus/CODEC for good.
set -eu
cd "$(dirname "$0")/../.."

runs=${1:-10000000}
[ $# = 0 ] || shift
[ $# -gt 0 ] || set -- can232 usb2can
native=tests/native
build=$native/build

if ! command -v clang >/dev/null; then
    echo "fuzz.sh: needs clang and its libFuzzer (Debian: clang libclang-rt-14-dev)" >&2
    exit 1
fi
# Only the codec guides the fuzzer: coverage of the checks around it would be noise.
flags="-std=c11 -g -O2 -Wall -Wextra -Werror -fno-sanitize-recover=all"

for codec; do
    fuzzer=$build/fuzz_codec_$codec
    mkdir -p "$build/corpus/$codec"
    # shellcheck disable=SC2086 # flags without spaces, to be split
    {
        clang $flags -fsanitize=fuzzer-no-link,address,undefined -c "bridged/relay/codec_$codec.c" \
            -o "$fuzzer-codec.o"
        clang $flags -fsanitize=address,undefined -c "$native/fuzz_codec_$codec.c" -o "$fuzzer-target.o"
        clang -fsanitize=fuzzer,address,undefined "$fuzzer-codec.o" "$fuzzer-target.o" -o "$fuzzer"
    }
    # A small quarantine: the codec frees nothing, so it would only take 400 MB of memory.
    ASAN_OPTIONS="quarantine_size_mb=1:${ASAN_OPTIONS-}" "$fuzzer" -runs="$runs" -max_len=600 \
        -artifact_prefix="$build/" -print_final_stats=1 "$build/corpus/$codec" "$native/corpus/$codec"
done
