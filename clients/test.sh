#!/bin/sh
# Build and test the clients in Rust and C. What is missing on this machine is said and skipped, with exit status 0.
set -eu
cd "$(dirname "$0")/rust"
# A login shell adds cargo's own folder; make does not.
PATH="$PATH:${CARGO_HOME:-$HOME/.cargo}/bin"
export PATH

if ! command -v cargo >/dev/null 2>&1; then
    echo "test-clients: SKIPPED, no cargo on this machine; install Rust to test the Rust and C clients"
    exit 0
fi

echo "test-clients: Rust"
cargo test --locked --quiet
cargo build --locked --release --quiet

compiler="${CC:-cc}"
if ! command -v "$compiler" >/dev/null 2>&1; then
    echo "test-clients: C SKIPPED, no C compiler on this machine ($compiler); set CC or install one"
    exit 0
fi

target="${CARGO_TARGET_DIR:-target}"
built="$target/release"
out="$target/c"
mkdir -p "$out"
flags="-std=c11 -D_POSIX_C_SOURCE=200809L -O2 -Wall -Wextra -Werror -Iinclude"
echo "test-clients: C, static and shared library"
# shellcheck disable=SC2086
"$compiler" $flags c/test_vectors.c "$built/libdehyst.a" -o "$out/test_static" -lm -lpthread -ldl
"$out/test_static" ../../docs/protocol/vectors
# shellcheck disable=SC2086
"$compiler" $flags c/test_vectors.c -o "$out/test_shared" -L"$built" -ldehyst -lm
LD_LIBRARY_PATH="$built" "$out/test_shared" ../../docs/protocol/vectors
# shellcheck disable=SC2086
"$compiler" $flags c/corrected.c "$built/libdehyst.a" -o "$out/corrected" -lm -lpthread -ldl
"$out/corrected" ../../docs/protocol/vectors/bouc_wen.model.payload
# shellcheck disable=SC2086
"$compiler" $flags c/bench.c "$built/libdehyst.a" -o "$out/bench" -lm -lpthread -ldl

if [ -z "${DEHYST_TEST_ZENOH:-}" ]; then
    echo "test-clients: passed; the zenoh follower was not built: DEHYST_TEST_ZENOH=1 fetches its crates and tests it"
    exit 0
fi
echo "test-clients: the zenoh follower, beside a live service"
cd zenoh
cargo test --release --quiet --test authenticators
cargo build --release --quiet --lib --examples
zenoh="${CARGO_TARGET_DIR:-target}/release"
# shellcheck disable=SC2086
for program in stage ahead controller deadlines; do
    "$compiler" $flags -I../include "c/$program.c" -o "$zenoh/$program" -L"$zenoh" -ldehyst_zenoh -lm \
        -Wl,-rpath,'$ORIGIN'
done
DEHYST_ZENOH_LIBRARY="$(cd "$zenoh" && pwd)/libdehyst_zenoh.so"
export DEHYST_ZENOH_LIBRARY
cd ../../..
python="${PYTHON:-.venv/bin/python}"
"$python" -m pytest -q clients/rust/zenoh/test_live.py
echo "test-clients: all passed"
