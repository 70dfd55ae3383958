#!/bin/sh
# Fuzzes the codec with libFuzzer, ASan and UBSan: fuzz.sh [RUNS], 10,000,000 by default.
# Starts from corpus/can232; what it finds new goes to build/corpus. An input that fails is build/crash-…: once the
# bug is fixed, it moves to corpus/can232 for good.
set -eu
cd "$(dirname "$0")/../.."

runs=${1:-10000000}
native=tests/native
build=$native/build
fuzzer=$build/fuzz_codec_can232
mkdir -p "$build/corpus/can232"

if ! command -v clang >/dev/null; then
    echo "fuzz.sh: needs clang and its libFuzzer (Debian: clang libclang-rt-14-dev)" >&2
    exit 1
fi
# Only the codec guides the fuzzer: coverage of the checks around it would be noise.
flags="-std=c11 -g -O2 -Wall -Wextra -Werror -fno-sanitize-recover=all"
# shellcheck disable=SC2086 # flags without spaces, to be split
{
    clang $flags -fsanitize=fuzzer-no-link,address,undefined -c bridged/relay/codec_can232.c -o "$fuzzer-codec.o"
    clang $flags -fsanitize=address,undefined -c "$native/fuzz_codec_can232.c" -o "$fuzzer-target.o"
    clang -fsanitize=fuzzer,address,undefined "$fuzzer-codec.o" "$fuzzer-target.o" -o "$fuzzer"
}
# A small quarantine: the codec frees nothing, so it would only take 400 MB of memory.
ASAN_OPTIONS="quarantine_size_mb=1:${ASAN_OPTIONS-}" exec "$fuzzer" -runs="$runs" -max_len=600 \
    -artifact_prefix="$build/" -print_final_stats=1 "$build/corpus/can232" "$native/corpus/can232"
